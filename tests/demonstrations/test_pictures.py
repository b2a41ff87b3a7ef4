"""Folders of pictures, NumPy images, other shapes and rates, useless episodes."""

import functools
import logging

import numpy as np
import pytest
from PIL import Image

from jaxil.demonstrations import loading
from jaxil.demonstrations.readers import pictures
from jaxil.demonstrations.readers.frames import resized
from jaxil.demonstrations.readers.recording import FormatError
from jaxil.demonstrations.states import DemonstrationError
from jaxil.environments import tasks
from tests.demonstrations import foreign_files, pixel_files
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.pixel_files import TASK
from tests.demonstrations.videos import encode_video

FRAMES = np.random.default_rng(0).integers(0, 256, (12, 8, 8, 3), dtype=np.uint8)
GRAY = FRAMES[..., 0]


load = functools.partial(pixel_files.load, num_episodes=1)


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        (FRAMES, FRAMES),
        (GRAY, GRAY[..., None].repeat(3, axis=3)),
        (GRAY[..., None], GRAY[..., None].repeat(3, axis=3)),
        (np.concatenate([FRAMES, FRAMES[..., :1]], axis=3), FRAMES),
        (FRAMES.astype(np.uint16) * 257, FRAMES),
        (FRAMES.astype(np.float32) / 255.0, FRAMES),
    ],
    ids=["rgb", "gray", "one channel", "rgba", "uint16", "float"],
)
def test_arrays_of_many_kinds(images, expected, tmp_path):
    path = tmp_path / "images.npy"
    np.save(path, images)
    _, (episode,) = read_here(pictures, path)
    np.testing.assert_array_equal(episode.frames, expected)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (FRAMES.astype(np.float32), "outside"),
        (FRAMES.transpose(0, 3, 1, 2), "has shape"),
        (FRAMES.astype(np.int64), "type int64"),
    ],
)
def test_other_arrays_are_refused(images, message, tmp_path):
    path = tmp_path / "images.npy"
    np.save(path, images)
    with pytest.raises(FormatError, match=message):
        read_here(pictures, path)


def test_pictures_are_read_in_the_order_of_their_numbers(tmp_path):
    for index, frame in enumerate(FRAMES):
        Image.fromarray(frame).save(tmp_path / f"frame{index}.png")
    (tmp_path / "notes.txt").write_text("about them")
    recording, (episode,) = read_here(pictures, tmp_path)
    assert recording.notes == ("notes.txt in its folder: not read.",)
    np.testing.assert_array_equal(episode.frames, FRAMES)
    deep = Image.fromarray(GRAY[0].astype(np.uint16) * 257)
    deep.save(tmp_path / "frame0.png")
    _, (episode,) = read_here(pictures, tmp_path)
    np.testing.assert_array_equal(episode.frames[0], GRAY[0][..., None].repeat(3, 2))


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda folder: (folder / "3.png").write_text(""), "3.png, which is no PNG"),
        (
            lambda folder: (folder / "3.JPG").symlink_to("gone"),
            "3.JPG, which is no PNG",
        ),
        (
            lambda folder: Image.fromarray(FRAMES[0, :4]).save(folder / "3.png"),
            "has pictures of 8x8 and 8x4 pixels",
        ),
        (
            lambda folder: (
                (folder / "next").mkdir(),
                (folder / "next" / "0.png").write_text(""),
            ),
            "0.png, which is no PNG",
        ),
    ],
)
def test_no_picture_is_left_out_silently(add, message, tmp_path):
    for index in range(3):
        Image.fromarray(FRAMES[index]).save(tmp_path / f"{index}.png")
    add(tmp_path)
    with pytest.raises(FormatError, match=message):
        read_here(pictures, tmp_path)


