"""Foreign files as the agent gets them: size, frame skip, lengths, and warnings."""

import contextlib
import logging
import os
import pathlib
import tracemalloc

import numpy as np
import pytest

from jaxil.demonstrations import foreign, sampling
from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.frames import resized
from jaxil.demonstrations.readers.recording import (
    FormatError,
    PixelEpisode,
)
from jaxil.demonstrations.states import DemonstrationError
from tests.bounds import bounded
from tests.demonstrations import foreign_files
from tests.demonstrations.lerobot_datasets import DATA_FILE, VIDEO_FILE
from tests.demonstrations.pixel_files import (
    LIMIT,
    TASK,
    check,
    load,
    make_episode,
    write,
)
from tests.demonstrations.test_readers_fuzz import FORMATS


def known(array: np.ndarray | None) -> np.ndarray:
    assert array is not None
    return array


@pytest.fixture(name="path")
def _path(tmp_path):
    return tmp_path / "pixels.npz"


# --- what the agent gets --------------------------------------------------------------


def test_frames_are_resized_without_skipping_pixels():
    # Stripes one pixel wide are grey when seen from afar; a reader that took every
    # fourth pixel would see only one colour.
    stripes = np.zeros((32, 32, 3), np.uint8)
    stripes[:, ::2] = 255
    small = resized(stripes, (8, 8))
    assert small.shape == (8, 8, 3)
    assert abs(small[1:-1, 1:-1].astype(float).mean() - 127.5) < 4
    assert small[1:-1, 1:-1].std() < 4
    assert resized(stripes, (32, 32)) is stripes
    flat = np.full((6, 10, 3), 99, np.uint8)
    np.testing.assert_array_equal(resized(flat, (8, 8)), np.full((8, 8, 3), 99))


def test_frame_skip_keeps_every_nth_frame_and_all_rewards(path):
    episodes = [make_episode(6), make_episode(5, seed=1)]
    write(path, episodes, frames_per_second=100.0, action_repeat=1)
    loaded = load(path, frame_skip=2)
    assert loaded.metadata["frames_per_second"] == 50.0
    assert loaded.metadata["action_repeat"] == 2
    np.testing.assert_array_equal(loaded.num_frames, [4, 3])
    np.testing.assert_array_equal(loaded.frames[0], episodes[0].frames[::2])
    np.testing.assert_array_equal(loaded.frames[1, :3], episodes[1].frames[:5:2])
    np.testing.assert_array_equal(loaded.frames[1, 3], episodes[1].frames[4])
    actions = [known(episode.actions) for episode in episodes]
    np.testing.assert_array_equal(known(loaded.actions)[0], actions[0][::2])
    np.testing.assert_array_equal(known(loaded.actions)[1, :2], actions[1][:4:2])
    rewards = [known(episode.rewards) for episode in episodes]
    np.testing.assert_allclose(
        loaded.metadata["returns"],
        [rewards[0].sum(), rewards[1][:4].sum()],
        rtol=1e-6,
    )
    with pytest.raises(DemonstrationError, match="too few for frame_skip=6"):
        load(path, frame_skip=6)


def test_sampling_by_time_repeats_frames_of_longer_steps(path):
    episode = make_episode(3)
    write(path, [episode], action_repeat=4)
    loaded = load(path, num_episodes=1, sampling="time")
    # Agent steps at 0, 0.5, ... 3 of the file's; ties go to the later one.
    nearest = [0, 1, 1, 2, 2, 3, 3]
    np.testing.assert_array_equal(loaded.frames[0], episode.frames[nearest])
    actions = known(episode.actions)[[0, 1, 1, 2, 2, 2]]
    np.testing.assert_array_equal(known(loaded.actions)[0], actions)
    np.testing.assert_allclose(
        loaded.metadata["returns"], [known(episode.rewards).sum()], rtol=1e-6
    )
    needed = 2 * episode.frames.nbytes
    with pytest.raises(DemonstrationError, match=f"than the {needed - 1} bytes"):
        load(path, num_episodes=1, sampling="time", max_bytes=needed - 1)


def test_tiny_frames_are_not_enlarged_beyond_the_limit(path):
    many = make_episode(4000, size=1)
    write(path, [many])
    tracemalloc.start()
    with pytest.raises(DemonstrationError, match="has frames at 64x64 of"):
        load(path, num_episodes=1, image_size=64, max_bytes=10**6)
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def test_actions_count_towards_the_limit(path):
    episodes = [make_episode(6, seed=n, action_dim=10_000) for n in range(4)]
    write(path, episodes)
    one = episodes[0]
    needed = 4 * sum(array.nbytes for array in one if isinstance(array, np.ndarray))
    load(path, num_episodes=4, action_repeat=1, max_bytes=needed)
    with pytest.raises(DemonstrationError, match="needs more than"):
        load(path, num_episodes=4, action_repeat=1, max_bytes=needed - 1)


