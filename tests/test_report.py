"""The report of hand-made runs: its numbers, and its page in a browser.

Some 25 seconds on an idle core, most of them Matplotlib's.
"""

import collections
import csv
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest

from jaxil import report
from tests.reporting.run_folders import many_runs

_BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    None,
)
# 2.91999 is Student's t of 2 degrees of freedom at 95 %, 6.31375 of 1.
_T2, _T1 = 2.91999, 6.31375


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("report")
    many_runs(root / "runs")
    report.main(["report", str(root / "runs"), f"--output={root}/out", "--seeds=4"])
    return root / "out"


def rows(folder, name):
    """Returns a CSV table as dictionaries by (task, variant), in its order."""
    found = collections.defaultdict(list)
    with (folder / "tables" / f"{name}.csv").open() as file:
        for row in csv.DictReader(file):
            found[row.get("task"), row["variant"]].append(row)
    return found


def numbers(row, *keys):
    return [float(row[key]) if row[key] else np.nan for key in keys]


def test_curves_by_frames(folder):
    found = rows(folder, "learning_by_frames")
    pdac = found["cartpole_swingup", "P-DAC"]
    # 100, 200, 300; 500, 700, 900; 800, 900, 1000: deviations 100, 200, 100.
    half = _T2 * np.array([100, 200, 100]) / np.sqrt(3)
    expected = np.array([200, 700, 900])
    for row, mean, width in zip(pdac, expected, half, strict=True):
        np.testing.assert_allclose(
            numbers(row, "mean", "low", "high"),
            [mean, mean - width, mean + width],
            rtol=1e-5,
        )
    # Seed 0 has 100 at 1000 and 300 at 3000, hence 200 at 2000; seed 1 has 400 there.
    psil = [
        numbers(row, "frame", "seeds", "mean", "low")
        for row in found["cartpole_swingup", "P-SIL"]
    ]
    np.testing.assert_allclose(psil[0], [1000, 1, 100, np.nan])
    np.testing.assert_allclose(psil[1], [2000, 2, 300, 300 - _T1 * 100], rtol=1e-5)
    np.testing.assert_allclose(psil[2], [3000, 2, 450, 450 - _T1 * 150], rtol=1e-5)


def test_curves_by_hours(folder):
    pdac = rows(folder, "learning_by_hours")["cartpole_swingup", "P-DAC"]
    points = [numbers(row, "hours", "mean") for row in pdac]
    assert points == [[1, 200], [2, 700], [3, 900]]


def test_distance_to_the_expert(folder):
    pdac = rows(folder, "wasserstein")["cartpole_swingup", "P-DAC"]
    np.testing.assert_allclose([float(row["mean"]) for row in pdac], [0.9, 0.8, 0.7])


def test_final_returns(folder):
    found = rows(folder, "final_returns")
    (row,) = found["cartpole_swingup", "P-DAC"]
    assert numbers(row, "runs", "finished", "mean", "iqm", "median", "expert") == [
        *(3, 3, 900, 900, 900, 1000)
    ]
    assert float(row["share_of_expert"]) == pytest.approx(0.9)
    (row,) = found["walker_walk", "P-DAC"]
    assert numbers(row, "runs", "mean", "median") == [2, 500, 500]
    assert float(row["mean_low"]) == pytest.approx(500 - _T1 * 100, rel=1e-5)
    (row,) = found["cartpole_swingup", "P-DAC, no augmentation"]
    assert numbers(row, "runs", "finished", "mean") == [1, 0, 150]
    assert row["mean_low"] == row["iqm_low"] == ""


def test_tasks_are_aggregated_in_shares_of_their_experts(folder):
    (row,) = rows(folder, "all_tasks")[None, "P-SIL"]
    # 300 and 600 of 1000 on cartpole, 300 of 1000 on walker.
    assert numbers(row, "tasks", "runs") == [2, 3]
    np.testing.assert_allclose(
        numbers(row, "iqm", "median", "mean", "iqm_low", "iqm_high"),
        [0.4, 0.3, 0.4, 0.3, 0.5],
    )


def test_sample_efficiency(folder):
    found = rows(folder, "sample_efficiency")
    (row,) = found["cartpole_swingup", "P-DAC"]
    # 500 is reached at 2000 by all, 800 at 3000, 3000 and 2000, 900 never, 3000, 2000.
    assert numbers(row, "reached_50", "frames_50", "hours_50") == [1, 2000, 2]
    assert numbers(row, "reached_80", "frames_80", "hours_80") == [1, 3000, 3]
    assert float(row["reached_90"]) == pytest.approx(2 / 3)
    assert numbers(row, "frames_90", "hours_90") == [3000, 3]
    assert float(row["frames_per_second"]) == pytest.approx(1 / 3.6)
    assert row["share_to_100k"] == ""  # none is as long
    (row,) = found["cartpole_swingup", "P-SIL"]
    assert numbers(row, "reached_50") == [0.5]
    assert row["frames_50"] == ""
    (row,) = found["walker_walk", "DrQ-v2"]
    assert row["reached_50"] == ""  # it imitates none


