"""A run's folder, also when an older version of the project wrote it."""

import json
import os
import time

import pytest

from jaxil import config as jaxil_config
from jaxil import outside
from jaxil.environments.suite import SuiteEnvironment
from jaxil.errors import UsageError
from jaxil.training import assembly, trained, workdir
from tests.tiny_agent import NETWORKS, make_params


def write(folder, config):
    (folder / "config.json").write_text(json.dumps({"config": config}))


def test_a_field_that_is_newer_than_the_run_has_its_default(tmp_path):
    config = jaxil_config.default_config("psil", "walker_walk")
    old = config.to_dict()
    del old["sinkhorn"]["alignment"], old["updates_per_dispatch"]
    write(tmp_path, old)
    assert workdir.problems(tmp_path, config) == []
    assert workdir.read_config(tmp_path).sinkhorn.alignment == "transport"
    config.sinkhorn.alignment = "time"
    (fault,) = workdir.problems(tmp_path, config)
    assert "sinkhorn.alignment: 'transport' there, 'time' here" in str(fault)


def test_a_run_may_be_resumed_for_longer_or_with_other_convolutions(tmp_path):
    config = jaxil_config.default_config("psil", "walker_walk")
    write(tmp_path, config.to_dict())
    config.encoder.convolutions = "xla"
    config.replay_on_device = True
    config.total_frames *= 2
    assert workdir.problems(tmp_path, config) == []


def test_demonstrations_may_move_but_not_change(tmp_path):
    config = jaxil_config.default_config("pdac", "walker_walk")
    first, moved = tmp_path / "first", tmp_path / "elsewhere" / "moved"
    first.write_bytes(b"expert")
    config.demonstrations.source = str(first)
    workdir.write_config(tmp_path, config, {})
    moved.parent.mkdir()
    first.rename(moved)
    config.demonstrations.source = str(moved)
    assert workdir.problems(tmp_path, config) == []
    moved.write_bytes(b"another")
    (fault,) = workdir.problems(tmp_path, config)
    assert "demonstrations.source: its content has changed" in str(fault)


def test_checkpoints_without_their_config_are_nobodys(tmp_path):
    (tmp_path / "checkpoints" / "frame_000000002000").mkdir(parents=True)
    (fault,) = workdir.problems(tmp_path, jaxil_config.default_config("pdac"))
    assert "has checkpoints but no config.json" in str(fault)


def test_a_former_field_is_left_out(tmp_path):
    config = jaxil_config.default_config("psil", "walker_walk")
    old = config.to_dict()
    old["encoder"]["chunk_size"] = 64
    write(tmp_path, old)
    assert workdir.problems(tmp_path, config) == []
    assert "chunk_size" not in workdir.read_config(tmp_path).encoder


def test_what_was_written_is_read(tmp_path):
    config = jaxil_config.default_config("pdac", "cheetah_run")
    config.encoder.channels = (8, 4)
    config.learning_rate = 3e-4
    workdir.write_config(tmp_path, config, {"device": "x"})
    assert workdir.read_config(tmp_path).to_dict() == config.to_dict()


@pytest.mark.parametrize(
    "content",
    [
        *(json.dumps({"config": c}) for c in ({}, [], {"method": "pdac"})),
        *('{"config": {"method": 1}}', "", "[" * 200_000, b"\xff"),
    ],
)
def test_a_damaged_config_is_one_message(tmp_path, content):
    content = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "config.json").write_bytes(content)
    with pytest.raises(UsageError, match="is damaged"):
        workdir.read_config(tmp_path)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (None, "missing or empty"),
        ("", "missing or empty"),
        ("runs/" + "ä" * 128, "a name of 256 bytes, .* at most 255"),
        ("runs/\udcff", "not UTF-8"),
        ("runs/a\0b", "a zero byte in its name"),
    ],
)
def test_a_folder_that_cannot_be_is_refused(value, said):
    with pytest.raises(UsageError, match=said) as caught:
        workdir.from_flag(value)
    assert "\n" not in str(caught.value)
    str(caught.value).encode()


def test_the_longest_name_will_do(tmp_path):
    path = workdir.from_flag(str(tmp_path / ("x" * 255)))
    with workdir.opened(path):
        workdir.write_config(
            path, jaxil_config.default_config("pdac", "walker_run"), {}
        )
    assert (path / "config.json").is_file()


def test_a_path_too_long_to_look_up_is_one_message(tmp_path):
    folder = tmp_path.joinpath(*["x" * 255] * 20)
    config = jaxil_config.default_config("pdac", "walker_run")
    assert workdir.problems(folder, config) == []  # its nearest parent is writable
    with pytest.raises(UsageError, match="workdir="), workdir.opened(folder):
        pass


def test_a_policy_makes_no_task_of_code_that_its_run_alone_names(tmp_path, monkeypatch):
    (tmp_path / "harmful.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    config = jaxil_config.default_config("zero")
    config.task = "harmful:make"
    counters = {"num_steps": 0, "seconds": 0.0}
    policy = trained.Policy(config, NETWORKS, make_params(0), counters)
    with pytest.raises(UsageError, match="--trust=harmful:make"):
        policy.make_environment()
    monkeypatch.setattr(outside, "_trusted", {config.task})
    with pytest.raises(UsageError, match="SystemExit: imported"):
        policy.make_environment()


def test_a_policy_without_its_mean_image_is_refused(tmp_path, monkeypatch):
    """Made anew from the demonstrations, it would run the task that a folder names."""
    config = jaxil_config.default_config("pdac")
    config.encoder.subtract_mean_image = True
    config.task = "harmful:make"
    write(tmp_path, config.to_dict())
    monkeypatch.setattr(
        trained.Checkpoints, "read_policy", lambda self: ({}, None, {"num_steps": 0})
    )
    with pytest.raises(UsageError, match="lacks the mean image"):
        trained.load_policy(tmp_path)


def test_nothing_that_renders_stops_only_what_has_to_render(monkeypatch):
    def fail(self):
        raise RuntimeError("nothing here can render")

    config = jaxil_config.default_config("zero")
    config.observation = "state"
    monkeypatch.setattr(SuiteEnvironment, "renderer_name", fail)
    assert assembly.renderer_name(config, films=False) == "none"
    with pytest.raises(UsageError, match="video_every_evals=0 needs no rendering"):
        assembly.renderer_name(config, films=True)
    config.observation = "pixels"
    with pytest.raises(UsageError, match=r"nothing here can render$"):
        assembly.renderer_name(config, films=False)


def test_an_open_folder_is_in_use(tmp_path):
    with workdir.opened(tmp_path):
        match = "in use by another process; wait for it"
        with pytest.raises(UsageError, match=match), workdir.opened(tmp_path):
            pass
    with workdir.opened(tmp_path):
        pass


def test_leftovers_of_killed_processes_are_removed_at_the_start(tmp_path):
    left = [".tmp-12-eval.csv", "videos/.tmp-12-frame_1.mp4"]
    (tmp_path / "videos").mkdir()
    for name in left:
        (tmp_path / name).write_text("")
        before = time.time() - 100
        os.utime(tmp_path / name, (before, before))
    with workdir.opened(tmp_path):
        assert not any((tmp_path / name).exists() for name in left)


def test_a_folder_that_cannot_be_written_is_one_message(tmp_path):
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file"
    with pytest.raises(UsageError, match="not writable"), workdir.opened(folder):
        pass
    assert workdir.newest_checkpoint(folder) is None
