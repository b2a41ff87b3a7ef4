"""What a run writes down: two tables, TensorBoard events and the learning curve."""

import csv
import io
import math
import os
import pathlib
import uuid
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

TRAIN_COLUMNS = (
    "frame",  # environment frames when the episode ended
    "seconds",  # of the run, earlier processes included
    "episode",
    "task_return",  # undiscounted sum of the true rewards, which the agent never sees
    "imitation_return",  # the same of the rewards that it learns from
    "length",  # agent steps
    "frames_per_second",
)
EVAL_COLUMNS = (
    "frame",
    "seconds",
    "episode",  # training episodes so far
    "task_return_mean",
    "task_return_std",
    "expert_task_return_mean",
    "wasserstein_to_expert",  # relative to a random policy's
)


class CsvLog:
    """A table of numbers that survives a kill: each row is written out at once."""

    def __init__(
        self,
        path: str | os.PathLike,
        columns: Iterable[str],
        *,
        resume_frame: int | None = None,
    ):
        """Opens the table; on resume, keeps the rows that the run will not write again.

        Args:
          path: the file. It is begun anew unless `resume_frame` is given.
          columns: names in their order; "frame" is one of them.
          resume_frame: the frame that the run goes on from. Rows of later frames are
            dropped, and so is a last line that was cut off; columns that the file has
            and `columns` lacks are dropped, new ones are empty in old rows.

        Raises:
          ValueError: if "frame" is not among the columns.
          OSError: if the file cannot be written.
        """
        self._path = pathlib.Path(path)
        self._columns = tuple(columns)
        if "frame" not in self._columns:
            raise ValueError(f'columns = {self._columns}: expected "frame" among them')
        kept = []
        if resume_frame is not None and self._path.exists():
            kept = [
                row
                for row in _read_rows(self._path)
                if int(row["frame"]) <= resume_frame
            ]
        text = self._format(dict(zip(self._columns, self._columns, strict=True)))
        text += "".join(self._format(row) for row in kept)
        write_atomically(self._path, text.encode())
        self._file = self._path.open("a", newline="")

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds one row.

        Args:
          row: scalars by column; a column that is missing stays empty.

        Raises:
          ValueError: if the table has no such column.
        """
        unknown = sorted(set(row) - set(self._columns))
        if unknown:
            raise ValueError(
                f"{self._path.name} has no column {', '.join(unknown)}: expected"
                f" {', '.join(self._columns)}"
            )
        self._file.write(self._format(row))
        self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _format(self, row: Mapping[str, Any]) -> str:
        line = io.StringIO()
        cells = [_cell(row.get(column, "")) for column in self._columns]
        csv.writer(line, lineterminator="\n").writerow(cells)
        return line.getvalue()


class Metrics:
    """Owns DIR/train.csv, DIR/eval.csv and the events in DIR/tensorboard."""

    def __init__(
        self,
        workdir: str | os.PathLike,
        *,
        resume_frame: int | None = None,
        extra_train_columns: Iterable[str] = (),
        extra_eval_columns: Iterable[str] = (),
        tensorboard: bool = True,
    ):
        """Opens all three.

        Args:
          workdir: folder of the run, which exists.
          resume_frame: the frame that the run goes on from (see `CsvLog`).
          extra_train_columns: further columns of train.csv.
          extra_eval_columns: further columns of eval.csv.
          tensorboard: whether to write events.
        """
        workdir = pathlib.Path(workdir)
        self._train = CsvLog(
            workdir / "train.csv",
            (*TRAIN_COLUMNS, *extra_train_columns),
            resume_frame=resume_frame,
        )
        self._evaluation = CsvLog(
            workdir / "eval.csv",
            (*EVAL_COLUMNS, *extra_eval_columns),
            resume_frame=resume_frame,
        )
        self._events = None
        if tensorboard:
            import tensorboardX  # slow to import

            purge = None if resume_frame is None else resume_frame + 1
            self._events = tensorboardX.SummaryWriter(
                str(workdir / "tensorboard"), purge_step=purge, flush_secs=30
            )

    def train(self, row: Mapping[str, Any]) -> None:
        """Writes one training episode."""
        self._train.append(row)
        self._write_events("train", row)

    def evaluation(self, row: Mapping[str, Any]) -> None:
        """Writes one evaluation."""
        self._evaluation.append(row)
        self._write_events("eval", row)

    def scalars(self, frame: int, values: Mapping[str, Any]) -> None:
        """Writes further numbers, to TensorBoard only.

        Args:
          frame: environment frames so far.
          values: scalars by name, e.g. "losses/critic".
        """
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(name, float(value), global_step=int(frame))

    def close(self) -> None:
        """Closes the tables and writes out the last events."""
        self._train.close()
        self._evaluation.close()
        if self._events is not None:
            self._events.close()

    def _write_events(self, group: str, row: Mapping[str, Any]) -> None:
        values = {f"{group}/{k}": v for k, v in row.items() if k != "frame" and v != ""}
        self.scalars(row["frame"], values)


def read_csv(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Reads a table of numbers; a last line that was cut off is left out.

    Returns:
      A float64 array for each column; empty cells are NaN.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it has no header, or holds something that is not a number.
    """
    rows = _read_rows(path)
    columns = _header(path)
    try:
        return {
            column: np.array(
                [float(row[column]) if row[column] else math.nan for row in rows],
                np.float64,
            )
            for column in columns
        }
    except ValueError as error:
        raise ValueError(f"{path}: expected numbers only, {error}") from error


