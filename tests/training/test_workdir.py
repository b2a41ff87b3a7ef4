"""A run's folder, also when an older version of the project wrote it."""

import json

import pytest

from jaxil import config as jaxil_config
from jaxil.command import UsageError
from jaxil.training import workdir


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
    assert "sinkhorn.alignment: 'transport' there, 'time' here" in fault


def test_a_run_goes_on_longer_or_with_other_convolutions(tmp_path):
    config = jaxil_config.default_config("psil", "walker_walk")
    write(tmp_path, config.to_dict())
    config.encoder.convolutions = "xla"
    config.replay_on_device = True
    config.total_frames *= 2
    assert workdir.problems(tmp_path, config) == []


def test_a_run_goes_on_that_has_a_field_of_former_times(tmp_path):
    config = jaxil_config.default_config("psil", "walker_walk")
    old = config.to_dict()
    old["encoder"]["chunk_size"] = 64
    write(tmp_path, old)
    assert workdir.problems(tmp_path, config) == []
    assert "chunk_size" not in workdir.read_config(tmp_path).encoder
    old["encoder"]["chunks"] = 64  # was never one
    write(tmp_path, old)
    (fault,) = workdir.problems(tmp_path, config)
    assert "encoder.chunks: 64 there" in fault


def test_what_was_written_is_read(tmp_path):
    config = jaxil_config.default_config("pdac", "cheetah_run")
    config.encoder.channels = (8, 4)
    config.learning_rate = 3e-4
    workdir.write_config(tmp_path, config, {"device": "x"})
    assert workdir.read_config(tmp_path).to_dict() == config.to_dict()


@pytest.mark.parametrize("config", [{}, [], {"method": "pdac"}, {"method": 1}])
def test_a_damaged_config_is_one_message(tmp_path, config):
    write(tmp_path, config)
    with pytest.raises(UsageError, match="is damaged"):
        workdir.read_config(tmp_path)
