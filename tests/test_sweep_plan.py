"""What a sweep plans, and what it refuses."""

import os

import pytest

from jaxil.errors import Fault
from jaxil.sweeps import clusters, plan
from jaxil.sweeps.clusters import Cluster
from jaxil.training import workdir
from tests import commands
from tests.commands import call
from tests.sweep_plans import config_of, faults_of, make_runs


def test_all_tasks_variants_and_seeds_are_planned_seed_by_seed(tmp_path):
    runs = make_runs(tmp_path)
    assert [run.name for run in runs] == [
        f"{task}/{method}/seed{seed}"
        for seed in (0, 1)
        for task in ("cartpole_swingup", "walker_run")
        for method in ("pdac", "psil")
    ]
    last = runs[-1]
    assert last.folder == tmp_path / "walker_run" / "psil" / "seed1"
    assert last.total_frames == 5_000_000
    config = config_of(last)
    assert (config.method, config.task, config.seed) == ("psil", "walker_run", 1)
    assert f"--workdir={last.folder}" in last.command


def test_an_ablation_has_its_variants_and_its_shorter_budget(tmp_path):
    runs = make_runs(tmp_path, methods=[], ablations=["figure8"], num_seeds=1)
    budgets = {f"{run.task}/{run.slug}": run.total_frames for run in runs}
    assert budgets == {
        "cartpole_swingup/pdac": 1_500_000,
        "cartpole_swingup/pdac_actions": 1_500_000,
        "walker_run/pdac": 3_000_000,
        "walker_run/pdac_actions": 3_000_000,
    }
    actions = config_of(runs[-1])
    assert actions.discriminator.sees_actions
    assert actions.total_frames == 3_000_000


def test_video_alone_has_the_methods_without_actions_and_three_sets(tmp_path):
    runs = make_runs(
        tmp_path,
        methods=[],
        ablations=["video_alone"],
        tasks=["finger_spin"],
        num_seeds=1,
        preset="tiny",
    )
    counts = {}
    for run in runs:
        config = config_of(run)
        counts.setdefault(config.method, []).append(config.demonstrations.num_episodes)
    assert {"pdac", "psil", "orca", "laifo", "patchail"} <= set(counts)
    assert not {"bc", "dac", "drqv2", "zero"} & set(counts)
    assert all(sorted(each) == [1, 10, 50] for each in counts.values())


def test_methods_and_ablations_make_a_union_with_the_longer_budget(tmp_path):
    runs = make_runs(tmp_path, ablations=["figure8", "figure12"], num_seeds=1)
    budgets = {r.slug: r.total_frames for r in runs if r.task == "walker_run"}
    assert budgets == {"pdac": 5_000_000, "psil": 5_000_000, "pdac_actions": 3_000_000}
    assert len(runs) == 2 * len(budgets)
    overrides = {"total_frames": "4000"}
    chosen = make_runs(tmp_path, methods=[], ablations=["figure8"], overrides=overrides)
    assert {run.total_frames for run in chosen} == {4000}


def test_a_changed_field_names_the_variant_that_it_makes(tmp_path):
    overrides = {"shift_padding": "0"}
    runs = make_runs(tmp_path, methods=["pdac"], preset="tiny", overrides=overrides)
    assert {run.slug for run in runs} == {"pdac_no_augmentation"}
    overrides = {"discriminator.sees_actions": "True"}
    (fault,) = faults_of(
        tmp_path, methods=[], ablations=["figure8"], overrides=overrides
    )
    assert "is what an ablation varies; leave it out" in fault


def test_a_field_changes_the_methods_that_have_it(tmp_path):
    overrides = {"discriminator.batch_size": "8", "batch_size": "32"}
    pdac, psil = make_runs(
        tmp_path, tasks=["walker_run"], num_seeds=1, overrides=overrides
    )
    assert config_of(pdac).discriminator.batch_size == 8
    assert config_of(psil).batch_size == 32
    assert "discriminator" not in config_of(psil)
    (fault,) = faults_of(tmp_path, methods=["psil", "bc"], overrides=overrides)
    assert "field='discriminator.batch_size' is unknown" in fault


@pytest.mark.parametrize("preset", plan.PRESETS)
def test_a_method_from_outside_is_planned(tmp_path, monkeypatch, preset):
    (tmp_path / "outsider.py").write_text(_OUTSIDER)
    monkeypatch.syspath_prepend(tmp_path)
    overrides = {"own.strength": "2.5"}
    runs = make_runs(
        tmp_path, methods=["outsider:METHOD"], preset=preset, overrides=overrides
    )
    assert runs[0].name == "cartpole_swingup/outsider_METHOD/seed0"
    config = config_of(runs[-1])
    assert (config.method, config.task) == ("outsider:METHOD", "walker_run")
    assert config.own.strength == 2.5
    assert (config.image_size == 84) == (preset == "paper")
    (fault,) = faults_of(tmp_path, methods=["nowhere:METHOD"])
    assert "--methods='nowhere:METHOD' names no module" in fault


_OUTSIDER = """
from jaxil import methods

METHOD = methods.Method(
    name="outsider",
    label="Outsider",
    about="nothing",
    sections={"own": {"strength": methods.Field(1.0, "of it", 0.0, 9.0)}},
    uses_demonstrations=False,
)


def make_rewarder(agent, *, strength):
    raise NotImplementedError
"""


