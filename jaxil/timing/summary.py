"""Tables of results: one measurement, a comparison, or a sweep."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from jaxil.errors import UsageError, printable
from jaxil.files.settings import as_stored, flat
from jaxil.files.untrusted import read_regular

# The meaning of each row, by section.
ROWS: dict[str, dict[str, str]] = {
    "time of each part (median, lowest, highest)": {
        "physics_ms": "one agent step, without rendering",
        "render_ms": "rendering one frame",
        "act_ms": "one exploring action",
        "sample_ms": "sampling one batch, the experts' included",
        "update_ms": "one update of the learner, its batch on the device",
        "reward_ms": "the rewards of one episode at its end",
    },
    "before the first step": {
        "compile_seconds": "the first update of this process, caches as they were",
        "compile_cold_seconds": "tracing and compiling the update, nothing cached",
        "start_seconds": "from `jaxil train` to the first step, caches warm",
    },
    "the loop": {
        "frames_per_second": "acting and learning, nothing else",
        "frames_per_second_in_turn": "the same, but environments wait for updates",
        "loop_overhead_percent": "what it adds to environment, acting and updating",
        "reward_percent": "share of rewards in the time of loop and rewards",
        "run_hours": "the whole run at that speed, without evaluations",
    },
    "memory": {
        "learner_state_mb": "networks, optimisers, target critic and rewarder",
        "batch_mb": "of one update, the experts' included",
        "update_temp_mb": "temporaries of the update",
        "replay_gb": "its frames when full",
        "peak_memory_gb": "of this process",
        "peak_device_memory_gb": "of the accelerator",
    },
    "arithmetic of one update": {
        "update_gflop": "by XLA's count, with XLA's own convolutions",
        "matrix_product_gflops": "per second: the device's best float32 product",
        "utilisation_percent": "the update's rate in percent of that",
    },
}
_SWEEP_COLUMNS = (
    *("update_ms", "reward_ms", "sample_ms", "frames_per_second"),
    *("update_gflop", "utilisation_percent", "batch_mb", "update_temp_mb"),
)
# Present in results files of all versions.
_ALWAYS = {"update_ms": int | float, "device": str, "config": dict}
_CIRCUMSTANCES = ("device", "num_devices", "processor", "usable_cores", "machine")


def results_table(results: Mapping[str, Any]) -> str:
    """Returns a table of all rows that have a value."""
    lines = [machine_line(results)]
    for section, rows in ROWS.items():
        lines += ["", section]
        for name, meaning in rows.items():
            if results[name] is not None:
                numbers = results[name], *results["ranges"].get(name, (None, None))
                lines.append(f"  {name:<26}{_cells(*numbers)}  {meaning}")
    return "\n".join(lines)


def machine_line(results: Mapping[str, Any]) -> str:
    """Describes the machine in one line."""
    return (
        f"{results['num_devices']} x {results['device']}; {results['processor']}, "
        f"{results['usable_cores']} of {results['cores']} cores usable; "
        f"{results['repeats']} repeats"
    )


def sweep_table(all_results: Sequence[Mapping[str, Any]]) -> str:
    """Returns a table with a line for each value of the swept field."""
    field = all_results[0]["sweep"]["field"]
    lines = ["".join(f"{name:>{len(name) + 2}}" for name in (field, *_SWEEP_COLUMNS))]
    for results in all_results:
        line = f"{results['sweep']['value']:>{len(field) + 2}}"
        for name in _SWEEP_COLUMNS:
            line += f"{_number(results[name]):>{len(name) + 2}}"
        lines.append(line)
    return "\n".join(lines)


def read(path: str) -> dict[str, Any]:
    """Reads results that `--json` wrote; UsageError if the file has none."""
    try:
        results = json.loads(read_regular(path))
        if not all(isinstance(results[name], kind) for name, kind in _ALWAYS.items()):
            raise ValueError("its values are of other types")
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise UsageError(
            f"--compare={path} is not a file that `jaxil benchmark --json=FILE` wrote "
            f"without --sweep ({error}); name one that is"
        ) from error
    return results


def comparison_table(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Returns a table of old, new and their ratio for each row that both have."""
    lines = [f"{'':<28}{'old':>10}{'new':>10}{'new/old':>10}"]
    for name in (name for rows in ROWS.values() for name in rows):
        before, now = old.get(name), new.get(name)
        if type(before) in (int, float) and type(now) in (int, float):
            ratio = now / before if before else None
            lines.append(f"{name:<28}{_cells(before, now, ratio)}")
    return "\n".join(lines)


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Returns the differences in device, machine and config fields."""
    before, now = (
        {name: each.get(name) for name in _CIRCUMSTANCES if name in old}
        | flat(as_stored({"config": each["config"]}))
        for each in (old, new)
    )
    found = []
    for name in dict.fromkeys([*before, *now]):
        then, here = (repr(e[name]) if name in e else "absent" for e in (before, now))
        if then != here:
            found.append(printable(f"{name}: {then} then, {here} now"))
    return found


def _cells(*numbers: float | None) -> str:
    return "".join(f"{_number(each):>10}" for each in numbers)


def _number(value: float | None) -> str:
    """Formats a number with about four digits; "" for None."""
    if value is None:
        return ""
    if abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.2f}" if abs(value) >= 0.1 or value == 0 else f"{value:.4f}"
