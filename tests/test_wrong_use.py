"""Each wrong use ends with status 2 and one message: field, value, rule, way out."""

import contextlib
import types

import numpy as np
import pytest

from jaxil import command
from jaxil import config as jaxil_config
from jaxil.demonstrations import states
from jaxil.environments import evaluation
from jaxil.training import assembly, film, trained, workdir
from tests.commands import call, small_run

_TASKS = ("walker_walk", "cartpole_swingup")

# (field, value, what the sentence must name)
_BAD_VALUES = (
    ("method", "gail", ("gail", "psil")),
    ("task", "walker_wlak", ("walker_wlak", "walker_walk")),
    ("observation", "pixel", ("pixels",)),
    ("render_quality", "best", ("paper", "fast")),
    ("batch_size", 0, ("batch_size=0", "256 in the paper")),
    ("batch_size", -3, ("batch_size=-3",)),
    ("learning_rate", 0.0, ("learning_rate=0.0", "(0, 1]")),
    ("learning_rate", float("nan"), ("nan",)),
    ("action_repeat", 0, ("action_repeat=0 must lie in [1, 100]",)),
    ("seed", 10**400, ("must lie in [0, 2147483647]",)),  # more than a float can hold
    ("discount_factor", 1.5, ("discount_factor=1.5", "0.99")),
    ("critic_target_tau", 2.0, ("critic_target_tau=2.0",)),
    ("sinkhorn.epsilon", float("inf"), ("sinkhorn.epsilon=inf",)),
    ("total_frames", 1_000_001, ("not a multiple of action_repeat=2", "1000000")),
    ("image_size", 10, ("too small for the encoder", "at least 15")),
    ("encoder.strides", (2, 1), ("lengths differ",)),
    ("encoder.channels", (32, 0, 32, 32), ("encoder.channels",)),
    ("sinkhorn.epsilon", 1e-5, ("sinkhorn.epsilon=1e-05", "[0.0001, 1000.0]")),
    ("exploration_std_end", 2.0, ("is above exploration_std_start=1.0",)),
    ("learning_rate_end", 2e-4, ("is above learning_rate=0.0001", "at most 0.0001")),
    ("discriminator.batch_size", 512, ("at most 256",)),
    ("replay_size_steps", 10, ("replay_size_steps=10",)),
    ("demonstrations.num_episodes", 0, ("demonstrations.num_episodes=0",)),
    ("updates_per_dispatch", 0, ("must lie in [1, 1000]",)),
    ("num_environments", 65, ("must lie in [1, 64]",)),
    ("compute_dtype", "float16", ("choose one of: float32",)),
    # A ConfigDict takes None for any type.
    ("seed", None, ("seed=None must be a whole number",)),
    ("learning_rate", None, ("learning_rate=None must be a number",)),
    ("encoder.channels", None, ("encoder.channels=None must be a list",)),
    ("demonstrations.source", None, ("demonstrations.source=None must be text",)),
    ("task", None, ("task=None must be text",)),
    ("method", None, ("method=None must be text",)),
    ("logger", None, ("logger=None must be text",)),
)


@pytest.mark.parametrize(("field", "value", "expected"), _BAD_VALUES)
def test_a_bad_value_is_named_with_rule_and_way_out(field, value, expected):
    method = "psil" if field.startswith("sinkhorn") else "pdac"
    config = jaxil_config.default_config(method, "walker_walk")
    target, leaf = config, field
    if "." in field:
        group, leaf = field.split(".")
        target = config[group]
    target[leaf] = value
    faults = jaxil_config.problems(config, _TASKS)
    assert len(faults) == 1
    for word in expected:
        assert word in str(faults[0])


def test_an_encoder_has_a_layer():
    config = jaxil_config.default_config("pdac", "walker_walk")
    for name in ("channels", "kernel_sizes", "strides"):
        config.encoder[name] = ()
    (fault,) = jaxil_config.problems(config, _TASKS)
    assert "encoder.channels=() must hold whole numbers of at least 1" in str(fault)


def test_smallest_image_is_the_one_that_leaves_one_pixel():
    config = jaxil_config.default_config("pdac", "walker_walk")
    config.image_size = 15  # 15 -> 7 -> 5 -> 3 -> 1
    assert jaxil_config.problems(config, _TASKS) == []


