"""A run's folder, also when an older version of the project wrote it."""

import json

import pytest

from jaxil import config as jaxil_config
from jaxil import workdir
from jaxil.command import UsageError


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


def test_a_run_goes_on_longer_or_in_other_chunks(tmp_path):
    # The presets' chunks differ: a run that is older than the field has the default's.
    config = jaxil_config.default_config("psil", "walker_walk")
    old = config.to_dict()
    del old["encoder"]["chunk_size"]
    write(tmp_path, old)
    config.encoder.chunk_size = 64
    config.total_frames *= 2
    assert workdir.problems(tmp_path, config) == []


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
