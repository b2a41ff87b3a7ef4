"""Videos of known frames, in every container, whole, damaged and in disguise."""

import os
import pathlib
import subprocess
import sys

import imageio_ffmpeg
import numpy as np
import pytest

from jaxil.demonstrations.readers import child, clips, videos
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import encode_video

LIMIT = 2**24
RGB_MP4 = ("-c:v", "libx264rgb", "-qp", "0")
CODECS = {  # name of the file: options for ffmpeg, largest error in grey levels
    "plain.mp4": (RGB_MP4, 0),
    "start.mp4": ((*RGB_MP4, "-movflags", "+faststart"), 0),
    "pieces.mp4": ((*RGB_MP4, "-movflags", "frag_keyframe+empty_moov"), 0),
    "backwards.mp4": ((*RGB_MP4, "-bf", "3", "-g", "12"), 0),
    # Rounding to whole values of another colour space, and back.
    "yuv.mp4": (("-c:v", "libx264", "-qp", "0", "-pix_fmt", "yuv444p"), 3),
    "lossless.webm": (("-c:v", "libvpx-vp9", "-lossless", "1", "-pix_fmt", "gbrp"), 0),
    "two_colours.gif": (
        ("-filter_complex", "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=0"),
        0,
    ),
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


def ffmpeg(*arguments):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *arguments]
    subprocess.run(command, check=True, capture_output=True)


def read(path, **changes):
    recording = videos.open_recording(path, **({"max_bytes": LIMIT} | changes))
    return recording, list(recording.episodes)


@pytest.fixture(name="path")
def _path(tmp_path):
    path = tmp_path / "video.mp4"
    encode_video(path, make_frames(), *RGB_MP4)
    return path


# --- what is read ---------------------------------------------------------------------


@pytest.mark.parametrize("name", CODECS)
def test_every_frame_comes_once_and_in_order(tmp_path, name):
    options, error = CODECS[name]
    frames = make_frames() if name.endswith(".gif") else make_colours()
    path = tmp_path / name
    encode_video(path, frames, *options, fps=20)
    assert videos.recognises(path)
    recording, (episode,) = read(path)
    assert recording.num_episodes == 1
    assert recording.frames_per_second == pytest.approx(20, rel=0.01)
    assert recording.notes == ()
    assert episode.frames.dtype == np.uint8
    assert episode.frames.shape == frames.shape
    np.testing.assert_allclose(episode.frames.astype(int), frames, atol=error)
    assert episode.actions is None
    assert episode.rewards is None


@pytest.mark.parametrize("frame_skip", [2, 3, 5, 11])
def test_every_nth_frame_is_kept_from_the_first_on(path, frame_skip):
    recording, (episode,) = read(path, frame_skip=frame_skip)
    np.testing.assert_array_equal(episode.frames, make_frames()[::frame_skip])
    assert recording.frames_per_second == pytest.approx(25 / frame_skip)


def test_a_fraction_of_a_rate_is_exact(path):
    encode_video(path, make_frames(), *RGB_MP4, fps="30000/1001")
    assert read(path)[0].frames_per_second == pytest.approx(30000 / 1001, rel=1e-9)


def test_the_name_says_nothing(path):
    other = path.rename(path.with_name("concat:a|b.txt"))
    assert videos.recognises(other)
    np.testing.assert_array_equal(read(other)[1][0].frames, make_frames())


def test_frames_shown_for_unequal_times_are_told_and_kept(path):
    # Frames from the fourth on are shown ten frames later.
    late = "setpts=(N+10*gte(N\\,4))/(25*TB)"
    options = (*RGB_MP4, "-vf", late, "-fps_mode", "passthrough")
    # Some versions of ffmpeg would write a list that leaves the last frame out.
    encode_video(path, make_frames(), *options, "-use_editlist", "0")
    recording, (episode,) = read(path)
    np.testing.assert_array_equal(episode.frames, make_frames())
    assert "video.mp4 shows its frames for unequal times" in recording.notes[0]


def test_later_frames_of_another_size_are_scaled_to_the_first(tmp_path):
    options, _ = CODECS["lossless.webm"]
    colours = make_colours(size=4)
    for scale in (4, 8):
        large = colours.repeat(scale, axis=1).repeat(scale, axis=2)
        encode_video(tmp_path / f"{scale}.webm", large, *options)
    (tmp_path / "list").write_text("file 4.webm\nfile 8.webm\n")
    path = tmp_path / "both.webm"
    ffmpeg("-f", "concat", "-i", tmp_path / "list", "-c", "copy", path)
    frames = read(path)[1][0].frames.astype(int)
    assert frames.shape == (24, 16, 16, 3)
    # Edges are smoothed, so look at the middle of each square.
    for start in (0, 12):
        squares = frames[start : start + 12, 2::4, 2::4]
        np.testing.assert_allclose(squares, colours, atol=0 if start == 0 else 40)