def test_all_faults_come_in_one_message_without_a_traceback(tmp_path):
    finished = call(
        "launch",
        "--config=configs/pdac.py:walker_wlak",
        "--workdir=/proc/run",
        "--config.batch_size=-3",
        "--config.bath_size=3",
        "--config.learning_rate=fast",
        "--bogus=1",
    )
    assert finished.returncode == 2
    assert "Traceback" not in finished.stderr
    named = (
        "walker_walk",
        "batch_size=-3",
        "bath_size",
        "'fast'",
        "--bogus",
        "/proc/run",
    )
    for word in named:
        assert word in finished.stderr


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["sweep", "--methods=pdcc", "--workdir=/proc/run"], ["pdcc", "/proc/run"]),
        (["report", "no_run", "--output=/proc/x"], ["no_run", "/proc/x"]),
        (["collect", "--convert=a", "--task=b"], ["--output", "--task is not for"]),
        (["benchmark", "--json=/proc/x", "--config=pdac:a"], ["--json", "task='a'"]),
    ],
)
def test_a_wrong_flag_hides_no_other_fault(flags, named):
    command_name, *words = flags
    finished = call(command_name, *words, "--bogus=1")
    assert finished.returncode == 2
    for word in ("--bogus", *named):
        assert word in finished.stderr


def test_a_second_config_in_the_same_folder_is_refused(tmp_path):
    flags = small_run("zero", tmp_path)
    config = command.read_config(word for word in flags if "--config" in word)
    workdir.write_config(tmp_path, config, {})
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    other = call("launch", *flags, "--config.seed=1", "--config.noise_clip=0.2")
    assert other.returncode == 2
    assert "seed: 0 there, 1 here" in other.stderr
    assert "noise_clip: 0.3 there, 0.2 here" in other.stderr
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--workdir=x"], "--config is missing"),
        (["--config=nowhere.py", "--workdir=x"], "there is no file 'nowhere.py'"),
        (["--config=configs/tiny.py:pdac", "--workdir=x"], "METHOD,TASK"),
        (["--config=configs/pdac.py"], "--workdir is missing"),
        (["--config=configs/pdac.py", "--workdir=/proc/x"], "not writable"),
        (["--config=setup.cfg", "--workdir=x"], "--config"),
        (["--config=configs/pdac.py", "--workdir=x", "stray"], "'stray'"),
    ],
)
def test_wrong_command_lines(flags, expected):
    finished = call("launch", *flags)
    assert finished.returncode == 2
    assert expected in finished.stderr


@pytest.mark.parametrize(
    "flags",
    [
        ["launch", "--config=LONG", "--workdir=x"],
        ["launch", "--config=zero:walker_walk", "--workdir=LONG"],
        ["report", "LONG"],
        ["report", ".", "--output=LONG"],
        ["collect", "--inspect=LONG"],
        ["collect", "--inspect=walker_walk", "--output=LONG"],
        ["collect", "--convert=walker_walk", "--output=LONG"],
        ["benchmark", "--config=tiny:zero,walker_walk", "--json=LONG"],
        ["evaluate", "--workdir=LONG"],
        ["evaluate", "--workdir=x", "--nogif=3"],
        ["sweep", "--methods=zero", "--workdir=LONG"],
    ],
)
def test_names_that_no_file_can_have(flags):
    name, *words = flags
    finished = call(name, *(word.replace("LONG", "a" * 300) for word in words))
    assert finished.returncode == 2
    assert "a" * 20 in finished.stderr or "--nogif is wrong" in finished.stderr


def test_the_home_of_a_user_who_does_not_exist_is_a_missing_file(tmp_path):
    source = "--config.demonstrations.source=~nobody_at_all/x.mp4"
    flags = small_run("pdac", tmp_path)
    finished = call("launch", *flags, source)
    assert finished.returncode == 2
    assert "~nobody_at_all/x.mp4 cannot be read" in finished.stderr


def test_a_run_that_came_in_between_keeps_its_settings(tmp_path, monkeypatch):
    flags = small_run("zero", tmp_path)
    config = command.read_config(word for word in flags if "--config" in word)
    config.seed = 1
    opened = workdir.opened

    def late(folder):
        workdir.write_config(folder, config, {})
        return opened(folder)

    monkeypatch.setattr(workdir, "opened", late)
    finished = call("launch", *flags)
    assert finished.returncode == 2
    assert "seed: 1 there, 0 here" in finished.stderr
    assert workdir.read_config(tmp_path).seed == 1


def test_a_missing_folder_and_a_wrong_task_come_in_one_message():
    finished = call("launch", "--config=configs/tiny.py:bco,walker_wlak")
    assert finished.returncode == 2
    assert "--workdir is missing" in finished.stderr
    assert "walker_walk" in finished.stderr


