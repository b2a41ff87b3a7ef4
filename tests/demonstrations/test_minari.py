"""Minari datasets written by Minari itself, and files made to mislead."""

import gc
import json
import sys
import warnings

import numpy as np
import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import minari, sandbox
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import make_minari_dataset, read_here

pytest.importorskip("minari", reason="Minari writes the datasets of these tests")
gymnasium = pytest.importorskip("gymnasium")
h5py = pytest.importorskip("h5py")


def make_episode(num_steps, seed=0, size=8):
    rng = np.random.default_rng(seed)
    return {
        "observations": rng.integers(
            0, 256, (num_steps + 1, size, size, 3), dtype=np.uint8
        ),
        "actions": rng.uniform(-1, 1, (num_steps, 2)).astype(np.float32),
        "rewards": rng.uniform(size=num_steps),
    }


EPISODES = [make_episode(3), make_episode(5, seed=1)]


def read(path, **options):
    return read_here(minari, path, **options)


@pytest.fixture(name="path")
def _path(tmp_path):
    make_minari_dataset(tmp_path / "dataset", EPISODES)
    return tmp_path / "dataset"


def change(path, function):
    """Applies `function` to the dataset's open HDF5 file."""
    with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
        function(file)


def set_metadata(path, **values):
    file = path / "data" / "metadata.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


# --- what is read ---------------------------------------------------------------------


@pytest.mark.parametrize("inner", ["", "data"])
def test_what_minari_writes_is_read(path, inner):
    assert minari.recognises(path / inner)
    recording, episodes = read(path / inner)
    assert recording.num_episodes == len(episodes) == 2
    assert recording.task is None
    assert recording.notes == ()
    for episode, expected in zip(episodes, EPISODES, strict=True):
        np.testing.assert_array_equal(episode.frames, expected["observations"])
        np.testing.assert_array_equal(episode.actions, expected["actions"])
        rewards = expected["rewards"].astype(np.float32)
        np.testing.assert_array_equal(episode.rewards, rewards)
        for array, kind in zip(episode, ("uint8", "float32", "float32"), strict=False):
            assert array is not None
            assert array.dtype == kind


def test_what_an_environment_did_is_read(tmp_path, monkeypatch):
    """The collector of Minari, on an environment that counts."""
    from minari import DataCollector

    class Counter(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(0, 255, (4, 4, 3), np.uint8)
        action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

        def picture(self):
            return np.full((4, 4, 3), 10 * self.time, np.uint8)

        def reset(self, *, seed=None, options=None):
            self.time = 0
            return self.picture(), {}

        def step(self, action):
            self.time += 1
            return self.picture(), float(self.time), self.time == 4, False, {}

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    environment = DataCollector(Counter())
    for episode in range(2):
        environment.reset()
        for time in range(4):
            environment.step(np.array([time / 8 + episode / 2], np.float32))
    with warnings.catch_warnings():
        # That nobody signed it, and that Minari leaves a folder to be cleaned up.
        warnings.simplefilter("ignore")
        environment.create_dataset("counting-v0")
        del environment
        gc.collect()
    _, episodes = read(tmp_path / "counting-v0")
    assert len(episodes) == 2
    for index, episode in enumerate(episodes):
        assert episode.frames[:, 0, 0, 0].tolist() == [0, 10, 20, 30, 40]
        assert episode.actions is not None
        expected = [time / 8 + index / 2 for time in range(4)]
        assert episode.actions[:, 0].tolist() == expected
        assert episode.rewards is not None
        assert episode.rewards.tolist() == [1, 2, 3, 4]


def test_episodes_are_in_the_order_of_their_numbers(tmp_path):
    many = [make_episode(1, seed) for seed in range(11)]
    make_minari_dataset(tmp_path / "many", many)
    for episode, expected in zip(read(tmp_path / "many")[1], many, strict=True):
        np.testing.assert_array_equal(episode.frames, expected["observations"])


@pytest.mark.parametrize("kind", ["equal", "unequal"])
def test_jpegs_are_read_with_a_note(tmp_path, kind):
    rng = np.random.default_rng(0)
    episode = make_episode(3, size=32)
    # One colour for each image; noise of a few grey levels makes lengths unequal.
    colours = rng.integers(50, 200, (4, 1, 1, 3))
    noise = rng.integers(0, 9, (4, 32, 32, 1)) * np.arange(4)[:, None, None, None]
    images = colours + (noise if kind == "unequal" else 0)
    if kind == "equal":
        images = np.broadcast_to(images[:1], (4, 32, 32, 3))
    episode["observations"] = images.astype(np.uint8)
    make_minari_dataset(tmp_path / "jpeg", [episode])
    with h5py.File(tmp_path / "jpeg" / "data" / "main_data.hdf5") as file:
        assert file["episode_0/observations"].ndim == (2 if kind == "equal" else 1)
    recording, (seen,) = read(tmp_path / "jpeg")
    assert "JPEG" in recording.notes[0]
    assert seen.frames.shape == (4, 32, 32, 3)
    difference = seen.frames.astype(int) - images
    assert np.abs(difference.mean(axis=(1, 2))).max() < 4
    # Without JPEG, nothing is lost.
    make_minari_dataset(tmp_path / "raw", [episode], jpeg_encoding=False)
    recording, (seen,) = read(tmp_path / "raw")
    assert recording.notes == ()
    np.testing.assert_array_equal(seen.frames, images)


def with_dictionary(*images, num_steps=3):
    episode = make_episode(num_steps)
    space = {name: gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8) for name in images}
    space["speed"] = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    observations = dict.fromkeys(images, episode["observations"])
    observations["speed"] = np.zeros((num_steps + 1, 3), np.float32)
    return {**episode, "observations": observations}, gymnasium.spaces.Dict(space)


