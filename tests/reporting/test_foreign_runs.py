"""Runs from elsewhere: behind links, and of methods that are not installed."""

from jaxil.reporting import groups, runs
from tests.reporting.run_folders import change_config, write_run


def read_foreign(folder, seed, method, own):
    write_run(folder, "pdac", "walker_walk", seed, {1000: 1})
    change_config(folder, {"method": method, "own": own})
    return runs.read(folder)


def test_linked_runs_are_found_and_circles_of_links_end(tmp_path):
    elsewhere = write_run(tmp_path / "far" / "run", "pdac", "walker_walk", 0, {})
    (tmp_path / "near").mkdir()
    (tmp_path / "near" / "linked").symlink_to(elsewhere)
    (tmp_path / "near" / "back").symlink_to(tmp_path / "near")
    assert runs.find([tmp_path / "near"]) == [tmp_path / "near" / "linked"]


def test_code_that_only_folders_name_is_not_run(tmp_path, monkeypatch):
    (tmp_path / "evil_method.py").write_text("raise SystemExit('it was run')")
    monkeypatch.syspath_prepend(tmp_path)
    shown = []
    for seed, own in enumerate(({"size": 1, "rate": 2}, {"size": 2})):
        folder = tmp_path / str(seed)
        shown.append(read_foreign(folder, seed, "evil_method:METHOD", own))
    labels = [group.label for group in groups.make_groups(shown)]
    assert labels == [f"evil_method:METHOD (own.size {size})" for size in (1, 2)]


def test_names_of_unknown_fields_that_no_page_can_hold_are_left_out(tmp_path):
    own = {"fine": 1, "\x1b[31m": 2, "long" * 1000: 3}
    config = read_foreign(tmp_path / "run", 0, "gone.away:METHOD", own).config
    assert [name for name in config if name.startswith("own.")] == ["own.fine"]


def test_a_run_whose_method_is_not_installed_is_shown(tmp_path):
    shown = []
    for seed, size in enumerate((1, 1, 2)):
        folder, own = tmp_path / str(seed), {"size": size}
        shown.append(read_foreign(folder, seed, "gone.away:METHOD", own))
    said = "'gone.away:METHOD' is code that only its folder names: --trust=gone.away:"
    assert said in " ".join(shown[0].remarks)
    made = groups.make_groups(shown)
    assert [(group.label, len(group.runs)) for group in made] == [
        ("gone.away:METHOD (own.size 1)", 2),
        ("gone.away:METHOD (own.size 2)", 1),
    ]