# --- folders --------------------------------------------------------------------------


def test_a_folder_is_read_by_name_one_file_at_a_time(tmp_path, monkeypatch):
    lengths = {"b.mp4": 5, "a.mp4": 3, "c.mp4": 4}
    for seed, (name, length) in enumerate(lengths.items()):
        encode_video(tmp_path / name, make_frames(length, seed), *RGB_MP4)
    (tmp_path / ".hidden.mp4").write_bytes(b"not looked at")
    (tmp_path / "README.txt").write_text("about them")
    assert videos.recognises(tmp_path)
    decoded = []
    decode = clips.decode
    monkeypatch.setattr(
        clips,
        "decode",
        lambda path, **kw: decoded.append(path.name) or decode(path, **kw),
    )
    recording = videos.open_recording(tmp_path, max_bytes=LIMIT)
    assert recording.num_episodes == 3
    assert "README.txt" in recording.notes[0]
    assert decoded == []
    for index, (name, seed) in enumerate((("a.mp4", 1), ("b.mp4", 0), ("c.mp4", 2))):
        episode = next(recording.episodes)
        np.testing.assert_array_equal(episode.frames, make_frames(lengths[name], seed))
        assert len(decoded) == index + 1
    assert next(recording.episodes, None) is None


def test_faults_in_a_folder_name_the_file(tmp_path):
    for name, fps in (("a.mp4", 25), ("b.mp4", 50)):
        encode_video(tmp_path / name, make_frames(), *RGB_MP4, fps=fps)
    with pytest.raises(FormatError, match=r"holds b.mp4, which has 50 .* a.mp4 has 25"):
        read(tmp_path)
    content = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(content[:-100])
    with pytest.raises(FormatError, match=r"^holds b.mp4, which is cut off"):
        read(tmp_path)
    (tmp_path / "b.mp4").write_bytes(b"text")
    with pytest.raises(FormatError, match=r"^holds b.mp4, which is no video"):
        read(tmp_path)


def test_folders_without_videos(tmp_path):
    assert not videos.recognises(tmp_path)
    (tmp_path / "a.txt").write_text("text")
    os.mkfifo(tmp_path / "pipe")
    assert not videos.recognises(tmp_path)
    with pytest.raises(FormatError, match="holds no video"):
        read(tmp_path)


