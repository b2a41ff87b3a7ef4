"""The page's look and its few movements: sorting, and a line that follows a video."""

CSS = """
:root { color-scheme: light dark; --page: #fbfbfa; --card: #ffffff; --ink: #1b1c1e;
  --soft: #5d6066; --line: #dfe0e2; --accent: #0072B2; --warn: #fff4d6; }
@media (prefers-color-scheme: dark) {
  :root { --page: #131416; --card: #1c1d20; --ink: #e8e9eb; --soft: #a2a5ab;
    --line: #36383c; --accent: #56B4E9; --warn: #3a3118; } }
* { box-sizing: border-box; }
html { scroll-padding-top: 3.2rem; }
body { margin: 0; background: var(--page); color: var(--ink); line-height: 1.5;
  font: 16px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans",
  "Liberation Sans", "DejaVu Sans", sans-serif; }
header, main { max-width: 1320px; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 1.6rem; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 .4rem; padding-top: .7rem;
  border-top: 2px solid var(--ink); }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .3rem; }
h4 { font-size: .92rem; margin: 0 0 .2rem; }
p { max-width: 76ch; margin: .4rem 0 .8rem; }
nav { position: sticky; top: 0; z-index: 2; background: var(--page);
  border-bottom: 1px solid var(--line); margin-top: 1rem; }
nav div { max-width: 1320px; margin: 0 auto; padding: .45rem 1.25rem; display: flex;
  gap: 1.1rem; overflow-x: auto; white-space: nowrap; font-size: .9rem; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
.facts { display: flex; flex-wrap: wrap; gap: .6rem 2.2rem; margin: 1rem 0; padding: 0;
  list-style: none; }
.facts b { display: block; font-size: 1.6rem; line-height: 1.15;
  font-variant-numeric: tabular-nums; }
.facts span, figcaption, .soft { color: var(--soft); font-size: .875rem; }
.remarks { background: var(--warn); border-radius: 6px; padding: .7rem 1rem .7rem 2rem;
  font-size: .9rem; margin: .8rem 0; overflow-wrap: anywhere; }
.remarks li { margin: .15rem 0; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px;
  background: var(--card); margin: .6rem 0 1rem; }
table { border-collapse: collapse; font-size: .875rem; width: 100%; }
th, td { padding: .36rem .7rem; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); }
tbody tr:last-child td { border-bottom: 0; }
th { font-weight: 600; vertical-align: bottom; white-space: nowrap; cursor: pointer;
  user-select: none; }
th[aria-sort=ascending]::after { content: " \\2191"; }
th[aria-sort=descending]::after { content: " \\2193"; }
td.medium { min-width: 12rem; } td.long { min-width: 24rem; }
td:not(.number) { overflow-wrap: break-word; }
.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
figure { margin: .6rem 0 1.2rem; }
.legend { display: flex; flex-wrap: wrap; gap: .15rem 1.4rem; margin: .3rem 0 .7rem;
  padding: 0; list-style: none; font-size: .875rem; }
.legend li { display: flex; align-items: baseline; gap: .5rem; min-width: 0; }
.swatch { width: 34px; height: 10px; flex: none; }
.panels { display: grid; gap: 1rem; align-items: start;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 370px), 1fr)); }
.panel, .episode { background: var(--card); border: 1px solid var(--line);
  border-radius: 6px; padding: .7rem .7rem .4rem; min-width: 0; }
.panel svg, .episode svg { display: block; width: 100%; height: auto; }
.panel svg text, .episode svg text { font-family: inherit !important; }
figcaption { max-width: 90ch; margin-top: .5rem; }
video { width: 100%; display: block; border-radius: 4px; background: #000; }
.episode p { margin: 0 0 .4rem; font-size: .875rem; overflow-wrap: anywhere; }
pre { overflow-x: auto; background: var(--card); border: 1px solid var(--line);
  border-radius: 6px; padding: .6rem .8rem; font-size: .8rem; }
details { margin: .5rem 0 1rem; }
summary { cursor: pointer; font-size: .9rem; }
td.full { color: #009E73; font-weight: 600; } td.none { color: var(--soft); }
@media (max-width: 600px) { body { font-size: 15px; }
  header, main, nav div { padding-left: .8rem; padding-right: .8rem; } }
@media print { nav { display: none; } .panel { break-inside: avoid; } }
"""

SCRIPT = """
for (const head of document.querySelectorAll("th")) {
  head.addEventListener("click", () => {
    const column = head.cellIndex, body = head.closest("table").tBodies[0];
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentNode.cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const key = (row) => row.cells[column].dataset.sort ??
      row.cells[column].textContent;
    const rows = [...body.rows].sort((left, right) => {
      const a = key(left), b = key(right);
      if (a === "" || b === "") return (a === "") - (b === "");  // missing ones last
      const order = isNaN(a) || isNaN(b) ? a.localeCompare(b) : a - b;
      return down ? -order : order;
    });
    body.append(...rows);
  });
}
for (const episode of document.querySelectorAll(".episode")) {
  const video = episode.querySelector("video"), lines = [];
  for (const svg of episode.querySelectorAll("svg")) {
    const box = svg.querySelector("[id$='-patch_2']").getBBox();
    const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
    line.setAttribute("y1", box.y);
    line.setAttribute("y2", box.y + box.height);
    line.setAttribute("stroke", "#E69F00");
    line.setAttribute("stroke-width", "1.5");
    line.style.display = "none";
    svg.append(line);
    lines.push([line, box]);
  }
  const follow = () => {
    for (const [line, box] of lines) {
      const x = box.x + box.width * video.currentTime / (video.duration || 1);
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
      line.style.display = "";
    }
    if (!video.paused && !video.ended) requestAnimationFrame(follow);
  };
  for (const event of ["play", "seeked"]) video.addEventListener(event, follow);
}
"""
