"""Videos are opened again with ffmpeg and looked at."""

import numpy as np
import pytest
from PIL import Image

from jaxil.files.video import write_gif, write_video
from tests.demonstrations.videos import open_video


def read_video(path) -> tuple[tuple[int, int], float, np.ndarray]:
    """Decodes a video: (width, height), frames per second, frames [T, H, W, 3]."""
    with open_video(path) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        frames = [
            frame.to_ndarray(format="rgb24") for frame in container.decode(stream)
        ]
        assert stream.pix_fmt == "yuv420p"
        size = stream.width, stream.height
        return size, float(stream.average_rate), np.stack(frames)


def plain_frames(num_frames: int, colour: tuple[int, int, int], size=(84, 84)):
    return np.full((num_frames, *size, 3), colour, np.uint8)


def test_two_episodes_side_by_side(tmp_path):
    path = tmp_path / "episode.mp4"
    red, blue = plain_frames(12, (200, 0, 0)), plain_frames(7, (0, 0, 200))

    write_video(path, red, blue, fps=25)

    size, fps, frames = read_video(path)
    # 84 is enlarged 4 times to 336; two of them, a gap of 8, a caption of 22 above.
    assert size == (2 * 336 + 8, 336 + 22)
    assert fps == pytest.approx(25)
    assert len(frames) == 12
    # Past the end of the shorter one, too. The codec may be off by a few grey levels.
    for frame in (frames[0], frames[-1]):
        left, right = frame[22 + 168, 168], frame[22 + 168, 344 + 168]
        np.testing.assert_allclose(left.astype(int), (200, 0, 0), atol=12)
        np.testing.assert_allclose(right.astype(int), (0, 0, 200), atol=12)
    assert [item.name for item in tmp_path.iterdir()] == ["episode.mp4"]


def test_pixels_stay_squares_and_frames_keep_their_order(tmp_path):
    frames = np.zeros((5, 64, 64, 3), np.uint8)
    for step in range(5):
        frames[step, :, : 8 * (step + 1)] = 255  # a bar that grows

    write_video(tmp_path / "bar.mp4", frames, fps=10)

    size, _, seen = read_video(tmp_path / "bar.mp4")
    assert size == (256, 256 + 22)
    for step, frame in enumerate(seen):
        bright = (frame[22 + 100].mean(axis=-1) > 127).sum()
        assert abs(int(bright) - 4 * 8 * (step + 1)) <= 1


def test_odd_sizes_are_padded(tmp_path):
    write_video(tmp_path / "odd.mp4", plain_frames(2, (9, 9, 9), (301, 257)), fps=10)

    size, _, _ = read_video(tmp_path / "odd.mp4")
    assert size == (258, 324)


def test_a_name_may_have_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_video("pdac:1.mp4", plain_frames(2, (9, 9, 9)), fps=10)
    assert len(read_video(tmp_path / "pdac:1.mp4")[2]) == 2


def test_a_long_strip_is_not_enlarged_without_bound(tmp_path):
    write_video(tmp_path / "strip.mp4", plain_frames(2, (9, 9, 9), (2, 1500)), fps=10)
    size, _, _ = read_video(tmp_path / "strip.mp4")
    assert size == (1500, 2 + 22)


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (np.zeros((2, 8, 8, 3), np.float32), None, "frames_left = float32"),
        (np.zeros((2, 8, 8), np.uint8), None, r"expected uint8 \[T, H, W, 3\]"),
        (np.zeros((0, 8, 8, 3), np.uint8), None, "at least one frame"),
        (plain_frames(1, (0, 0, 0)), plain_frames(1, (0, 0, 0), (8, 8)), "frames_righ"),
    ],
)
def test_bad_frames_are_refused(tmp_path, left, right, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "video.mp4", left, right, fps=10)

    assert list(tmp_path.iterdir()) == []


def test_it_begins_to_play_before_all_of_it_is_there(tmp_path):
    write_video(tmp_path / "video.mp4", plain_frames(40, (0, 0, 0)), fps=12.5)
    content = (tmp_path / "video.mp4").read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")
    assert read_video(tmp_path / "video.mp4")[1] == 12.5


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(OSError, match="No such file"):
        write_video(
            tmp_path / "missing" / "video.mp4", plain_frames(40, (0, 0, 0)), fps=10
        )


def test_a_failing_encoder_leaves_the_old_file(tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="could not be encoded"):
        write_video(path, plain_frames(1, (0, 0, 0), (256, 20_000)), fps=10)
    assert path.read_bytes() == b"old"
    assert [item.name for item in tmp_path.iterdir()] == ["video.mp4"]


def test_a_gif_shows_the_same_with_a_text_for_each_frame(tmp_path):
    path = tmp_path / "episode.gif"
    red, blue = plain_frames(3, (200, 0, 0)), plain_frames(2, (0, 0, 200))

    write_gif(path, red, blue, fps=10, labels=(["a", "b", "a"], "expert"))

    with Image.open(path) as image:
        assert image.n_frames == 3  # pyright: ignore[reportAttributeAccessIssue]
        assert image.info["duration"] == 100
        seen = []
        for index in range(3):
            image.seek(index)
            seen.append(np.asarray(image.convert("RGB")))
    for frame in seen:
        np.testing.assert_allclose(
            frame[22 + 168, 168].astype(int), (200, 0, 0), atol=9
        )
        assert frame[22 + 168, 344 + 168, 2] > 190
    np.testing.assert_array_equal(seen[0], seen[2])
    assert np.any(seen[0][:22, :336] != seen[1][:22, :336])


def test_a_gif_keeps_the_colour_of_a_small_body(tmp_path):
    """As on dm_control's ground: 256 shades of blue, and little of anything else."""
    ramp = np.linspace(0, 255, 256 * 256).reshape(256, 256)
    frames = np.stack([ramp / 5, ramp / 3, ramp / 2 + 40], axis=-1)[None].repeat(2, 0)
    frames[:, 120:130, 120:130] = (230, 165, 100)

    write_gif(tmp_path / "body.gif", frames.astype(np.uint8), fps=10)

    with Image.open(tmp_path / "body.gif") as image:
        body = np.asarray(image.convert("RGB"))[22 + 125, 125].astype(int)
    np.testing.assert_allclose(body, (230, 165, 100), atol=20)