# --- faults ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["start.mp4", "pieces.mp4", "two_colours.gif"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path, name):
    path = tmp_path / name
    encode_video(path, make_frames(4), *CODECS[name][0])
    content = path.read_bytes()
    for length in range(12, len(content) - 1, len(content) // 6):
        path.write_bytes(content[:length])
        with pytest.raises(FormatError, match=r"cut off or damaged|has 0 frames"):
            read(path)


def test_a_gif_damaged_in_the_middle_is_refused_and_one_with_a_tail_is_not(tmp_path):
    path = tmp_path / "video.gif"
    encode_video(path, make_frames(), *CODECS["two_colours.gif"][0])
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    assert len(read(path)[1][0].frames) == 12
    middle = content.index(b"\x21\xf9\x04", len(content) // 2)  # a frame begins
    path.write_bytes(content[:middle] + b"\0" + content[middle + 1 :])
    with pytest.raises(FormatError, match=r"damaged after \d frames"):
        videos.open_recording(path, max_bytes=LIMIT)


@pytest.mark.parametrize("num_frames", [1, 3])
def test_two_frames_are_needed(path, num_frames):
    encode_video(path, make_frames(num_frames), *RGB_MP4)
    message = (
        f"has {num_frames} frames, too few to keep two with frame_skip={num_frames}"
    )
    with pytest.raises(FormatError, match=message):
        videos.open_recording(path, max_bytes=LIMIT, frame_skip=num_frames)
    with pytest.raises(ValueError, match="frame_skip = 0"):
        videos.open_recording(path, max_bytes=LIMIT, frame_skip=0)


def test_more_than_the_limit_is_refused_and_the_limit_itself_is_not(path):
    whole = make_frames().nbytes
    assert read(path, max_bytes=whole)[1][0].frames.nbytes == whole
    message = f"12 frames of 16x16 pixels, {whole} bytes, more than the {whole - 1} "
    with pytest.raises(FormatError, match=message):
        videos.open_recording(path, max_bytes=whole - 1)
    # What is skipped takes no room.
    half = read(path, max_bytes=whole // 2, frame_skip=2)[1][0].frames
    assert half.nbytes == whole // 2


def test_frames_that_were_not_announced_are_counted(path, monkeypatch):
    few = clips.probe(path, max_bytes=LIMIT)._replace(num_frames=2)
    monkeypatch.setattr(clips, "probe", lambda *_, **__: few)
    with pytest.raises(FormatError, match="has at least 6 frames"):
        read(path, max_bytes=5 * 16 * 16 * 3)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (
            "P6\\n2 2\\n255\\n' + 'x' * 12 + 'P6\\n1 4\\n255\\n' + 'x' * 12 + '",
            "changes",
        ),
        ("P6\\n2 2\\n255\\n' + 'x' * 11 + '", "cut off or damaged"),
        ("P6\\n2 2\\n65535\\n", "cut off or damaged"),
        ("P6\\n99999 99999\\n255\\n", "29999400003 bytes, more than the 16777216"),
    ],
)
def test_what_ffmpeg_writes_is_not_trusted(path, monkeypatch, output, message):
    code = f"import sys; sys.stdout.write('{output}'); sys.stderr.write('oh')"
    monkeypatch.setattr(clips, "_ffmpeg", lambda *_: run(code))
    with pytest.raises(FormatError, match=message):
        list(clips.decode(path, max_frame_bytes=LIMIT, cpu_seconds=1))


def test_what_cannot_be_opened(tmp_path):
    missing = tmp_path / "none.mp4"
    pipe = tmp_path / "pipe.mp4"
    os.mkfifo(pipe)
    assert not videos.recognises(missing)
    assert not videos.recognises(pipe)
    assert not videos.recognises(pathlib.Path("a\0b"))
    with pytest.raises(FileNotFoundError):
        videos.open_recording(missing, max_bytes=LIMIT)
    with pytest.raises(FormatError, match="is no file"):
        videos.open_recording(pipe, max_bytes=LIMIT)


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
    ffmpeg("-enable_drefs", "1", "-i", path, path.with_name("stolen.gif"))
    assert len(read(path.with_name("stolen.gif"))[1][0].frames) == 12
    with pytest.raises(FormatError, match="has 0 frames"):
        read(path)


# --- the program that reads -----------------------------------------------------------


def run(code):
    command = [sys.executable, "-c", code]
    return child.Child(command, cpu_seconds=1.0, memory_bytes=2**30)


def test_a_program_that_computes_for_ever_is_stopped():
    with run("while True: pass") as program:
        assert program.read_line() == b""
        with pytest.raises(FormatError, match="takes more than 1 s"):
            program.finish()


def test_a_program_that_sleeps_for_ever_is_stopped(monkeypatch):
    monkeypatch.setattr(child, "_WAIT_SECONDS", -1.5)
    with (
        run("import time; time.sleep(99)") as program,
        pytest.raises(FormatError, match="takes more than 1 s"),
    ):
        program.read_line()


def test_a_program_that_fills_the_memory_is_stopped():
    with run("bytearray(3 * 2**30)") as program:
        assert program.read_line() == b""
        assert program.finish() != 0
        assert program.said


def test_complaints_without_end_don_t_stop_it():
    code = "import sys; sys.stderr.write('x' * 2**20); print('done')"
    with run(code) as program:
        assert program.read_line() == b"done"
        assert program.read_line() == b""
        assert program.finish() == 0
        assert set(program.said) == {"x"}


def test_lines_and_bytes_may_alternate():
    with run("print('one'); print('12345two')") as program:
        assert program.read_line() == b"one"
        digits = bytearray(5)
        assert program.read_into(memoryview(digits)) == 5
        assert digits == b"12345"
        assert program.read_line() == b"two"
        assert program.read_into(memoryview(digits)) == 0
        assert program.finish() == 0


def test_a_line_without_end_is_refused():
    with (
        run("print('x' * 10_000_000)") as program,
        pytest.raises(FormatError, match="a line of more than 1000 bytes"),
    ):
        program.read_line()


def test_a_program_that_has_more_to_say_is_not_waited_for():
    with run("print('one' + '\\n' * 10**6); import time; time.sleep(99)") as program:
        assert program.read_line() == b"one"
        assert program.finish() < 0


def test_whoever_stops_listening_ends_the_program(path):
    before = children()
    frames = clips.decode(path, max_frame_bytes=LIMIT, cpu_seconds=5)
    next(frames)
    assert children() > before
    del frames  # a warning about a program that still runs would be an error
    assert children() == before


def children() -> set[str]:
    """Returns the programs that this one has started and not yet buried."""
    tasks = pathlib.Path("/proc/self/task").glob("*/children")
    return {child for task in tasks for child in task.read_text().split()}
