"""Videos of known frames, in every container, whole, damaged and in disguise."""

import pathlib
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import videos
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.videos import encode_video, open_video

CODECS = {  # name of the file: settings, largest error in grey levels
    "plain.mp4": ({}, 0),
    "start.mp4": ({"container_options": {"movflags": "+faststart"}}, 0),
    "pieces.mp4": ({"container_options": {"movflags": "frag_keyframe+empty_moov"}}, 0),
    "backwards.mov": ({"bf": "3", "g": "12"}, 0),
    "lossless.mkv": ({}, 0),
    # Rounding to whole values of another colour space, and back.
    "yuv.mp4": ({"codec": "libx264", "pixels": "yuv444p", "qp": "0"}, 3),
    "vp9.webm": ({"codec": "libvpx-vp9", "pixels": "gbrp", "lossless": "1"}, 0),
    "ffv1.avi": ({"codec": "ffv1", "pixels": "bgr0"}, 0),
    "two_colours.gif": ({"codec": "gif", "pixels": "rgb8"}, 3),
}


def make_frames(num_frames=12, seed=0, size=16):
    """Black and white noise, which no two frames share. [T, size, size, 3]"""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2, (num_frames, size, size, 1), dtype=np.uint8)
    return np.broadcast_to(bits * np.uint8(255), (num_frames, size, size, 3))


def make_colours(num_frames=12, size=16):
    """Noise of all colours. [T, size, size, 3]"""
    rng = np.random.default_rng(1)
    return rng.integers(0, 256, (num_frames, size, size, 3), dtype=np.uint8)


def read(path, **options):
    return read_here(videos, path, **options)


@pytest.fixture(name="path")
def _path(tmp_path):
    path = tmp_path / "video.mp4"
    encode_video(path, make_frames())
    return path


# --- what is read ---------------------------------------------------------------------


@pytest.mark.parametrize("name", CODECS)
def test_every_frame_comes_once_and_in_order(tmp_path, name):
    settings, error = CODECS[name]
    frames = make_frames() if name.endswith(".gif") else make_colours()
    path = tmp_path / name
    encode_video(path, frames, fps=20, **settings)
    assert videos.recognises(path)
    recording, (episode,) = read(path)
    assert recording.frames_per_second == pytest.approx(20, rel=0.01)
    assert recording.notes == ()
    assert episode.frames.shape == frames.shape
    np.testing.assert_allclose(episode.frames.astype(int), frames, atol=error)
    assert episode.actions is None
    assert episode.rewards is None


@pytest.mark.parametrize("frame_skip", [2, 3, 11])
def test_every_nth_frame_is_kept_from_the_first_on(path, frame_skip):
    recording, (episode,) = read(path, frame_skip=frame_skip)
    np.testing.assert_array_equal(episode.frames, make_frames()[::frame_skip])
    assert recording.frames_per_second == pytest.approx(25 / frame_skip)


def test_a_fractional_rate_is_exact(path):
    encode_video(path, make_frames(), fps=Fraction(30000, 1001))
    assert read(path)[0].frames_per_second == pytest.approx(30000 / 1001, rel=1e-9)


def test_the_name_says_nothing(path):
    other = path.rename(path.with_name("concat:a|b.txt"))
    assert videos.recognises(other)
    np.testing.assert_array_equal(read(other)[1][0].frames, make_frames())


def test_unevenly_spaced_frames_are_kept_with_a_note(path):
    times = [time + 10 * (time >= 4) for time in range(12)]
    encode_video(path, make_frames(), times=times)
    recording, (episode,) = read(path)
    np.testing.assert_array_equal(episode.frames, make_frames())
    assert "video.mp4 has unevenly spaced frames" in recording.notes[0]


