"""The benchmark: every part of a run has its time, and wrong use is told at once.

Three tests compile a small learner; they take a minute on a busy core.
"""

import contextlib
import json

import jax
import pytest

from jaxil import benchmark
from jaxil import config as jaxil_config
from jaxil.command import UsageError
from jaxil.timing import compiling, measurement, start, sweeping, tables
from jaxil.timing.bench import make_bench
from tests.commands import SMALL, run

_CONFIG = "--config=configs/tiny.py:pdac,ball_in_cup_catch"
# What others read: these names stay.
_NAMES = ["update_ms", "act_ms", "physics_ms", "render_ms", "sample_ms", "reward_ms"]
_NAMES += ["compile_seconds", "loop_overhead_percent"]
_NAMES += ["frames_per_second", "frames_per_second_in_turn"]
_NAMES += ["reward_percent", "peak_memory_gb"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """One small benchmark of P-DAC, compared with an older file."""
    folder = tmp_path_factory.mktemp("benchmark")
    old = {"update_ms": 1e-3, "device": "abacus", "config": {}}
    (folder / "old.json").write_text(json.dumps(old))
    finished = run(
        "benchmark",
        _CONFIG,
        *SMALL,
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
    names = {name for rows in tables.ROWS.values() for name in rows}
    assert {*_NAMES} <= names <= set(results)
    # P-DAC matches no whole episodes, and a CPU has no memory of its own.
    empty = {name for name in names if results[name] is None}
    assert empty <= {"peak_device_memory_gb"}
    zero = {name for name in names - empty if not results[name] > 0}
    assert zero <= {"experts_mb", "loop_overhead_percent"}
    table = finished.stdout.split("against")[0]
    shown = {line.split()[0] for line in table.splitlines() if line.startswith("  ")}
    assert shown == names - empty
    assert "timed alone: they need not sum up" in table


def test_a_median_lies_in_its_range(measured):
    _, results = measured
    assert {"update_ms", "update_rewarder_ms"} <= set(results["ranges"])
    for name, (low, high) in results["ranges"].items():
        assert 0 < low <= results[name] <= high


def test_sizes_are_those_of_the_small_run(measured):
    _, results = measured
    # Two stacks of 24 x 24 x 9 for the agent, one for the expert, 8 of each; actions
    # of two numbers for both, reward and discount.
    expected = 8 * (3 * 24 * 24 * 9 + 4 * (2 + 2 + 1 + 1))
    assert results["batch_mb"] == pytest.approx(expected / 1e6)
    # 1000 steps in episodes of 100: ten frames more than steps.
    slot = 24 * 24 * 3 + 4 * (2 + 2)
    assert results["replay_gb"] == pytest.approx(1010 * slot / 1e9)
    assert results["parameters_mb"] < results["learner_state_mb"]
    assert results["update_argument_mb"] > results["learner_state_mb"]


def test_the_machine_and_the_settings_are_named(measured):
    finished, results = measured
    assert results["device"].startswith("cpu")
    assert 1 <= results["usable_cores"] <= results["cores"]
    assert results["num_devices"] >= 1
    assert results["threads"] >= 1
    # As they were asked for, not as the benchmark changes them for itself.
    assert results["config"]["exploration_steps"] == 50
    assert results["config"]["total_frames"] == 4000
    assert results["processor"] in finished.stdout


def test_a_cache_and_numbers_of_operations_make_sense(measured):
    _, results = measured
    assert results["update_gflop_by_hand"] < results["update_gflop"]
    assert results["utilisation_counts"] == "by hand"
    rate = results["update_gflop_by_hand"] / results["update_ms"] * 1e3
    share = 100 * rate / results["matrix_product_gflops"]
    assert results["utilisation_percent"] == pytest.approx(share)


def test_the_whole_run_is_slower_than_its_loop(measured):
    _, results = measured
    assert results["run_frames_per_second"] < results["frames_per_second"]
    hours = 4000 / results["run_frames_per_second"] / 3600
    assert results["run_hours"] == pytest.approx(hours)


def test_the_older_file_is_compared_and_told_apart(measured):
    finished, results = measured
    table = finished.stdout.split("new/old")[1]
    # The one number that the older file has.
    name, old, _, _ = table.split()
    assert (name, old) == ("update_ms", "0.0010")
    assert "'abacus' then" in finished.stderr
    assert "config.batch_size: absent then, 8 now" in finished.stderr
    assert results["update_ms"] > 1e-3


def test_a_sweep_measures_each_value(tmp_path):
    path = tmp_path / "sweep.json"
    finished = run(
        "benchmark",
        "--config=configs/expert.py:cartpole_swingup",
        "--config.hidden_dim=16",
        "--config.action_repeat=10",
        "--config.replay_on_device=True",
        "--config.updates_per_dispatch=2",
        "--repeats=1",
        "--steps=4",
        "--full",
        "--sweep=batch_size:4,8",
        f"--json={path}",
    )
    assert finished.returncode == 0, finished.stderr
    found = json.loads(path.read_text())
    assert [each["sweep"] for each in found] == [
        {"field": "batch_size", "value": 4},
        {"field": "batch_size", "value": 8},
    ]
    # Places of frames only, of half as many samples.
    assert found[0]["batch_mb"] * 2 == pytest.approx(found[1]["batch_mb"])
    assert found[0]["update_gflop_by_hand"] * 2 == found[1]["update_gflop_by_hand"]
    rows = finished.stdout.splitlines()[-2:]
    assert [row.split()[0] for row in rows] == ["4", "8"]


def test_a_full_replay_is_full(tmp_path):
    config = jaxil_config.default_config("drqv2", "cartpole_swingup")
    config.update(observation="state", hidden_dim=16, batch_size=4, action_repeat=10)
    config.replay_size_steps = 1000
    bench = make_bench(config, tmp_path, None, say=print)
    with contextlib.closing(bench.run):
        assert bench.run.replay.num_steps_stored == 100
        updates = int(bench.run.state.num_updates)
        bench.fill_replay()
        assert bench.run.replay.num_steps_stored == 1000
        assert int(bench.run.state.num_updates) == updates + 1
    bench.run.outputs.close()


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
        (["--sweep=batch_size:4", "--compare=a"], ["don't go together"]),
        (["--compare=missing.json"], ["missing.json", "can't be read"]),
        (["--json=no/such/folder/a.json"], ["no/such/folder", "can't be written"]),
        (["--json=tests"], ["--json=tests can't be written"]),
        (["--repeats=0", "--config.task=cup"], ["repeats", "task='cup'"]),
        (["--steps=1"], ["steps"]),
    ],
)
def test_wrong_use_is_told_before_anything_is_measured(flags, expected, monkeypatch):
    monkeypatch.setattr(measurement, "measure", lambda *_, **__: pytest.fail("ran"))
    with pytest.raises(UsageError) as caught:
        benchmark.main(["benchmark", _CONFIG, *SMALL, *flags])
    for text in expected:
        assert text in str(caught.value)