def test_the_one_image_of_a_dictionary_is_taken(tmp_path):
    episode, space = with_dictionary("camera")
    make_minari_dataset(tmp_path / "a", [episode], observation_space=space)
    expected = episode["observations"]["camera"]
    np.testing.assert_array_equal(read(tmp_path / "a")[1][0].frames, expected)
    # One level further down.
    nested = {**episode, "observations": {"eyes": episode["observations"]}}
    space = gymnasium.spaces.Dict({"eyes": space})
    make_minari_dataset(tmp_path / "b", [nested], observation_space=space)
    np.testing.assert_array_equal(read(tmp_path / "b")[1][0].frames, expected)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (("left", "right"), "has 2 images.* not one: .*/left of .*/right of"),
        ((), r"has 0 images.* not one: .*speed of float32 \(4, 3\)"),
    ],
)
def test_dictionaries_without_one_image_are_refused(tmp_path, images, message):
    episode, space = with_dictionary(*images)
    make_minari_dataset(tmp_path / "a", [episode], observation_space=space)
    with pytest.raises(FormatError, match=message):
        read(tmp_path / "a")


def test_discrete_actions_are_left_out_with_a_note(tmp_path):
    episode = {**make_episode(3), "actions": np.array([1, 0, 2])}
    make_minari_dataset(tmp_path / "a", [episode])
    recording, (seen,) = read(tmp_path / "a")
    assert seen.actions is None
    assert "actions" in recording.notes[0]


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("dm_control/ball_in_cup-catch-v0", "ball_in_cup_catch"),
        ("CartPole-v1", None),
        (["dm_control/a-b-v0"], None),
    ],
)
def test_the_task_is_known_where_it_is_one_of_dm_control(path, name, task):
    set_metadata(path, env_spec=json.dumps({"id": name}))
    assert read(path)[0].task == task


# --- faults ---------------------------------------------------------------------------


def replace(name, **arguments):
    def function(file):
        del file[name]
        file.create_dataset(name, **arguments)

    return function


def link(name, target):
    def function(file):
        del file[name]
        file[name] = target

    return function


def endless(file):
    del file[IMAGES]
    group = file.create_group(IMAGES)
    group["again"] = group


def claim_more(file):
    """Many images, none of which is stored."""
    del file["episode_0/observations"]
    file.create_dataset(
        "episode_0/observations",
        (1000, 8, 8, 3),
        np.uint8,
        chunks=(1, 8, 8, 3),
        fillvalue=3,
    )


def virtual(file):
    layout = h5py.VirtualLayout((4, 8, 8, 3), np.uint8)
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4, 8, 8, 3))
    del file["episode_0/observations"]
    file.create_virtual_dataset("episode_0/observations", layout)