def test_what_lies_beside_frames_is_named(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in ("0.png", "1.png", "masks/0.png"):
        Image.fromarray(FRAMES[0]).save(tmp_path / name)
    (tmp_path / "old.png").mkdir()
    recording, (episode,) = read_here(pictures, tmp_path)
    assert recording.notes == ("masks and 1 more in its folder: not read.",)
    assert len(episode.frames) == 2


def test_a_preview_beside_an_array_is_ignored(tmp_path):
    np.save(tmp_path / "images.npy", FRAMES)
    Image.fromarray(FRAMES[0]).save(tmp_path / "preview.png")
    recording, (episode,) = read_here(pictures, tmp_path)
    assert recording.notes == ("preview.png in its folder: not read.",)
    np.testing.assert_array_equal(episode.frames, FRAMES)


def test_shapes_become_squares_in_three_ways():
    frame = np.zeros((6, 12, 3), np.uint8)
    frame[:, :3] = 100
    frame[:, 3:9] = 200
    assert set(np.unique(resized(frame, (6, 6), "crop"))) == {200}
    padded = resized(frame, (12, 12), "pad")
    assert padded[0].max() == padded[-1].max() == 0
    np.testing.assert_array_equal(padded[3:9], frame)
    assert resized(frame, (6, 6))[:, 0].max() <= 130


@pytest.mark.parametrize("fps", [30, 50, 100, 120])
def test_videos_are_sampled_by_time(fps, tmp_path):
    path = tmp_path / "video.mp4"
    encode_video(path, FRAMES.repeat(2, axis=1).repeat(2, axis=2), fps=fps)
    loaded = load(path, sampling="time", image_size=16)
    seconds, _ = tasks.timing(TASK, 2)
    num_steps = int(11 / fps / seconds + 1e-6)  # type: ignore[operator]
    assert loaded.frames.shape[1] == num_steps + 1
    for step, frame in enumerate(loaded.frames[0]):
        shown = FRAMES[round(step * seconds * fps + 1e-9)]  # type: ignore[operator]
        np.testing.assert_array_equal(frame[::2, ::2], shown)


def test_what_has_no_rate_is_sampled_by_its_stated_action_repeat(tmp_path):
    path = tmp_path / "images.npy"
    np.save(path, FRAMES)
    with pytest.raises(DemonstrationError, match=r"demonstrations\.action_repeat"):
        load(path, sampling="time")
    loaded = load(path, sampling="time", stated_action_repeat=1)
    np.testing.assert_array_equal(loaded.frames[0], FRAMES[:11:2])


@pytest.mark.parametrize("name", ["images.npy", "video.mp4"])
def test_skipped_frames_count_in_a_stated_action_repeat(name, tmp_path, caplog):
    path = tmp_path / name
    if name == "images.npy":
        np.save(path, FRAMES)
    else:
        encode_video(path, FRAMES, fps=100)
    with caplog.at_level(logging.WARNING):
        loaded = load(path, frame_skip=2, stated_action_repeat=1)
    assert loaded.metadata["action_repeat"] == 2
    assert "action_repeat" not in caplog.text


def test_a_default_number_of_episodes_takes_what_there_is(tmp_path, caplog):
    path = tmp_path / "images.npy"
    np.save(path, FRAMES)
    with pytest.raises(DemonstrationError, match=r"demonstrations\.num_episodes=1"):
        load(path, num_episodes=10)
    with caplog.at_level(logging.WARNING):
        assert len(loading.load(path, task=TASK).frames) == 1
    assert "1 of 10 episodes" in caplog.text


def test_what_cannot_be_learned_from_is_warned_of(tmp_path, caplog):
    still = tmp_path / "still.npy"
    np.save(still, FRAMES[:1].repeat(4, axis=0))
    with caplog.at_level(logging.WARNING):
        load(still)
    assert "nothing ever changes: 0" in caplog.text
    assert "3 steps, but the agent's 500" in caplog.text
    caplog.clear()
    load(still, max_episode_frames=6)  # three agent steps
    assert "but the agent's" not in caplog.text
    own = tmp_path / "own.npz"
    foreign_files.write_own(own, 1)
    with np.load(own) as stored:
        arrays = dict(stored)
    arrays["actions_0"] = arrays["actions_0"] * 3
    arrays["rewards_0"] = arrays["rewards_0"] * 0
    np.savez(own, **arrays)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        load(own)
    assert "but the agent's lie in [-1, 1]" in caplog.text
    assert "task return is 0" in caplog.text
