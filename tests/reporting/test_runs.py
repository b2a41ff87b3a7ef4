"""Runs are read however little of them there is, and grouped by what they are."""

import json

import numpy as np
import pytest

from jaxil.reporting import groups, runs, summary
from jaxil.reporting.results import make_study
from tests.reporting.run_folders import EVAL_HEADER, many_runs, write_run


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    root = many_runs(tmp_path_factory.mktemp("runs"))
    read = {}
    for folder in runs.find([root]):
        try:
            run = runs.read(folder)
        except runs.UnreadableError as error:
            read[folder.name] = str(error)
        else:
            read[str(folder.relative_to(root))] = run
    return read


def test_every_run_is_found_once(found, tmp_path):
    assert len(found) == 14
    inner = write_run(tmp_path / "a" / "b" / "run", "pdac", "walker_walk", 0, {})
    decoy = inner / "checkpoints" / "1"
    decoy.mkdir(parents=True)
    (decoy / "config.json").write_text("{}")
    assert runs.find([tmp_path, inner, tmp_path / "a"]) == [inner]


def test_states(found):
    def state(name):
        return found[f"walker_walk/{name}"].state

    assert state("first") == "finished"
    assert state("not_begun") == "empty"
    assert state("header_only") == "empty"
    assert state("cut_off") == "unfinished: frame 2,000 of 3,000"


def test_what_is_missing_is_said(found):
    def remarks(name):
        return found[f"walker_walk/{name}"].remarks

    assert remarks("not_begun") == ("no eval.csv", "no train.csv")
    assert "no evaluation yet" in remarks("header_only")
    assert any("train.csv is damaged" in remark for remark in remarks("header_only"))
    assert "eval.csv: 1 rows without a number" in remarks("cut_off")
    np.testing.assert_array_equal(found["walker_walk/cut_off"].returns, [300])
    assert "is damaged" in found["damaged"]


def test_numbers_of_a_run(found):
    run = found["cartpole_swingup/pdac/seed1"]
    assert (run.frames, run.seconds, run.expert_return) == (3000, 10800, 1000)
    assert run.frames_per_second == pytest.approx(1 / 3.6)
    assert np.isnan(found["walker_walk/drqv2"].expert_return)


def test_a_frame_written_twice_counts_once_with_its_last_row(tmp_path):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, {1000: 1, 2000: 2})
    with (folder / "eval.csv").open("a") as file:
        file.write("1000,1,1,7.0,1,1000,\n")
    read = runs.read(folder)
    np.testing.assert_array_equal(read.evaluation["frame"], [1000, 2000])
    np.testing.assert_array_equal(read.returns, [7.0, 2.0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("frame,seconds\n1,2\n", "expected a column task_return_mean"),
        ("nothing\n", "frame"),
        (f"{EVAL_HEADER}\n1,2,3\n", "damaged"),
        (f"{EVAL_HEADER}\n1,2,3,good,1,1,1\n", "damaged"),
    ],
)
def test_a_damaged_table_is_named_and_the_run_kept(tmp_path, text, expected):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, {1000: 1})
    (folder / "eval.csv").write_text(text)
    run = runs.read(folder)
    assert run.state == "empty"
    assert expected in "; ".join(run.remarks)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"method": "gail"}, "gail"),
        ({"task": 3}, "task"),
        ({"seed": "0"}, "seed"),
        ({"seed": None}, "seed"),
        ({"total_frames": True}, "total_frames"),
        ({"sinkhorn": 3}, "sinkhorn"),
        ({"batch_size": {"a": 1}}, "batch_size"),
        ({"demonstrations": {"num_episodes": "ten"}}, "num_episodes"),
    ],
)
def test_a_config_of_something_else_is_refused(tmp_path, change, expected):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, None)
    stored = json.loads((folder / "config.json").read_text())
    stored["config"].update(change)
    (folder / "config.json").write_text(json.dumps(stored))
    with pytest.raises(runs.UnreadableError, match=expected):
        runs.read(folder)


def test_failed_runs_of_a_sweep_are_named(tmp_path):
    late = write_run(tmp_path / "late", "pdac", "walker_walk", 0, {1000: 1})
    early = tmp_path / "early"
    early.mkdir()
    for folder in (early, late):
        (folder / "failed.json").write_text('{"exit_status": 3}')
    assert runs.find([tmp_path]) == [early, late]
    assert "failed, exit status 3; its log says why" in runs.read(late).remarks
    with pytest.raises(runs.UnreadableError, match="the run failed, exit status 3"):
        runs.read(early)


