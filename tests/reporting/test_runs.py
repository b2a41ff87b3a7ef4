"""Runs are read even if incomplete or damaged, and grouped by their settings."""

import json
import os

import numpy as np
import pytest

from jaxil import methods
from jaxil.reporting import episodes, groups, measures, remarks, runs, tables
from tests.reporting.run_folders import (
    EVAL_HEADER,
    change_config,
    film,
    groups_below,
    many_runs,
    write_run,
)


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


@pytest.fixture(scope="module")
def made(found):
    return groups.make_groups(run for run in found.values() if not isinstance(run, str))


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


def test_missing_and_damaged_files_are_reported(found):
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
        (f"{EVAL_HEADER}\n1,2,3,{'9' * 140_000},1,1,1\n", "damaged"),
        (f"{EVAL_HEADER}\n1,2,3,{'9' * 400},1,1,1\n", "rows without a number"),
        (f"{EVAL_HEADER}\n1,2,3,1e308,1,1,1\n", "rows without a number"),
    ],
)
def test_a_damaged_table_is_named_and_the_run_kept(tmp_path, text, expected):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, {1000: 1})
    (folder / "eval.csv").write_text(text)
    run = runs.read(folder)
    assert run.state == "empty"
    assert max(map(len, run.remarks)) < 300
    assert expected in "; ".join(run.remarks)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"method": ""}, "method"),
        ({"task": "\x1b[31m"}, "damaged task"),
        ({"task": "\ud800"}, "is damaged"),
        ({"batch_size": 10**400}, "batch_size"),
        ({"task": 3}, "task"),
        ({"seed": "0"}, "seed"),
        ({"seed": None}, "seed"),
        ({"total_frames": True}, "total_frames"),
        ({"discriminator": 3}, "discriminator"),
        ({"batch_size": {"a": 1}}, "batch_size"),
        ({"demonstrations": {"num_episodes": "ten"}}, "num_episodes"),
    ],
)
def test_a_damaged_config_is_refused(tmp_path, change, expected):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, None)
    change_config(folder, change)
    with pytest.raises(runs.UnreadableError, match=expected):
        runs.read(folder)


def test_failed_runs_of_a_sweep_are_named(tmp_path):
    late = write_run(tmp_path / "late", "pdac", "walker_walk", 0, {1000: 1})
    early = tmp_path / "early"
    early.mkdir()
    for folder in (early, late):
        (folder / "failed.json").write_text('{"exit_status": 3}')
    assert runs.find([tmp_path]) == [early, late]
    assert "failed, exit status 3; see its log" in runs.read(late).remarks
    with pytest.raises(runs.UnreadableError, match="the run failed, exit status 3"):
        runs.read(early)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"config": 3}', "\xff", "[" * 200_000, "9" * 10_000]
)
def test_what_is_no_config_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(runs.UnreadableError):
        runs.read(tmp_path)


def test_pipes_are_refused_not_waited_for(tmp_path):
    folder = write_run(tmp_path / "run", "pdac", "walker_walk", 0, None)
    os.mkfifo(folder / "eval.csv")
    assert any("eval.csv cannot be read" in r for r in runs.read(folder).remarks)
    (folder / "config.json").unlink()
    os.mkfifo(folder / "config.json")
    with pytest.raises(runs.UnreadableError, match="cannot be read"):
        runs.read(folder)


@pytest.mark.parametrize("seconds", [np.nan, -1.0, None])
def test_a_video_is_shown_without_what_is_damaged_beside_it(tmp_path, seconds):
    folder = write_run(tmp_path / "run", "psil", "walker_walk", 0, {1000: 1})
    film(folder, 1000, plan=True)
    path = folder / "videos" / "frame_000001000.npz"
    path.unlink()
    if seconds is None:
        os.mkfifo(path)
        expected = "is left out: it cannot be read (not a regular file)"
    else:
        np.savez(path, imitation_rewards=np.ones(3), step_seconds=np.asarray(seconds))
        expected = "it has an array step_seconds that is no duration"
    ((episode,), (sentence,)) = episodes.collect(groups_below(tmp_path), 1)
    assert episode.sheet is None
    assert sentence.endswith(expected)


def test_fields_of_an_older_config_have_defaults_or_are_ignored(tmp_path):
    old = write_run(tmp_path / "old", "pdac", "walker_walk", 0, {1000: 1})
    stored = json.loads((old / "config.json").read_text())
    del stored["config"]["pre_tanh_penalty"], stored["config"]["discriminator"]
    stored["config"]["sinkhorn"] = {"epsilon": 3}  # of methods that P-DAC is not
    stored["config"]["encoder"]["chunk_size"] = 7
    (old / "config.json").write_text(json.dumps(stored))
    write_run(tmp_path / "new", "pdac", "walker_walk", 1, {1000: 1})
    (group,) = groups_below(tmp_path)
    assert [run.seed for run in group.runs] == [0, 1]


def test_groups_are_seeds_with_equal_settings_in_the_papers_order(made):
    named = [(group.task, group.label, len(group.runs)) for group in made]
    assert named == [
        ("cartpole_swingup", "P-DAC", 3),
        ("cartpole_swingup", "P-DAC, no augmentation", 1),
        ("cartpole_swingup", "P-SIL", 2),
        ("walker_walk", "P-DAC", 2),
        ("walker_walk", "P-DAC (A)", 1),
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
        read("b", "pdac", eval_every_frames=20, video_every_evals=0, logger="wandb"),
        read("speed", "pdac", encoder__convolutions="xla", replay_on_device=True),
    ]
    assert len(groups.make_groups(pdac)) == 1
    pdac.append(read("c", "pdac", discriminator__gradient_penalty=1.0))
    assert [group.label for group in groups.make_groups(pdac)] == [
        "P-DAC",
        "P-DAC (discriminator.gradient_penalty 1)",
    ]
    sil = [read("d", "sil"), read("e", "sil", discriminator__learning_rate=0.5)]
    sil.append(read("f", "sil", discriminator__batch_size=64))
    assert len(groups.make_groups(sil)) == 3