def write_learning_curve(
    path: str | os.PathLike,
    eval_csv: str | os.PathLike,
    *,
    title: str,
    expert_return: float | None = None,
) -> None:
    """Draws the task return over environment frames, as a PNG.

    Args:
      path: the picture, replaced as a whole.
      eval_csv: table with frame, task_return_mean and task_return_std.
      title: what ran, e.g. the method and the task.
      expert_return: mean task return of the demonstrations, drawn as a dashed line.

    Raises:
      OSError: if the table cannot be read or the picture not written.
    """
    # Not pyplot: a Figure of one's own needs no display and leaves no global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    table = read_csv(eval_csv)
    frames, mean = table["frame"], table["task_return_mean"]
    spread = np.nan_to_num(table["task_return_std"])
    figure = Figure(figsize=(6.4, 3.8), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    colour = "#1f6f8b"
    if expert_return is not None:
        label = f"expert, {expert_return:.0f}"
        axes.axhline(expert_return, color="#444444", ls="--", lw=1.2, label=label)
    if len(frames):
        axes.fill_between(
            frames, mean - spread, mean + spread, color=colour, alpha=0.18, lw=0
        )
        # Dots while there are few, so that a single evaluation is seen too.
        dots = "o" if len(frames) <= 40 else None
        label = f"agent, {mean[-1]:.0f} at the end (band: std over episodes)"
        axes.plot(frames, mean, color=colour, lw=1.8, marker=dots, ms=3.5, label=label)
    else:
        axes.text(0.5, 0.5, "no evaluation yet", ha="center", transform=axes.transAxes)
    top = np.max([1.0, *(mean + spread), expert_return or 0.0], initial=1.0)
    axes.set_ylim(min(-0.01 * top, float(np.min(mean, initial=0.0))), 1.05 * top)
    axes.set_xlim(0, 1.02 * float(np.max(frames, initial=1000.0)))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("environment frames")
    axes.set_ylabel("task return")
    axes.set_title(title, loc="left", fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.25, lw=0.6)
    if axes.get_legend_handles_labels()[0]:
        # Below the axes, where no curve can run through it.
        figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    write_atomically(path, picture.getvalue())


def write_atomically(path: str | os.PathLike, content: bytes) -> None:
    """Replaces a file as a whole: at any kill, the old or the new content is there."""
    path = pathlib.Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _cell(value: Any) -> str:
    """Writes a scalar with the fewest digits that give it back exactly in its dtype."""
    return value if isinstance(value, str) else str(np.asarray(value)[()])


def _complete_lines(path: str | os.PathLike) -> list[str]:
    # A row counts once its line has an end: a kill in mid-write leaves none.
    text = pathlib.Path(path).read_text()
    return text[: text.rfind("\n") + 1].splitlines()


def _header(path: str | os.PathLike) -> list[str]:
    lines = _complete_lines(path)
    columns = next(csv.reader(lines[:1]), [])
    if "frame" not in columns:
        raise ValueError(f'{path}: expected a header line with "frame" in it')
    return columns


def _read_rows(path: str | os.PathLike) -> list[dict[str, str]]:
    columns = _header(path)
    cells = csv.reader(_complete_lines(path)[1:])
    return [dict(zip(columns, row, strict=True)) for row in cells if row]
