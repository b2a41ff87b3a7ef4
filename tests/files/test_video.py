"""Videos are opened again with ffmpeg and looked at."""

import re
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from jaxil.files.video import write_video


def read_video(path) -> tuple[tuple[int, int], float, np.ndarray]:
    """Decodes a video: (width, height), frames per second, frames [T, H, W, 3]."""
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    output = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(
        [ffmpeg, "-i", path, *output], capture_output=True, check=True
    )
    stream = re.search(
        r"Video: h264.* (\d+)x(\d+).* ([\d.]+) fps", done.stderr.decode()
    )
    assert stream is not None, done.stderr
    width, height = int(stream[1]), int(stream[2])
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)
    return (width, height), float(stream[3]), frames


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


@pytest.mark.parametrize(
    ("left", "right", "fps", "message"),
    [
        (np.zeros((2, 8, 8, 3), np.float32), None, 10, "frames_left = float32"),
        (np.zeros((2, 8, 8), np.uint8), None, 10, r"expected uint8 \[T, H, W, 3\]"),
        (np.zeros((0, 8, 8, 3), np.uint8), None, 10, "at least one frame"),
        (
            plain_frames(1, (0, 0, 0)),
            plain_frames(1, (0, 0, 0), (8, 8)),
            10,
            "frames_right",
        ),
        (plain_frames(1, (0, 0, 0)), None, 0, "fps = 0: expected > 0"),
    ],
)
def test_bad_frames_are_refused(tmp_path, left, right, fps, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "video.mp4", left, right, fps=fps)

    assert list(tmp_path.iterdir()) == []


def test_a_failing_encoder_is_told(tmp_path):
    with pytest.raises(OSError, match="ffmpeg could not write the video"):
        write_video(
            tmp_path / "missing" / "video.mp4", plain_frames(40, (0, 0, 0)), fps=10
        )
