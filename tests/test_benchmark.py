"""The benchmark: every part of a run is timed, and wrong use is refused at once."""

import contextlib
import json
import os

import jax
import numpy as np
import pytest

from jaxil import benchmark, command
from jaxil import config as jaxil_config
from jaxil.errors import UsageError
from jaxil.timing import measurement, start, summary
from jaxil.timing.bench import Bench
from jaxil.training import assembly
from tests.commands import STATES, call, small

_CONFIG = "--config=configs/tiny.py:pdac,ball_in_cup_catch"
# What others read: these names stay.
_NAMES = ["update_ms", "act_ms", "physics_ms", "render_ms", "sample_ms", "reward_ms"]
_NAMES += ["compile_seconds", "loop_overhead_percent"]
_NAMES += ["frames_per_second", "frames_per_second_in_turn"]
_NAMES += ["reward_percent", "peak_memory_gb", "start_seconds", "replay_gb"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """One small benchmark, compared with an older file."""
    folder = tmp_path_factory.mktemp("benchmark")
    old = {"update_ms": 1e-3, "device": "abacus", "config": {}}
    (folder / "old.json").write_text(json.dumps(old))
    with pytest.MonkeyPatch.context() as patch:
        # Compiling without a cache takes half a minute, and has a test of its own.
        patch.setattr(start, "compile_seconds", lambda lower: 1.0)
        finished = call(
            "benchmark",
            _CONFIG,
            *small("pdac"),
            "--config.replay_on_device=False",  # so that batches are pixels
            "--repeats=2",
            "--steps=20",
            f"--json={folder / 'new.json'}",
            f"--compare={folder / 'old.json'}",
        )
    assert finished.returncode == 0, finished.stderr
    return finished, json.loads((folder / "new.json").read_text())


def test_every_row_is_a_positive_number_and_in_the_table(measured):
    finished, results = measured
    names = {name for rows in summary.ROWS.values() for name in rows}
    assert {*_NAMES} <= names <= set(results)
    # A CPU has no memory apart from the host's.
    empty = {name for name in names if results[name] is None}
    assert empty == {"peak_device_memory_gb"}
    zero = {name for name in names - empty if not results[name] > 0}
    assert zero <= {"loop_overhead_percent"}
    table = finished.stdout.split("against")[0]
    shown = {line.split()[0] for line in table.splitlines() if line.startswith("  ")}
    assert shown == names - empty
    for name, (low, high) in results["ranges"].items():
        assert 0 < low <= results[name] <= high
    assert results["processor"] in table


def test_sizes_are_those_of_the_small_run(measured):
    _, results = measured
    # Two stacks of 24 x 24 x 9 for the agent, one for the expert, 8 of each; actions
    # of two numbers for both, reward and discount.
    expected = 8 * (3 * 24 * 24 * 9 + 4 * (2 + 2 + 1 + 1))
    assert results["batch_mb"] == pytest.approx(expected / 1e6)
    # 1000 steps in episodes of 100: ten frames more than steps.
    assert results["replay_gb"] == pytest.approx(1010 * 24 * 24 * 3 / 1e9)


def test_arithmetic_counts_the_encoders_convolutions(measured):
    _, results = measured
    # Layers of 6 x 6 x 32 and 4 x 4 x 32, for 24 images; two operations each. The
    # gradients for 8 of them, without the pixels' own, are on top.
    layers = 36 * 32 * 4 * 4 * 9, 16 * 32 * 3 * 3 * 32
    floor = 2 * (24 * sum(layers) + 8 * (sum(layers) + layers[1]))
    assert floor < 1e9 * results["update_gflop"] < 5 * floor
    rate = results["update_gflop"] / results["update_ms"] * 1e3
    share = 100 * rate / results["matrix_product_gflops"]
    assert results["utilisation_percent"] == pytest.approx(share)


def test_the_config_is_the_one_that_was_asked_for(measured):
    _, results = measured
    # The benchmark changes it for itself.
    assert results["config"]["exploration_steps"] == 50
    assert results["config"]["total_frames"] == 4000
    loop = 4000 / results["frames_per_second"]
    rewards = 4 * results["reward_ms"] / 1e3  # of 4 episodes of 1000 frames
    assert results["run_hours"] == pytest.approx((loop + rewards) / 3600)
    assert results["reward_percent"] == pytest.approx(100 * rewards / (loop + rewards))


def test_an_older_file_is_compared_and_its_differences_named(measured):
    finished, results = measured
    table = finished.stdout.split("new/old")[1]
    # The one number that the older file has.
    name, old, _, _ = table.split()
    assert (name, old) == ("update_ms", "0.0010")
    assert "'abacus' then" in finished.stderr
    assert "config.batch_size: absent then, 8 now" in finished.stderr
    assert results["update_ms"] > 1e-3


def test_a_sweep_measures_each_value(monkeypatch, tmp_path, capsys):
    seen = []

    def measure(config, **settings):
        seen.append((config.batch_size, config.seed, settings))
        machine = dict.fromkeys(("num_devices", "usable_cores", "cores"), 1)
        machine |= {"device": "cpu", "processor": "x", "repeats": 1}
        names = {name for rows in summary.ROWS.values() for name in rows}
        return {**dict.fromkeys(names, 1.0), **machine}

    monkeypatch.setattr(measurement, "measure", measure)
    path = tmp_path / "sweep.json"
    flags = ["--full", "--repeats=1", "--sweep=batch_size:8,16", f"--json={path}"]
    benchmark.main(["benchmark", _CONFIG, *small("pdac"), "--config.seed=3", *flags])
    settings = {"repeats": 1, "steps": 40, "full": True}
    assert seen == [(8, 3, settings), (16, 3, settings)]
    assert [each["sweep"] for each in json.loads(path.read_text())] == [
        {"field": "batch_size", "value": 8},
        {"field": "batch_size", "value": 16},
    ]
    rows = capsys.readouterr().out.splitlines()[-2:]
    assert [row.split()[0] for row in rows] == ["8", "16"]


def test_a_full_replay_is_full(tmp_path):
    config = jaxil_config.default_config("drqv2", "cartpole_swingup")
    config.update(observation="state", hidden_dim=16, batch_size=4, action_repeat=10)
    config.update(replay_size_steps=1000, replay_on_device=True, updates_per_dispatch=2)
    with contextlib.closing(Bench(config, tmp_path)) as bench:
        replay = bench.run.replay
        assert replay.num_steps_stored == 100
        updates = int(bench.update().num_updates)
        bench.fill_replay()
        assert replay.num_steps_stored == 1000
        assert int(bench.update().num_updates) == updates + 4
        frames, seconds, working = bench.loop(6, waits=True)
        assert frames == 60
        assert 0 < working <= seconds


def test_what_fails_after_it_has_begun_is_closed(tmp_path, monkeypatch):
    config = jaxil_config.default_config("drqv2", "cartpole_swingup")
    config.update(observation="state", hidden_dim=16, batch_size=4, action_repeat=10)
    made, closed = [], []
    make = assembly.training_environment

    def make_counted(config):
        environment = make(config)
        made.append(environment)
        close = environment.close
        monkeypatch.setattr(environment, "close", lambda: closed.append(close()))
        return environment

    monkeypatch.setattr(assembly, "training_environment", make_counted)
    monkeypatch.setattr(Bench, "add_episode", lambda bench: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        Bench(config, tmp_path)
    assert len(closed) == len(made) > 0


def test_a_rewarder_observes_an_episode_before_it_learns(tmp_path):
    config = jaxil_config.default_config("pdac", "cartpole_swingup")
    config.update(image_size=24, hidden_dim=16, feature_dim=8, batch_size=4)
    config.update(action_repeat=10, replay_size_steps=1000)
    config.encoder.update(channels=(32,), kernel_sizes=(4,), strides=(4,))
    config.demonstrations.num_episodes = 1
    # Principal components of frames are NaN before the first episode.
    config.discriminator.update(batch_size=4, hidden_dim=16, num_components=4)
    with contextlib.closing(Bench(config, tmp_path)) as bench:
        bench.update()
        assert np.all(np.isfinite(bench.run.reward(bench.episode)))


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--sweep=batch_sise:4"], ["'batch_sise' is unknown", "batch_size"]),
        (["--sweep=encoder.channels:4"], ["a field that is a number"]),
        (["--sweep=batch_size:4,x"], ["'x' is not a whole number", "4,x"]),
        (["--sweep=batch_size:"], ["'' is not a whole number"]),
        (["--sweep=learning_rate:fast"], ["'fast' is not a number"]),
        (
            ["--sweep=batch_size:0,1000000", "--config.seed=-1"],
            ["seed=-1"],
        ),
        (["--sweep=batch_size:0,1000000"], ["batch_size=0", "batch_size=1000000"]),
        (["--sweep=batch_size:4", "--compare=a"], ["cannot be combined"]),
        (["--compare=missing.json"], ["missing.json", "No such file"]),
        (["--json=no/such/folder/a.json"], ["no/such/folder", "cannot be written"]),
        (["--json=tests"], ["--json=tests cannot be written"]),
        (["--repeats=0", "--config.task=cup"], ["repeats", "task='cup'"]),
        (["--steps=1"], ["steps"]),
    ],
)
def test_wrong_use_is_reported_before_measuring(flags, expected, monkeypatch):
    monkeypatch.setattr(measurement, "measure", lambda *_, **__: pytest.fail("ran"))
    with pytest.raises(UsageError) as caught:
        benchmark.main(["benchmark", _CONFIG, *small("pdac"), *flags])
    for text in expected:
        assert text in str(caught.value)