def test_the_first_episodes_are_taken_and_padded_with_their_last_frames(path):
    episodes = [make_episode(n, seed=n) for n in (3, 6, 4)]
    write(path, episodes)
    loaded = load(path, num_episodes=3)
    np.testing.assert_array_equal(loaded.num_frames, [4, 7, 5])
    assert loaded.frames.shape == (3, 7, 8, 8, 3)
    for row, episode in zip(loaded.frames, episodes, strict=True):
        length = len(episode.frames)
        np.testing.assert_array_equal(row[:length], episode.frames)
        assert (row[length:] == episode.frames[-1]).all()
    one = load(path, num_episodes=1)
    np.testing.assert_array_equal(one.frames, episodes[0].frames[None])


def test_samples_come_from_every_frame_and_no_padding(path):
    # The value of a frame is its episode and time; padding would repeat the last one.
    episodes = []
    for index, num_steps in enumerate((2, 5)):
        times = np.arange(num_steps + 1, dtype=np.uint8) + 10 * index
        frames = np.broadcast_to(times[:, None, None, None], (num_steps + 1, 8, 8, 3))
        actions = times[:-1, None].astype(np.float32)
        episodes.append(PixelEpisode(frames.copy(), actions))
    write(path, episodes)
    loaded = load(path)
    observations, actions, _ = sampling.sample(
        loaded, np.random.default_rng(0), 500, frame_stack=2
    )
    newest = observations[:, 0, 0, -1]
    assert set(newest.tolist()) == {0, 1, 10, 11, 12, 13, 14}
    np.testing.assert_array_equal(newest, actions[:, 0])
    before = np.where(newest % 10 == 0, newest, newest - 1)
    np.testing.assert_array_equal(observations[:, 0, 0, 0], before)
    counts = np.unique(newest, return_counts=True)[1]
    assert counts.min() > 500 / 7 * 0.6, "each transition is as likely as another"


def test_what_only_some_episodes_have_is_left_out(path):
    episodes = [make_episode(), make_episode()._replace(actions=None, rewards=None)]
    loaded = load(write(path, episodes))
    assert loaded.actions is None
    assert loaded.task_rewards is None
    assert loaded.mean_return() is None
    sampled, actions, _ = sampling.sample(
        loaded, np.random.default_rng(0), 4, frame_stack=1
    )
    assert sampled.shape == (4, 8, 8, 3)
    assert actions.shape == (4, 0)


# --- warnings and refusals ------------------------------------------------------------


def test_a_file_that_matches_is_warned_of_its_renderer_alone(path, caplog):
    write(path, [make_episode(), make_episode()], frames_per_second=50.0)
    with caplog.at_level(logging.WARNING):
        load(path)
    assert "renderer" in caplog.text
    assert "resized" not in caplog.text
    assert "frames per second" not in caplog.text
    assert "action_repeat" not in caplog.text


def test_mismatches_are_warned_of(path, caplog):
    episode = make_episode()._replace(frames=np.zeros((7, 6, 12, 3), np.uint8))
    write(path, [episode, episode], action_repeat=4, frames_per_second=25.0)
    with caplog.at_level(logging.WARNING):
        load(path)
    assert "12x6 pixels are resized to 8x8, stretched" in caplog.text
    assert "action_repeat=4, but the run has 2" in caplog.text
    assert "25 frames per second, but the agent makes 50 steps" in caplog.text
    assert "a test" not in caplog.text  # its origin is no fault


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_episodes": 3}, "holds 2 episodes, but num_episodes=3"),
        ({"num_episodes": 0}, "num_episodes=0"),
        ({"task": "walker_walk"}, f"shows {TASK}, but the task is walker_walk"),
        ({"observation": "state"}, "holds pixels"),
        ({"image_size": 9, "max_bytes": 3000}, "needs more than 3000 bytes"),
        ({"max_bytes": 1000}, "more than the 1000"),
    ],
)
def test_a_file_that_cannot_serve(path, changes, message):
    write(path, [make_episode(), make_episode()], task=TASK)
    for call in (load, check):
        with pytest.raises(DemonstrationError, match=message) as caught:
            call(path, **changes)
        assert str(path) in str(caught.value)


def test_padding_counts_towards_the_limit(path):
    episodes = [make_episode(9), make_episode(1), make_episode(1)]
    write(path, episodes)
    padded = 3 * (episodes[0].frames.nbytes + 9 * 4 + 9 * 4)  # actions, rewards
    load(path, num_episodes=3, max_bytes=padded)
    with pytest.raises(DemonstrationError, match="bytes for 3 episodes"):
        load(path, num_episodes=3, max_bytes=padded - 1)