def test_several_settings_get_a_letter_and_a_row_that_explains_it(made):
    (row,) = tables.settings_table(made).rows
    assert row == {"variant": "P-DAC (A)", "settings": "action_repeat 4, batch_size 64"}


def test_a_label_means_the_same_on_every_task(tmp_path):
    for number, (task, changes) in enumerate(
        (
            ("walker_walk", {}),
            ("walker_walk", {"batch_size": 64}),
            ("hopper_hop", {"action_repeat": 4}),
            ("hopper_hop", {"action_repeat": 4, "batch_size": 64}),
            ("hopper_hop", {"action_repeat": 4, "shift_padding": 0}),
            ("walker_walk", {"shift_padding": 0}),
        )
    ):
        folder = tmp_path / str(number)
        write_run(folder, "pdac", task, 0, {1000: 1}, changes=changes)
    assert {(group.task, group.label) for group in groups_below(tmp_path)} == {
        (task, label)
        for task in ("walker_walk", "hopper_hop")
        for label in ("P-DAC", "P-DAC (batch_size 64)", "P-DAC, no augmentation")
    }


def test_what_a_preset_sets_for_a_task_splits_no_method(tmp_path):
    for task, size in (("cartpole_swingup", 400_000), ("walker_walk", 700_000)):
        changes = {"replay_size_steps": size}
        write_run(tmp_path / task, "pdac", task, 0, {1000: 1}, changes=changes)
    assert [group.label for group in groups_below(tmp_path)] == ["P-DAC", "P-DAC"]


def test_methods_with_one_label_are_told_apart(tmp_path, monkeypatch):
    declared = {name: methods.get(name) for name in ("pdac", "psil")}
    same = {name: each._replace(label="Same") for name, each in declared.items()}
    monkeypatch.setattr(methods, "get", same.__getitem__)
    for name in same:
        write_run(tmp_path / name, name, "walker_walk", 0, {1000: 1})
    made = groups_below(tmp_path)
    assert [group.label for group in made] == ["Same", "Same [psil]"]
    assert made[0].look != made[1].look


def test_a_return_is_a_share_of_its_own_experts(tmp_path):
    for seed, expert in enumerate((1000.0, 500.0)):
        folder = tmp_path / str(seed)
        write_run(folder, "pdac", "walker_walk", seed, {1000: 500}, expert=expert)
    (row,) = tables.final_table(measures.finals(groups_below(tmp_path))).rows
    assert row["share_of_expert"] == 0.75  # 500 of 1000, and 500 of 500


def test_unusual_runs_and_limited_comparisons_are_reported(made):
    text = "\n".join(remarks.remarks(made))
    for words in (
        "no eval.csv: ",
        "unfinished, shown as far as they are: ",
        "walker_walk, P-DAC: 2 runs have seed 0, and each counts: ",
        "walker_walk: the runs imitate different experts",
        "900.0 for P-DAC (A)",
        "no expert's return is known for DrQ-v2, so no share of it is shown",
        "walker_walk: compared runs also differ in action_repeat, batch_size",
        "1 on cartpole_swingup",
    ):
        assert words in text
    rows = [tuple(row.values()) for row in tables.seed_table(made, 4).rows]
    assert ("cartpole_swingup", "P-DAC", "0-2", 3, 0, 0, "3") in rows
    assert ("walker_walk", "P-SIL", "0-2", 0, 1, 2, "3") in rows
    assert "missing" not in tables.seed_table(made, None).rows[0]


def test_fields_of_one_method_alone_are_no_difference(tmp_path):
    for method in ("pdac", "psil"):
        write_run(tmp_path / method, method, "walker_walk", 0, {1000: 1.0})
    said = remarks.remarks(groups_below(tmp_path))
    assert not any("differ" in line for line in said)


def test_looks_are_one_colour_for_a_method_and_differ_within_it(made):
    looks = {group.label: group.look for group in made}
    assert looks["P-DAC"].colour == "#0072b2"
    assert looks["P-SIL"].colour == "#d55e00"
    pdac = [look for label, look in looks.items() if label.startswith("P-DAC")]
    assert len(set(pdac)) == len(pdac) == 3


def test_sample_efficiency_up_to_100000_frames(tmp_path):
    curves = [{50_000: 500, 150_000: 1000}, {50_000: 250, 150_000: 500}, {50_000: 900}]
    for seed, returns in enumerate(curves):
        write_run(tmp_path / str(seed), "psil", "walker_walk", seed, returns)
    (row,) = tables.efficiency_table(groups_below(tmp_path)).rows
    # 0.4375 and half of it; the third run is too short to count.
    assert row["share_to_100k"] == pytest.approx(0.328125)
    assert row["share_to_100k_low"] < row["share_to_100k"] < row["share_to_100k_high"]


@pytest.mark.parametrize("expert", [-150.0, 0.0, ""])
def test_there_are_no_shares_of_an_expert_without_positive_return(tmp_path, expert):
    returns = {1000: -150, 150_000: -60}
    write_run(tmp_path / "run", "psil", "walker_walk", 0, returns, expert=expert)
    (row,) = tables.efficiency_table(groups_below(tmp_path)).rows
    shares = ("reached_50", "reached_90", "frames_50", "hours_90", "share_to_100k")
    assert np.isnan([row[name] for name in shares]).all()