def test_wrong_use_ends_with_status_2():
    finished = run("benchmark", _CONFIG, "--compare=configs/tiny.py")
    assert finished.returncode == 2
    assert "is not JSON" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_sweep_leaves_its_config_alone():
    config = jaxil_config.default_config("drqv2", "cartpole_swingup")
    swept = sweeping.parse("encoder.contrast:2,0.5", config)
    assert swept.field == "encoder.contrast"
    contrasts = {value: c.encoder.contrast for value, c in swept.configs.items()}
    assert contrasts == {2.0: 2.0, 0.5: 0.5}
    assert config.encoder.contrast == 1.0


def test_a_start_that_fails_is_said(monkeypatch):
    said = []
    monkeypatch.setattr(start, "_config_file", lambda _: "raise ValueError('broken')")
    seconds = start.seconds_to_first_step(None, {}, said.append)
    assert seconds is None
    assert "start not measured" in said[0]
    assert "broken" in said[0]


def test_compiling_cold_writes_what_compiling_warm_reads():
    folders = []

    class Program:
        def compile(self):
            folders.append(_cache_folder())

    before = _cache_folder()
    cold, warm = compiling.cold_and_warm(Program)
    assert min(cold, warm) > 0
    assert folders[0] == folders[1] != before
    assert _cache_folder() == before


def _cache_folder():
    return getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009