def test_actions_are_needed_only_where_they_are_seen(path):
    write(path, [make_episode(action_dim=3)])
    check(path, num_episodes=1)
    with pytest.raises(DemonstrationError, match=r"actions of 3 numbers.*needs 1"):
        check(path, num_episodes=1, sees_actions=True)
    write(path, [make_episode()._replace(actions=None)])
    with pytest.raises(DemonstrationError, match="holds no actions"):
        check(path, num_episodes=1, sees_actions=True)


@pytest.mark.parametrize("content", [None, b"", b"hello", b"PK\x03\x04", "folder"])
def test_what_no_reader_knows_is_refused(path, content):
    if content == "folder":
        path.mkdir()
        (path / "notes.txt").write_text("nothing")
    elif content is not None:
        path.write_bytes(content)
    message = "cannot be read" if content is None else "damaged or in an unsupported"
    with pytest.raises(DemonstrationError, match=message) as caught:
        load(path)
    assert str(caught.value).startswith(str(path))


def test_a_file_is_read_once_until_it_changes(path, monkeypatch):
    write(path, [make_episode(), make_episode()])
    calls = []
    read = foreign.read_episodes

    def counted(*args, **kwargs):
        calls.append(args)
        return read(*args, **kwargs)

    monkeypatch.setattr(foreign, "read_episodes", counted)
    check(path)
    first = load(path)
    assert len(calls) == 1
    write(path, [make_episode(seed=5), make_episode(seed=6)])
    assert not np.array_equal(load(path).frames, first.frames)
    assert len(calls) == 2


# --- what is never opened -------------------------------------------------------------


@pytest.mark.parametrize("source", ["/dev/zero", "/dev/full", "pipe", "pipe.mp4"])
def test_only_regular_files_and_folders_are_opened(source, tmp_path):
    path = pathlib.Path(source)
    if source.startswith("pipe"):
        path = tmp_path / source
        os.mkfifo(path)
    with (
        bounded(seconds=5.0),
        pytest.raises(DemonstrationError, match="is a pipe, device or sock"),
    ):
        load(path)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("minari", "data/metadata.json"),
        ("minari", "data/main_data.hdf5"),
        ("lerobot", "meta/info.json"),
        ("lerobot", DATA_FILE),
        ("lerobot", VIDEO_FILE),
        ("replays", "20220101T000000_0_3.npz"),
        ("videos", "b.mp4"),
    ],
)
def test_pipes_in_a_folder_are_not_opened(name, file, tmp_path):
    pytest.importorskip(FORMATS[name].library)
    source = tmp_path / "source"
    if name == "videos":
        source.mkdir()
        foreign_files.write_video(source / "a.mp4", 0)
    else:
        getattr(foreign_files, FORMATS[name].write)(source, 0)
    (source / file).unlink(missing_ok=True)
    os.mkfifo(source / file)
    # Nobody writes into the pipe. A folder of replays is still read without it.
    refused = contextlib.nullcontext()
    if name != "replays":
        refused = pytest.raises(FormatError)
    with bounded(), refused:
        (_,) = foreign.open_recording(source, max_bytes=LIMIT).episodes


# --- all formats ----------------------------------------------------------------------


@pytest.mark.parametrize("name", FORMATS)
def test_each_format_gives_the_same_demonstrations_after_conversion(
    name, tmp_path, path
):
    pytest.importorskip(FORMATS[name].library)
    source = tmp_path / "source"
    getattr(foreign_files, FORMATS[name].write)(source, 0)
    recording = foreign.open_recording(source, max_bytes=LIMIT)
    assert (recording.kind == "jaxil pixels") == (name == "own")
    own.write_pixels(path, recording, origin="a test")
    count = recording.num_episodes
    before, after = (load(p, num_episodes=count) for p in (source, path))
    np.testing.assert_array_equal(before.frames, after.frames)
    assert before.frames.std() > 0
    for name in ("actions", "task_rewards"):
        one, other = getattr(before, name), getattr(after, name)
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one, other)


def test_a_dataset_with_a_preview_is_no_folder_of_videos(tmp_path):
    folder = tmp_path / "replay"
    foreign_files.write_replays(folder, 0)
    foreign_files.write_video(folder / "preview.mp4", 0)
    recording = foreign.open_recording(folder, max_bytes=LIMIT)
    assert "replay" in recording.kind


def test_the_fuzzer_knows_every_format():
    writers = {name for name in dir(foreign_files) if name.startswith("write_")}
    assert writers == {form.write for form in FORMATS.values()}
    assert len(writers) == len(foreign._READERS)