def test_runs(folder):
    found = rows(folder, "runs")
    assert sum(map(len, found.values())) == 13
    first = found["cartpole_swingup", "P-DAC"][0]
    assert first["state"] == "finished"
    assert numbers(first, "seed", "frames", "last_return", "frames_50") == [
        *(0, 3000, 800, 2000)
    ]
    (row,) = found["walker_walk", "P-DAC (A)"]
    assert row["settings"] == "action_repeat=4, batch_size=64"
    assert [row["state"] for row in found["walker_walk", "P-SIL"]] == [
        "empty",
        "empty",
        "unfinished: frame 2,000 of 3,000",
    ]


def test_figures_are_written_twice(folder):
    written = {path.name for path in (folder / "figures").iterdir()}
    names = "learning_by_frames final_returns wasserstein figure02 figure06"
    for name in (*names.split(), "logits", "metrics"):
        assert {f"{name}.png", f"{name}.svg"} <= written
    assert "figure12.png" not in written  # no run of what it compares with P-DAC
    for path in (folder / "figures").glob("*.svg"):
        ElementTree.parse(path)
    assert any(name.startswith("episode1_") for name in written)


def test_what_the_papers_figures_lack(folder):
    text = (folder / "index.html").read_text()
    # Of 8 tasks, 5 methods and 4 seeds: 3 + 2 on cartpole; 1 + 0 on walker, where the
    # two that differ in batch size have the same seed.
    assert "6 of 160 runs are finished" in text
    assert (
        "jaxil sweep --ablation=figure6 --tasks=cartpole_swingup,"
        "finger_spin,ball_in_cup_catch,acrobot_swingup,cheetah_run,walker_stand,"
        "walker_walk,walker_run --seeds=4 --workdir=DIR" in text
    )


def test_what_cannot_be_shown_is_reported(folder):
    text = (folder / "index.html").read_text()
    for words in ("it is not a whole MP4", "config.json is damaged", "no eval.csv"):
        assert words in text


@pytest.fixture(scope="module")
def browser():
    if _BROWSER is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(
            executable_path=_BROWSER, args=["--no-sandbox"]
        )
        yield opened
        opened.close()


def unfold(page):
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (400, "dark")])
def test_the_page_in_a_browser(folder, browser, width, scheme):
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme
    )
    page = context.new_page()
    said, asked = [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto((folder / "index.html").as_uri())
    unfold(page)
    page.wait_for_function(
        "[...document.querySelectorAll('video')].every(v => v.readyState >= 2)"
    )
    assert said == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []

    boxes = page.evaluate(
        """[...document.querySelectorAll("svg:not(.swatch), video")].map((element) => {
             const box = element.getBoundingClientRect();
             return [box.left, box.width, box.height]; })"""
    )
    assert len(boxes) > 20
    for left, across, high in boxes:
        assert across > 250
        assert high > 80
        assert left >= 0
        assert left + across <= width
    # Wide tables scroll in boxes of their own, the page never does.
    assert page.evaluate("document.documentElement.scrollWidth") == width
    videos = page.evaluate(
        "[...document.querySelectorAll('video')].map(v => [v.videoWidth, v.duration])"
    )
    assert len(videos) == 2
    for across, seconds in videos:
        assert across == 2 * 256 + 8
        assert seconds == pytest.approx(2.0, abs=0.1)  # 30 pictures, 15 a second
    context.close()


def test_columns_sort_and_a_line_follows_the_video(folder, browser):
    page = browser.new_page()
    page.goto((folder / "index.html").as_uri())
    unfold(page)
    table = "table[data-name=final_returns]"
    column = f"{table} tbody td:nth-child(5)"

    def means():
        return [float(text) for text in page.locator(column).all_inner_texts()]

    for order in (1, -1):
        page.click(f"{table} th:nth-child(5)")
        assert means() == sorted(means())[::order]
    # The line across the rewards is at the video's time.
    page.wait_for_function("document.querySelector('video').readyState >= 2")
    share = page.evaluate(
        """new Promise((resolve) => {
             const episode = document.querySelector(".episode");
             const video = episode.querySelector("video");
             video.addEventListener("seeked", () => {
               const svg = episode.querySelector("svg");
               const box = svg.querySelector("[id$='-patch_2']").getBBox();
               const line = svg.querySelector("svg > line");
               resolve((line.x1.baseVal.value - box.x) / box.width); });
             video.currentTime = video.duration / 4; })"""
    )
    assert share == pytest.approx(0.25, abs=0.02)