def test_a_method_from_outside_without_its_function_is_refused(tmp_path, monkeypatch):
    (tmp_path / "hollow.py").write_text(_OUTSIDER.replace("make_rewarder", "make"))
    monkeypatch.syspath_prepend(tmp_path)
    told = faults_of(tmp_path / "runs", methods=["hollow:METHOD"])
    assert any("'hollow' has no `make_rewarder`" in fault for fault in told)


def test_every_fault_of_every_run_is_told_once(tmp_path):
    (tmp_path / "file").touch()
    told = faults_of(
        tmp_path / "file" / "x",
        lambda config: [Fault("x", "is bad")] if config.method == "pdac" else [],
        methods=["gail", "pdac", "psil"],
        ablations=["figure1"],
        num_seeds=0,
        overrides={"seed": "3", "batchsize": "7", "image_size": "big"},
    )
    expected = (
        "--methods='gail' is unknown; choose one of: pdac, psil",
        "--ablation='figure1' is unknown",
        "--seeds=0 must lie in [1, 10000]",
        "not writable",
        "--config.seed='3' is what the sweep itself sets; use --seeds",
        "field='batchsize' is unknown; did you mean: batch_size",
        "image_size='big' has the wrong type: expected a whole number",
    )
    for fault, words in zip(told, expected, strict=True):
        assert words in fault
    assert "[" not in told[-1]  # all runs have it


def test_a_fault_of_some_runs_says_which(tmp_path):
    missing = [Fault("demonstrations", "are missing")]
    (fault,) = faults_of(tmp_path, lambda config: missing * ("walker" in config.task))
    assert fault == "demonstrations are missing [walker_run/pdac, walker_run/psil]"


def test_a_folder_with_another_run_is_refused(tmp_path):
    (run, *_) = make_runs(tmp_path, methods=["pdac"], tasks=["walker_run"])
    config = config_of(run)
    config.batch_size = 17
    run.folder.mkdir(parents=True)
    workdir.write_config(run.folder, config, {})
    (fault,) = faults_of(tmp_path, methods=["pdac"], tasks=["walker_run"])
    assert "batch_size: 17 there, 256 here" in fault
    assert fault.endswith("[walker_run/pdac/seed0]")


def test_clusters_that_are_not_there(monkeypatch):
    monkeypatch.setattr(clusters.shutil, "which", lambda name: None)
    monkeypatch.setattr(clusters.importlib.util, "find_spec", lambda name: None)
    many = Cluster("slurm", num_workers=10**6, hours=0.0, num_gpus=2, num_cpus=0)
    told = "\n".join(map(str, clusters.problems(many, starts=True)))
    for words in ("no Slurm here", "pip install submitit", "--workers=", "--hours=0.0",
                  "--gpus=2", "--cpus=0"):  # fmt: skip
        assert words in told
    assert not list(clusters.problems(Cluster("slurm"), starts=False))
    (fault,) = clusters.problems(Cluster("pbs"), starts=True)
    assert "local, slurm, debug" in str(fault)


@pytest.mark.parametrize(
    ("given", "flag"),
    [
        ({"hours": 2.0}, "--hours=2.0"),
        ({"partition": "gpu"}, "--partition='gpu'"),
        ({"num_gpus": 0}, "--gpus=0"),
        ({"num_cpus": 8}, "--cpus=8"),
    ],
)
def test_flags_of_slurm_alone_are_not_ignored(given, flag):
    assert not list(clusters.problems(Cluster("slurm", **given), starts=False))
    (fault,) = clusters.problems(Cluster("local", **given), starts=False)
    assert f"{flag} is for --cluster=slurm" in str(fault)


@pytest.mark.parametrize("name", ["slurm", "debug"])
def test_workers_are_of_this_machine_alone(name):
    (fault,) = clusters.problems(Cluster(name, num_workers=1), starts=False)
    assert "--workers=1 is for --cluster=local" in str(fault)


def test_jobs_that_slurm_refuses_are_one_sentence(tmp_path, monkeypatch):
    refusal = "echo 'no partition nope' >&2; exit 1"
    for name, text in (("sbatch", refusal), ("srun", ""), ("sinfo", "")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    done = commands.run(
        "sweep",
        *("--methods=zero", "--tasks=walker_walk", "--seeds=1", "--preset=tiny"),
        *("--cluster=slurm", "--partition=nope", f"--workdir={tmp_path}/runs"),
    )
    assert done.returncode == 2
    assert "finds that Slurm refuses jobs" in done.stderr
    assert "no partition nope" in done.stderr


def test_slurm_commands_without_a_cluster_are_no_slurm(tmp_path, monkeypatch):
    said = "sinfo fails (no controller)"
    monkeypatch.setenv("PATH", str(tmp_path))
    for name, text, expected in (
        ("sinfo", "echo 'no controller' >&2; exit 1", "there is no command sbatch"),
        ("sbatch", "", "there is no command srun"),
        ("srun", "", said),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
        (fault,) = clusters.problems(Cluster("slurm"), starts=True)
        assert f"no Slurm here: {expected}" in str(fault)


def test_wrong_use_of_the_command_ends_with_status_2(tmp_path):
    done = call(
        "sweep",
        *("--methods=gail", "--seeds=3000000", "--cluster=pbs", "--tasks=walker_wlak"),
        *("--config.bath_size", "8"),
    )
    assert done.returncode == 2
    for words in ("gail", "--seeds=3000000", "'pbs'", "walker_walk", "'bath_size'"):
        assert words in done.stderr
    assert "--workdir is missing or empty" in done.stderr
    assert "single run" not in done.stderr
    assert "Traceback" not in done.stderr