IMAGES = "episode_0/observations"
FAULTS = {
    "a length too few": (
        replace("episode_1/rewards", data=np.zeros(4)),
        r"rewards of type float64 and shape \(4,\) in episode 1, but numbers of 5",
    ),
    "no observations": (
        lambda f: f["episode_0"].pop("observations"),
        "observations in",
    ),
    "a gap": (lambda f: f.move("episode_0", "episode_7"), "numbered from 0"),
    "no episodes": (lambda f: f.clear(), "numbered from 0"),
    "grey": (
        replace(IMAGES, data=np.zeros((4, 8, 8, 1), np.uint8)),
        r"has 0 images, uint8 \[H, W, 3\]",
    ),
    "values in another file": (
        replace(
            IMAGES,
            shape=(4, 8, 8, 3),
            dtype=np.uint8,
            external=[("/etc/passwd", 0, 768)],
        ),
        "stores /episode_0/observations in another file",
    ),
    "values of another dataset": (virtual, "in another file"),
    "external link": (
        link(IMAGES, h5py.ExternalLink("/etc/passwd", "/")),
        "has a link in place of observations",
    ),
    "soft link": (
        link("episode_0/rewards", h5py.SoftLink("/episode_1/rewards")),
        "has a link in place of rewards",
    ),
    "more than is stored": (claim_more, "stores 0 of 192000 bytes"),
    "an endless dictionary": (endless, "has 0 images"),
    "unknown filter": (
        replace(IMAGES, data=np.zeros((4, 8, 8, 3), np.uint8), scaleoffset=0),
        "with unsupported filters",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_files_that_break_the_rules_are_refused(path, name):
    function, message = FAULTS[name]
    change(path, function)
    with pytest.raises(FormatError, match=message) as caught:
        read(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("packing", ["gzip", "lzf"])
def test_usual_packing_is_read(path, packing):
    images = EPISODES[0]["observations"]
    options = {"compression": packing, "shuffle": True, "fletcher32": True}
    change(path, replace(IMAGES, data=images, **options))
    np.testing.assert_array_equal(read(path)[1][0].frames, images)


def test_more_than_the_limit_is_refused_and_the_limit_itself_is_not(path):
    largest = EPISODES[1]["observations"].nbytes
    assert len(read(path, max_bytes=largest)[1]) == 2
    message = f"{largest} bytes, more than the {largest - 1} allowed"
    with pytest.raises(FormatError, match=message):
        read(path, max_bytes=largest - 1)


def test_large_jpegs_are_refused_before_they_are_decoded(tmp_path):
    path = tmp_path / "dataset"
    make_minari_dataset(path, [make_episode(3, size=32)])
    whole = 4 * 32 * 32 * 3
    assert read(path, max_bytes=whole)[1][0].frames.nbytes == whole
    with pytest.raises(
        FormatError, match="4 images of 32x32 pixels of 12288 bytes, more"
    ):
        read(path, max_bytes=whole - 1)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"data_format": "arrow"}, "data_format='arrow', not 'hdf5'"),
        ({"total_episodes": 3}, r"holds 2 episodes, but metadata.json says 3"),
        ({"total_episodes": [2]}, r"says \[2\]"),
    ],
)
def test_metadata_that_do_not_fit_are_refused(path, values, message):
    set_metadata(path, **values)
    with pytest.raises(FormatError, match=message):
        read(path)


@pytest.mark.parametrize("content", ["{", "[]", "[" * 10**5, "\ud800"])
def test_metadata_that_are_no_json_are_refused(path, content):
    file = path / "data" / "metadata.json"
    file.write_bytes(content.encode(errors="surrogatepass"))
    with pytest.raises(FormatError, match=r"holds metadata.json, which is not"):
        read(path)


def test_older_datasets_have_no_metadata(path):
    (path / "data" / "metadata.json").unlink()
    assert minari.recognises(path)
    assert read(path)[0].num_episodes == 2


def test_another_format_of_minari_is_recognised_and_refused(path):
    (path / "data" / "main_data.hdf5").unlink()
    assert minari.recognises(path)
    set_metadata(path, data_format="parquet")
    with pytest.raises(FormatError, match="data_format='parquet'"):
        read(path)


def test_without_h5py_one_is_told_what_to_install(path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FormatError, match=r"needs h5py: pip install h5py"):
        read(path)


def test_folders_that_are_something_else(tmp_path):
    assert not minari.recognises(tmp_path)
    assert not minari.recognises(tmp_path / "none")
    (tmp_path / "metadata.json").write_text("{}")
    (tmp_path / "main_data.hdf5").write_text("text")
    assert not minari.recognises(tmp_path)
    with pytest.raises(FormatError, match="in an unsupported format"):
        foreign.open_recording(tmp_path, max_bytes=2**24)


def test_a_file_on_which_the_library_computes_for_ever_is_given_up(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sandbox, "_CPU_SECONDS", 2)
    episode = make_episode(3, size=32)
    make_minari_dataset(tmp_path / "a", [episode])
    file = tmp_path / "a" / "data" / "main_data.hdf5"
    content = bytearray(file.read_bytes())
    # An object of the heap where JPEGs are kept, as long as to end where it begins.
    length = content.index(b"GCOL") + 24
    content[length : length + 8] = (2**64 - 16).to_bytes(8, "little")
    file.write_bytes(content)
    with pytest.raises(FormatError, match="takes too long to read"):
        list(foreign.open_recording(tmp_path / "a", max_bytes=2**24).episodes)


def test_a_file_cut_off_is_refused(path):
    file = path / "data" / "main_data.hdf5"
    content = file.read_bytes()
    for part in (0, 0.9):
        file.write_bytes(content[: int(part * len(content))])
        with pytest.raises(FormatError, match="damaged"):
            foreign.open_recording(path, max_bytes=2**24)
