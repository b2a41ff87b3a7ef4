"""`collect`: recording, showing and converting, as people type it."""

import itertools
import os
import subprocess
import time

import numpy as np
import pytest
from PIL import Image

from jaxil import collect
from jaxil.demonstrations import foreign, inspection, loading, states
from jaxil.errors import UsageError
from tests.commands import ROOT, arguments, run
from tests.demonstrations import foreign_files

SHIPPED = states.shipped_path("cartpole_swingup")
SIZES = ("--image_size=16", "--render_quality=fast")


@pytest.fixture(name="few")
def _few(tmp_path):
    """The first 8 steps of two shipped episodes."""
    stored = states.read_states(SHIPPED, num_episodes=2)
    short = stored._replace(
        qpos=stored.qpos[:, :9],
        qvel=stored.qvel[:, :9],
        act=stored.act[:, :9],
        actions=stored.actions[:, :8],
        rewards=stored.rewards[:, :8],
    )
    path = tmp_path / "few.npz"
    states.write_states(path, short)
    return path


def call(*flags: str) -> None:
    collect.main(["collect", *map(str, flags)])


# --- showing --------------------------------------------------------------------------


def test_states_are_shown_as_table_sheet_and_video(few, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "made" / "shown"
    # A task's name stands for its shipped file.
    monkeypatch.setattr(states, "shipped_path", {"cartpole_swingup": few}.get)
    call("--inspect=cartpole_swingup", f"--output={folder}", *SIZES)
    printed = capsys.readouterr().out
    for words in ("format: jaxil states", "task: cartpole_swingup", "episodes: 2"):
        assert words in printed
    assert {path.name for path in folder.iterdir()} == {
        "few_sheet.png",
        "few_episode0.mp4",
    }
    sheet = np.asarray(Image.open(folder / "few_sheet.png"))
    # Two rows of eight pictures, 96 pixels wide at least, with something on them.
    assert sheet.shape[1] > 8 * 96
    assert sheet.std() > 5


@pytest.mark.parametrize("name", ["pickle", "replays", "video", "lerobot", "minari"])
def test_every_format_is_shown(name, tmp_path, capsys):
    if name == "minari":
        pytest.importorskip("minari")
    if name == "lerobot":
        pytest.importorskip("pyarrow")
    source = tmp_path / "source"
    getattr(foreign_files, f"write_{name}")(source, 0)
    call(f"--inspect={source}", f"--output={tmp_path}")
    printed = capsys.readouterr().out
    recording = foreign.open_recording(source, max_bytes=2**30)
    assert f"format: {recording.kind}" in printed
    assert f"episodes: {recording.num_episodes}" in printed
    assert (tmp_path / "source_sheet.png").stat().st_size > 0
    assert (tmp_path / "source_episode0.mp4").stat().st_size > 0


def test_showing_a_video_leaves_it_as_it_is(tmp_path, monkeypatch):
    video = tmp_path / "clip.mp4"
    foreign_files.write_video(video, 0)
    before = video.read_bytes()
    monkeypatch.chdir(tmp_path)
    call("--inspect=clip.mp4")
    assert video.read_bytes() == before
    assert (tmp_path / "clip_episode0.mp4").exists()


@pytest.mark.parametrize(
    ("brightness", "expected"),
    [
        # One short event in a hundred frames, which even spacing would miss.
        ([0] * 50 + [250] + [100] * 49, [0, 250, 100]),
        # The first, the farthest, then halves.
        (range(0, 150, 10), [0, 10, 30, 50, 70, 100, 120, 140]),
        ([40] * 5, [40]),
    ],
)
def test_the_sheet_shows_the_frames_that_differ_most(brightness, expected, tmp_path):
    frames = np.array(brightness, np.uint8)[:, None, None, None]
    path = tmp_path / "pixels.npy"
    np.save(path, np.broadcast_to(frames, (len(frames), 8, 8, 3)))
    seen = inspection.inspect(path, max_bytes=2**20, image_size=8)
    sheet = np.asarray(inspection.contact_sheet(seen))
    row = sheet[-20, :, 0]  # a line through the pictures
    shown = [value for value, _ in itertools.groupby(row.tolist()) if value != 24]
    assert shown == expected


# --- converting -----------------------------------------------------------------------


def test_states_become_pixels_that_serve_as_the_states_do(few, tmp_path, capsys):
    output = tmp_path / "pixels.npz"
    call("--convert", few, output, *SIZES)
    assert "2 episodes of jaxil states" in capsys.readouterr().out
    call(f"--inspect={output}", f"--output={tmp_path}")
    assert "origin: jaxil states" in capsys.readouterr().out
    settings = {
        "task": "cartpole_swingup",
        "num_episodes": 2,
        "action_repeat": 2,
        "image_size": 16,
        "render_quality": "fast",
    }
    one, other = (loading.load(path, **settings) for path in (few, output))
    np.testing.assert_array_equal(one.frames, other.frames)
    np.testing.assert_array_equal(one.actions, other.actions)
    np.testing.assert_allclose(
        one.metadata["returns"], other.metadata["returns"], rtol=1e-6
    )
    assert other.metadata["frames_per_second"] == pytest.approx(50.0)


def test_pixels_keep_their_size_unless_another_is_asked_for(tmp_path):
    source, output = tmp_path / "source", tmp_path / "out.npz"
    foreign_files.write_pickle(source, 0)
    stored = next(foreign.open_recording(source, max_bytes=2**30).episodes).frames
    call(f"--convert={source}", f"--output={output}", "--frame_skip=2")
    kept = next(foreign.open_recording(output, max_bytes=2**30).episodes).frames
    np.testing.assert_array_equal(
        kept, stored[: len(stored) // 2 * 2 + 1 : 2][: len(kept)]
    )
    call(f"--convert={source}", f"--output={output}", "--image_size=10")
    small = next(foreign.open_recording(output, max_bytes=2**30).episodes).frames
    assert small.shape == (len(stored), 10, 10, 3)


# --- wrong use ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], "exactly one of --workdirs, --policy, --inspect, --convert"),
        ([], "--output=NAME.npz is missing"),
        (["--inspect=a", "--convert=b", "--output=c"], "given: --inspect, --convert"),
        (["--convert=a"], "--output=NAME.npz is missing"),
        (["--convert=a", "--output=."], "is a folder"),
        (["--convert=a.npz", "--output=./a.npz"], "is the file to convert"),
        (["--workdirs=a", "--output=/proc/x.npz"], "cannot be written"),
        (["--inspect=none.npz"], "none.npz: no such file or folder, and no task"),
        (["--inspect=my:make"], "demonstrations; these are acrobot_swingup, ball"),
        (["--inspect=setup.cfg"], "in an unsupported format"),
        (["--inspect=setup.cfg", "--output=setup.cfg"], "must be a folder"),
        (["--convert=setup.cfg", "--output=x.npz"], "in an unsupported format"),
        (["--convert", "a", "b", "c"], "'c' is not a flag"),
        (
            ["--convert=a", "--output=b", "--action_repeat=3"],
            "--action_repeat is not fo",
        ),
        (["--inspect=setup.cfg", "--fit=pad"], "--fit is not for --inspect"),
        (["--inspect=walker_walk", "--frame_skip=2"], "--frame_skip is for pixels"),
        (
            ["--convert=walker_walk", "--output=x.npz", "--camera=a", "--fit=pad"],
            "--fit is for pixels",
        ),
        (["--inspect=a", "--image_size=2"], "image_size"),
        (["--inspect=a", "--render_quality=good"], "render_quality"),
    ],
)
def test_wrong_use_is_said_in_one_message(flags, expected, monkeypatch):
    monkeypatch.chdir(ROOT)
    with pytest.raises(UsageError) as caught:
        call(*flags)
    assert expected in str(caught.value)


def test_wrong_use_ends_with_status_2_and_no_traceback(tmp_path):
    damaged = tmp_path / "demos.npz"
    damaged.write_bytes(SHIPPED.read_bytes()[:5000])
    finished = run("collect", f"--inspect={damaged}")
    assert finished.returncode == 2
    assert str(damaged) in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_name_that_the_terminal_cannot_show_ends_no_command(few, tmp_path):
    output = os.fsencode(tmp_path) + b"/\xff.npz"
    words = arguments("collect", f"--convert={few}", "--image_size=8")
    done = subprocess.run(
        [*words, b"--output=" + output],
        check=False,
        cwd=ROOT,
        env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert b"\\udcff.npz: 2 episodes" in done.stdout


def test_killed_while_writing_leaves_the_old_file(few, tmp_path):
    output = tmp_path / "pixels.npz"
    command = arguments("collect", f"--convert={SHIPPED}", f"--output={output}", *SIZES)
    output.write_bytes(few.read_bytes())
    process = subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    while not list(tmp_path.glob(".tmp-*")):
        assert process.poll() is None
        time.sleep(0.02)
    time.sleep(0.3)
    process.kill()
    assert process.wait() < 0  # it would have taken seconds
    assert output.read_bytes() == few.read_bytes()