@pytest.mark.parametrize("text", ["", "[]", '{"config": 3}', "\xff", "[" * 10**5])
def test_what_is_no_config_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(runs.UnreadableError):
        runs.read(tmp_path)


def test_fields_that_an_older_config_lacks_have_their_defaults(tmp_path):
    old = write_run(tmp_path / "old", "pdac", "walker_walk", 0, {1000: 1})
    stored = json.loads((old / "config.json").read_text())
    del stored["config"]["pre_tanh_penalty"], stored["config"]["sinkhorn"]
    (old / "config.json").write_text(json.dumps(stored))
    new = write_run(tmp_path / "new", "pdac", "walker_walk", 1, {1000: 1})
    (group,) = groups.make_groups([runs.read(old), runs.read(new)])
    assert [run.seed for run in group.runs] == [0, 1]


def test_groups_are_seeds_of_one_thing_in_the_papers_order(found):
    made = groups.make_groups(run for run in found.values() if not isinstance(run, str))
    named = [(group.task, group.label, len(group.runs)) for group in made]
    assert named == [
        ("cartpole_swingup", "P-DAC", 3),
        ("cartpole_swingup", "P-DAC, no augmentation", 1),
        ("cartpole_swingup", "P-SIL", 2),
        ("walker_walk", "P-DAC (action_repeat 2, batch_size 256)", 2),
        ("walker_walk", "P-DAC (action_repeat 4, batch_size 64)", 1),
        ("walker_walk", "P-SIL", 3),
        ("walker_walk", "DrQ-v2", 1),
    ]


def test_only_settings_that_matter_split_a_group(tmp_path):
    def read(name, method, **changes):
        changes = {key.replace("__", "."): value for key, value in changes.items()}
        folder = tmp_path / name
        write_run(folder, method, "walker_walk", 0, {1000: 1}, changes=changes)
        return runs.read(folder)

    pdac = [
        read("a", "pdac"),
        read("b", "pdac", sinkhorn__epsilon=0.5, video_every_evals=0),
        read("speed", "pdac", encoder__convolutions="xla", replay_on_device=True),
        read("old", "pdac", encoder__chunk_size=0),
    ]
    assert len(groups.make_groups(pdac)) == 1
    pdac.append(read("c", "pdac", discriminator__gradient_penalty=1.0))
    assert [group.settings for group in groups.make_groups(pdac)] == [
        "discriminator.gradient_penalty 1",
        "discriminator.gradient_penalty 10",
    ]
    psil = [read("d", "psil"), read("e", "psil", sinkhorn__epsilon=0.5)]
    assert len(groups.make_groups(psil)) == 2


def test_what_a_reader_should_know_is_said(found):
    read = [run for run in found.values() if not isinstance(run, str)]
    study = make_study(groups.make_groups(read))
    text = "\n".join(summary.remarks(study, ["a/config.json is damaged"]))
    for words in (
        "a/config.json is damaged",
        "no eval.csv: ",
        "unfinished, shown as far as they are: ",
        "seed 0 is there 2 times and counts as often: ",
        "walker_walk: the runs imitate different experts",
        "900.0 for P-DAC (action_repeat 4, batch_size 64)",
        "without demonstrations, DrQ-v2 have no shares of an expert",
        "walker_walk: what is compared differs also in action_repeat, batch_size",
        "1 on cartpole_swingup",
    ):
        assert words in text
    rows = {tuple(row[:2]): row[2:] for row in summary.seed_table(study, 4).rows}
    assert rows["cartpole_swingup", "P-DAC"] == ("0-2", 3, 0, 0, "3")
    assert rows["walker_walk", "P-SIL"] == ("0-2", 0, 1, 2, "3")


def test_looks_are_one_colour_for_a_method_and_differ_within_it(found):
    read = [run for run in found.values() if not isinstance(run, str)]
    study = make_study(groups.make_groups(read))
    assert study.looks["P-DAC"].colour == "#0072b2"
    assert study.looks["P-SIL"].colour == "#d55e00"
    pdac = [look for label, look in study.looks.items() if label.startswith("P-DAC")]
    assert len(set(pdac)) == len(pdac) == 4
