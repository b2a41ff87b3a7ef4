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
for (const box of document.querySelectorAll(".scroll")) {
  box.closest("details").addEventListener("toggle", () =>
    box.classList.toggle("wide", box.scrollWidth > box.clientWidth));
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