def test_wrong_use_ends_with_status_2():
    finished = call("benchmark", _CONFIG, "--compare=configs/tiny.py")
    assert finished.returncode == 2
    assert "is not a file that" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_start_that_fails_is_reported(monkeypatch, capsys):
    monkeypatch.setattr(start, "_CONFIG_FILE", "raise ValueError('broken')#{}")
    config = jaxil_config.default_config()
    assert start.first_step_seconds(config, {}) is None
    message = capsys.readouterr().err
    assert "start not measured" in message
    assert "broken" in message


def test_a_method_that_only_plays_when_evaluated_starts_with_that(capsys):
    words = ["--config=tiny:bc,cartpole_swingup", *STATES, *small("bc")]
    config = command.read_config([*words, "--config.total_frames=1000000000"])
    seconds = start.first_step_seconds(config, os.environ)
    assert seconds is not None, capsys.readouterr().err
    assert seconds > 0


def test_compiling_cold_uses_no_cache(monkeypatch):
    cleared, enabled = [], []
    # Other tests would compile their programs again.
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))

    class Program:
        def compile(self):
            enabled.append(_cache_is_enabled())

    assert start.compile_seconds(Program) > 0
    assert enabled == [False]
    assert cleared
    assert _cache_is_enabled()


def _cache_is_enabled():
    return jax.config.values["jax_enable_compilation_cache"]
