"""Minari datasets that break the rules or mislead."""

import functools
import sys

import numpy as np
import pytest

from jaxil.demonstrations import foreign
from jaxil.demonstrations.readers import minari, sandbox
from jaxil.demonstrations.readers.recording import FormatError
from tests.demonstrations.foreign_files import read_here
from tests.demonstrations.minari_datasets import (
    EPISODES,
    make_minari_dataset,
    minari_episode,
    set_metadata,
)

pytest.importorskip("minari", reason="Minari writes the datasets of these tests")
h5py = pytest.importorskip("h5py")

read = functools.partial(read_here, minari)


@pytest.fixture(name="path")
def _path(tmp_path):
    return make_minari_dataset(tmp_path / "dataset", EPISODES)


def change(path, function):
    """Applies `function` to the dataset's open HDF5 file."""
    with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
        function(file)


IMAGES = "episode_0/observations"


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


def virtual(file):
    layout = h5py.VirtualLayout((4, 8, 8, 3), np.uint8)
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4, 8, 8, 3))
    del file[IMAGES]
    file.create_virtual_dataset(IMAGES, layout)


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
    "more than is stored": (
        replace(IMAGES, shape=(1000, 8, 8, 3), dtype=np.uint8, chunks=(1, 8, 8, 3)),
        "stores 0 of 192000 bytes",
    ),
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
    make_minari_dataset(path, [minari_episode(3, size=32)])
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
    episode = minari_episode(3, size=32)
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