@pytest.mark.parametrize(
    ("module", "flags", "others"),
    [
        ("launch", [], ["--config is missing"]),
        ("launch", ["--config=pdac:walker_walk", "--config.sed=1"], ["seed"]),
        ("launch", ["--wrkdir=x", "--config=nowhere.py"], ["--wrkdir", "nowhere.py"]),
        ("evaluate", ["--num_episodes=no"], ["--num_episodes"]),
        ("export", ["--output=x", "stray"], ["'stray'"]),
    ],
)
def test_a_missing_folder_and_other_faults_come_in_one_message(module, flags, others):
    finished = call(module, *flags)
    assert finished.returncode == 2
    for text in ("--workdir is missing", *others):
        assert text in finished.stderr


def test_demonstrations_are_checked_before_anything_starts(tmp_path):
    config = jaxil_config.default_config("pdac", "walker_walk")
    cut_off = tmp_path / "cut.npz"
    whole = states.shipped_path("ball_in_cup_catch").read_bytes()
    cut_off.write_bytes(whole[: len(whole) // 2])
    sources = {
        str(tmp_path / "none.npz"): "none.npz",
        str(cut_off): "cut.npz",
        str(states.shipped_path("ball_in_cup_catch")): "ball_in_cup_catch",
    }
    for source, expected in sources.items():
        config.demonstrations.source = source
        faults = assembly.problems(config)
        assert len(faults) == 1
        assert expected in str(faults[0])

    config = jaxil_config.default_config("pdac", "ball_in_cup_catch")
    config.demonstrations.num_episodes = 10_000
    (fault,) = assembly.problems(config)
    assert "10000" in str(fault)


@pytest.mark.parametrize("name", ["evaluate", "collect", "benchmark", "launch"])
def test_help_says_what_the_command_does(name):
    finished = call(name, "--help")
    assert finished.returncode == 0
    assert f"jaxil {'train' if name == 'launch' else name} --" in finished.stdout


@pytest.mark.parametrize("name", ["evaluate", "export"])
def test_a_folder_without_a_run_hides_no_other_fault(name, tmp_path):
    finished = call(name, f"--workdir={tmp_path}", "--trust=nowhere", "--vdieo=1")
    assert finished.returncode == 2
    for words in ("holds no run", "--trust='nowhere'", "--vdieo"):
        assert words in finished.stderr


@pytest.mark.parametrize("name", ["evaluate", "collect"])
def test_a_folder_without_a_run_is_said(name, tmp_path):
    flag = "workdir" if name == "evaluate" else "workdirs"
    extra = [f"--output={tmp_path}/out.npz"] if name == "collect" else []
    finished = call(name, f"--{flag}={tmp_path}", *extra)
    assert finished.returncode == 2
    assert "holds no run" in finished.stderr
    assert not list(tmp_path.iterdir())


def test_all_folders_without_a_run_are_said(tmp_path):
    output = f"--output={tmp_path}/out.npz"
    finished = call("collect", "--workdirs=nope1,nope2", output)
    assert finished.returncode == 2
    for name in ("nope1", "nope2"):
        assert f"workdir='{name}' holds no run" in finished.stderr


def test_a_logger_that_cannot_be_loaded_is_named_once():
    config = jaxil_config.default_config("zero", "walker_walk")
    config.logger = "nope:Logger"
    (fault,) = assembly.problems(config)
    assert str(fault).startswith("logger='nope:Logger' cannot be loaded")


def test_a_wrong_policy_and_a_wrong_task_come_in_one_message(tmp_path):
    for task, said in (("walker_wlak", "walker_walk"), ("nope:make", "'nope:make'")):
        flags = (f"--task={task}", "--policy=nope:x", f"--output={tmp_path}/out.npz")
        finished = call("collect", *flags)
        assert finished.returncode == 2
        for words in ("--policy='nope:x' cannot be loaded", said):
            assert words in finished.stderr


def test_a_video_that_cannot_be_written_costs_no_returns(tmp_path, monkeypatch):
    policy = types.SimpleNamespace(
        config=jaxil_config.default_config("zero"), frame=2000
    )
    played = evaluation.Evaluation([], np.array([3.0]), [])
    monkeypatch.setattr(
        trained, "load", lambda folder: (policy, contextlib.nullcontext())
    )
    monkeypatch.setattr(assembly, "renderer_name", lambda *_, **__: "a renderer")
    monkeypatch.setattr(evaluation, "evaluate", lambda *_, **__: played)
    monkeypatch.setattr(film, "recorder", lambda *_: None)
    sides = [(np.zeros((2, 16, 16, 3), np.uint8), ["", ""])]
    monkeypatch.setattr(film, "sides", lambda *_, **__: sides)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "videos").touch()  # where its folder belongs
    finished = call("evaluate", f"--workdir={tmp_path}")
    assert finished.returncode == 2
    assert "mean 3.0" in finished.stdout
    assert f"{tmp_path}/videos cannot be written (File exists)" in finished.stderr