def test_frames_are_scaled_while_they_are_decoded(path):
    colours = make_colours(size=64)[:, :48]
    encode_video(path, colours)
    assert read(path)[1][0].frames.shape == (12, 48, 64, 3)
    # No more memory than for the result.
    (episode,) = read(path, image_size=16, max_bytes=12 * 16 * 16 * 3)[1]
    assert episode.stored_size == (48, 64)
    for frame, colour in zip(episode.frames, colours, strict=True):
        image = Image.fromarray(colour)
        expected = image.resize((16, 16), Image.Resampling.BILINEAR)
        np.testing.assert_array_equal(frame, np.asarray(expected))
    (episode,) = read(path, image_size=16, keep_aspect=True)[1]
    assert episode.frames.shape == (12, 16, 21, 3)
    (episode,) = read(path, image_size=160, keep_aspect=True)[1]
    assert episode.frames.shape == (12, 48, 64, 3)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_rotated_videos_are_turned_upright(path, degrees):
    from av.sidedata.sidedata import Type

    colours = make_colours(size=32)[:, :16]
    encode_video(path, colours)
    # The box of the track says how to turn it: a, b, u, c, d, v in 16.16 bits.
    matrix = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}[degrees]
    a, b, c, d = ((65536 * x).to_bytes(4, signed=True) for x in matrix)
    one = (65536).to_bytes(4)
    content = path.read_bytes()
    start = content.index(b"tkhd") + 4 + 40
    assert content[start : start + 4] == one
    turned = a + b + bytes(4) + c + d
    path.write_bytes(content[:start] + turned + content[start + len(turned) :])
    with open_video(path) as container:
        frame = next(container.decode(video=0))
        assert frame.side_data.get(Type.DISPLAYMATRIX) is not None
        quarters = frame.rotation // 90
    frames = read(path)[1][0].frames
    np.testing.assert_array_equal(frames, np.rot90(colours, quarters, axes=(1, 2)))


def test_later_frames_of_another_size_are_scaled_to_the_first(tmp_path):
    colours = make_colours(size=4)
    path = tmp_path / "both.webm"
    with open_video(path, "w") as both:
        stream = None
        for part, scale in enumerate((4, 8)):
            large = colours.repeat(scale, axis=1).repeat(scale, axis=2)
            encode_video(tmp_path / "part.webm", large, **CODECS["vp9.webm"][0])
            with open_video(tmp_path / "part.webm") as container:
                source = container.streams.video[0]
                stream = stream or both.add_stream_from_template(source)
                for packet in container.demux(source):
                    if packet.size:
                        packet.pts = packet.dts = packet.pts + 480 * part
                        packet.stream = stream
                        both.mux(packet)
    frames = read(path)[1][0].frames.astype(int)
    assert frames.shape == (24, 16, 16, 3)
    # Edges are smoothed, so look at the middle of each square.
    for start in (0, 12):
        squares = frames[start : start + 12, 2::4, 2::4]
        np.testing.assert_allclose(squares, colours, atol=0 if start == 0 else 40)


# --- folders --------------------------------------------------------------------------


def test_a_folder_is_read_by_name_one_file_at_a_time(tmp_path):
    lengths = {"b.mp4": 5, "a.mp4": 3, "c.mp4": 4}
    for seed, (name, length) in enumerate(lengths.items()):
        encode_video(tmp_path / name, make_frames(length, seed))
    (tmp_path / ".hidden.mp4").write_bytes(b"not looked at")
    (tmp_path / "README.txt").write_text("about them")
    assert videos.recognises(tmp_path)
    recording = foreign.open_recording(tmp_path, max_bytes=2**24)
    assert recording.num_episodes == 3
    assert "README.txt" in recording.notes[0]
    (tmp_path / "c.mp4").unlink()  # not opened yet
    for name, seed in (("a.mp4", 1), ("b.mp4", 0)):
        episode = next(recording.episodes)
        np.testing.assert_array_equal(episode.frames, make_frames(lengths[name], seed))
    with pytest.raises(FormatError, match=r"c\.mp4"):
        next(recording.episodes)


def test_faults_in_a_folder_name_the_file(tmp_path):
    for name, fps in (("a.mp4", 25), ("b.mp4", 50)):
        encode_video(tmp_path / name, make_frames(), fps=fps)
    with pytest.raises(FormatError, match=r"holds b.mp4, which has 50 .* a.mp4 has 25"):
        read(tmp_path)
    content = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(content[:-100])
    with pytest.raises(FormatError, match=r"^holds b.mp4, which is cut off"):
        read(tmp_path)
    (tmp_path / "b.mp4").write_bytes(b"text")
    with pytest.raises(FormatError, match=r"^holds b.mp4, which is not a video"):
        read(tmp_path)


