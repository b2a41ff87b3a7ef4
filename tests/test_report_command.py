"""`jaxil report`: repeatable, watching, interrupted, damaged runs, wrong use."""

import zipfile

import pytest

from jaxil import command, report
from jaxil.reporting import tables
from tests.commands import run
from tests.reporting.run_folders import film, write_run


def test_the_same_runs_give_the_same_bytes(tmp_path):
    name = "<b>$x_1$<i> & co"  # shown as it is
    task = "é" * 190  # which no file's name has room for
    one = write_run(
        tmp_path / "runs" / name,
        "psil",
        "hopper_hop",
        0,
        {1000: 10, 3000: 20},
        changes={"task": task},
    )
    film(one, 3000, plan=True)
    outputs = [tmp_path / "first", tmp_path / "second"]
    for output in outputs:
        report.main(["report", str(tmp_path / "runs"), "--output", str(output)])
    files = [
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*.*")}
        for out in outputs
    ]
    assert files[0] == files[1]
    text = (outputs[0] / "index.html").read_text()
    assert "&lt;b&gt;$x_1$&lt;i&gt; &amp; co" in text
    assert name not in text
    assert task in text
    for panel in ("rewards", "transport plan", "alignment"):
        assert f"<h4>{panel}</h4>" in text
    assert "runs are finished" not in text, "nobody asked for a number of seeds"


def test_watching_writes_the_page_again_until_ctrl_c(tmp_path, monkeypatch):
    write_run(tmp_path / "runs" / "first", "pdac", "walker_walk", 0, None)
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) == 2:
            raise KeyboardInterrupt
        write_run(tmp_path / "runs" / "second", "pdac", "hopper_hop", 0, None)

    monkeypatch.setattr(report.time, "sleep", sleep)
    report.main(
        ["report", str(tmp_path / "runs"), f"--output={tmp_path}/out", "--watch", "7"]
    )
    assert slept == [7, 7]
    text = (tmp_path / "out" / "index.html").read_text()
    assert "hopper_hop" in text
    assert '<meta http-equiv="refresh" content="7">' in text


def test_damaged_runs_do_not_end_the_report_of_the_others(tmp_path):
    good = write_run(tmp_path / "runs" / "good", "pdac", "walker_walk", 0, {1000: 10})
    film(good, 1000, plan=True)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000,), }"
    with zipfile.ZipFile(good / "videos" / "frame_000001000.npz", "w") as file:
        array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        file.writestr("plan.npy", array)
    deep = write_run(tmp_path / "runs" / "deep", "pdac", "walker_walk", 1, {1000: 10})
    (deep / "config.json").write_text("[" * 200_000)
    name = b"\xff".decode(errors="surrogateescape")
    odd = write_run(tmp_path / "runs" / name, "pdac", "walker_walk", 2, {1000: 1e308})
    (odd / "failed.json").write_text("[" * 200_000)
    endless = write_run(tmp_path / "runs" / "endless", "pdac", "walker_walk", 3, None)
    (endless / "failed.json").write_text('{"exit_status": 1e999}')
    report.main(["report", str(tmp_path / "runs"), f"--output={tmp_path}/out"])
    text = (tmp_path / "out" / "index.html").read_text()
    for words in (
        "array plan whose header claims a wrong length",
        "deep/config.json is damaged",
        "eval.csv: 1 rows without a number",
        "failed, exit status unknown",
    ):
        assert words in text
    returns = (tmp_path / "out" / "tables" / "final_returns.csv").read_text()
    assert "\nwalker_walk,P-DAC," in returns


def test_a_report_of_runs_whose_hours_are_unknown(tmp_path):
    folder = write_run(tmp_path / "runs", "pdac", "walker_walk", 0, {1000: 10})
    text = "frame,task_return_mean\n1000,10\n"
    (folder / "eval.csv").write_text(text)
    report.main(["report", str(tmp_path / "runs"), f"--output={tmp_path}/out"])
    page = (tmp_path / "out" / "index.html").read_text()
    assert "P-DAC" in page
    assert "By hours" not in page


def test_an_interrupted_report_leaves_the_old_one(tmp_path, monkeypatch):
    write_run(tmp_path / "runs", "drqv2", "walker_walk", 0, None)
    arguments = ["report", str(tmp_path / "runs"), f"--output={tmp_path}/out"]
    report.main(arguments)  # a run that has not begun gives a page, too
    before = (tmp_path / "out" / "index.html").read_bytes()
    assert b"No run has an evaluation yet." in before
    write_run(tmp_path / "runs" / "more", "pdac", "hopper_hop", 0, {1000: 1})

    def interrupt(_):
        assert len(list(tmp_path.iterdir())) == 3  # it is being written
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tables, "to_csv", interrupt)
        with pytest.raises(KeyboardInterrupt):
            report.main(arguments)
    assert (tmp_path / "out" / "index.html").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "runs"]


def test_all_faults_come_in_one_message(tmp_path):
    (tmp_path / "file").write_text("")
    finished = run(
        "report", str(tmp_path / "a"), str(tmp_path / "b"), f"--output={tmp_path}/file"
    )
    assert finished.returncode == 2
    assert "Traceback" not in finished.stderr
    for words in (f"{tmp_path}/a'", f"{tmp_path}/b'", "file' is a file"):
        assert words in finished.stderr


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], "name the folders of runs"),
        (["."], "holds README.md, which is no part of a report"),
        (["{empty}"], "no run can be read in or below"),
        (["{damaged}"], "config.json is damaged"),
        (["{damaged}", "--seeds=0"], "seeds"),
        (["{damaged}", "--ouput=x"], "--output"),
        (["{damaged}", "--output="], "--output is empty"),
    ],
)
def test_wrong_use(tmp_path, flags, expected):
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged").mkdir()
    (tmp_path / "damaged" / "config.json").write_text("{")
    (tmp_path / "README.md").write_text("mine")
    names = {name: str(tmp_path / name) for name in ("empty", "damaged")}
    words = [flag.format(**names) for flag in flags]
    if not any(word.startswith("--o") for word in words):
        words.append(f"--output={tmp_path if '.' in flags else tmp_path / 'out'}")
    with pytest.raises(command.UsageError) as raised:
        report.main(["report", *words])
    assert expected in str(raised.value)
    assert not (tmp_path / "out").exists()