def test_folders_without_videos(tmp_path):
    (tmp_path / "a.txt").write_text("text")
    assert not videos.recognises(tmp_path)
    assert not videos.recognises(tmp_path / "none")
    assert not videos.recognises(pathlib.Path("a\0b"))
    with pytest.raises(FormatError, match="holds no video"):
        read(tmp_path)


# --- faults ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["start.mp4", "pieces.mp4", "two_colours.gif"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path, name):
    path = tmp_path / name
    encode_video(path, make_frames(4), **CODECS[name][0])
    content = path.read_bytes()
    for length in range(12, len(content) - 1, len(content) // 8):
        path.write_bytes(content[:length])
        with pytest.raises(
            FormatError, match=r"cut off or damaged|no video stream|has 0 frames"
        ):
            read(path)


def test_a_gif_damaged_in_the_middle_is_refused_and_one_with_a_tail_is_not(tmp_path):
    path = tmp_path / "video.gif"
    encode_video(path, make_frames(), **CODECS["two_colours.gif"][0])
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    assert len(read(path)[1][0].frames) == 12
    middle = content.index(b"\x21\xf9\x04", len(content) // 2)  # a frame begins
    path.write_bytes(content[:middle] + b"\0" + content[middle + 1 :])
    with pytest.raises(FormatError, match="damaged"):
        read(path)


@pytest.mark.parametrize("num_frames", [1, 3])
def test_two_frames_are_needed(path, num_frames):
    encode_video(path, make_frames(num_frames))
    message = f"has {num_frames} frames, too few for frame_skip={num_frames}"
    with pytest.raises(FormatError, match=message):
        read(path, frame_skip=num_frames)


def test_more_than_the_limit_is_refused_and_the_limit_itself_is_not(path):
    whole = make_frames().nbytes
    assert read(path, max_bytes=whole)[1][0].frames.nbytes == whole
    message = f"12 or more frames of 16x16 pixels, of {whole} bytes, more than the "
    with pytest.raises(FormatError, match=message):
        read(path, max_bytes=whole - 1)
    # What is skipped takes no room.
    half = read(path, max_bytes=whole // 2, frame_skip=2)[1][0].frames
    assert half.nbytes == whole // 2


PLAYLISTS = {
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n",
    "concat": "ffconcat version 1.0\nfile {other}\n",
    "dash": '<?xml version="1.0"?><MPD><BaseURL>{other}</BaseURL></MPD>',
}


@pytest.mark.parametrize(
    "start", [b"", b"\0\0\0\x18ftypisom\0\0\2\0isomiso2", b"GIF89a"]
)
@pytest.mark.parametrize("kind", PLAYLISTS)
def test_a_playlist_opens_nothing(path, kind, start):
    playlist = path.with_name("playlist.mp4")
    text = PLAYLISTS[kind].format(other=path)
    playlist.write_bytes(start + text.encode())
    assert videos.recognises(playlist) == bool(start)
    with pytest.raises(FormatError):
        read(playlist)


def test_a_reference_to_another_file_is_not_followed(path):
    # An alias of QuickTime: the frames lie in other.mp4, beside this one.
    content = path.read_bytes()
    path.rename(path.with_name("other.mp4"))
    name = b"/there/other.mp4"  # of even length
    alias = b"alis" + bytes(4 + 130) + b"\0\1\0\1" + bytes(16)
    alias += b"\0\2" + len(name).to_bytes(2) + name + b"\xff\xff\0\0"
    alias = (4 + len(alias)).to_bytes(4) + alias
    in_this_file = b"\0\0\0\x0curl \0\0\0\1"
    changed = content.replace(in_this_file, alias)
    added = len(changed) - len(content)
    assert added > 0
    for box in (b"dref", b"dinf", b"minf", b"mdia", b"trak", b"moov"):
        place = changed.index(box) - 4  # a box begins with its length
        length = int.from_bytes(changed[place : place + 4]) + added
        changed = changed[:place] + length.to_bytes(4) + changed[place + 4 :]
    path.write_bytes(changed)
    # It would be followed if one allowed it:
    with open_video(path, "r", options={"enable_drefs": "1"}) as container:
        assert len(list(container.decode(video=0))) == 12
    with pytest.raises(FormatError):
        read(path)
