"""Results as tables for people."""

from collections.abc import Mapping, Sequence
from typing import Any

# Section, then name in the results and what it means.
ROWS: dict[str, dict[str, str]] = {
    "time of each part (median, lowest, highest)": {
        "physics_ms": "one agent step, without drawing",
        "render_ms": "drawing one frame",
        "act_ms": "one exploring action",
        "insert_ms": "one episode into the replay",
        "sample_ms": "drawing one batch, the experts' included",
        "transfer_ms": "one batch from host to device",
        "update_ms": "one update of the learner, its batch on the device",
        "update_encoder_ms": "of it, timed alone: encoder, forward and backward",
        "update_critic_ms": "of it, timed alone: critic, forward and backward",
        "update_actor_ms": "of it, timed alone: actor, forward and backward",
        "update_rewarder_ms": "of it, timed alone: the imitation method's own step",
        "update_optimiser_ms": "of it, timed alone: Adam and the target critic",
        "reward_ms": "rewarding one episode at its end",
        "evaluation_ms": "playing one episode of an evaluation",
        "checkpoint_ms": "saving the learner and one episode",
    },
    "before the first step": {
        "compile_seconds": "the first update of this process, cache as it was",
        "compile_cold_seconds": "tracing and compiling the update, nothing cached",
        "compile_warm_seconds": "the same, the program read from a cache",
        "start_seconds": "from `jaxil.launch` to the first step, caches warm",
    },
    "the loop": {
        "frames_per_second": "acting and learning, nothing else",
        "frames_per_second_in_turn": "the same, but nothing is done during updates",
        "loop_overhead_percent": "what it adds to environment, acting and updating",
        "run_frames_per_second": "with rewards, evaluations, checkpoints: added up",
        "reward_percent": "share of rewarding in the run's time",
        "evaluation_percent": "share of evaluations in the run's time",
        "run_hours": "the whole run, at that speed",
    },
    "memory": {
        "parameters_mb": "encoder, actor and critic",
        "learner_state_mb": "with optimisers, target critic and rewarder",
        "batch_mb": "of one update, the experts' included",
        "experts_mb": "whole demonstrations on the device",
        "replay_gb": "when full",
        "update_argument_mb": "what the update's program takes in",
        "update_output_mb": "what it gives out",
        "update_alias_mb": "of that, in the memory of what came in",
        "update_temp_mb": "what it needs in between",
        "peak_memory_gb": "of this process",
        "peak_device_memory_gb": "of the accelerator",
    },
    "arithmetic of one update": {
        "update_gflop": "by XLA's count, with its own convolutions",
        "update_gflop_by_hand": "matrix products and convolutions, counted by hand",
        "encoder_share_percent": "the encoder's share of those",
        "matrix_product_gflops": "a second: this device's best float32 product",
        "utilisation_percent": "the update's rate of that; Winograd's form saves some",
    },
}
_SWEEP_COLUMNS = (
    "update_ms",
    "reward_ms",
    "sample_ms",
    "frames_per_second",
    "update_gflop",
    "utilisation_percent",
    "batch_mb",
    "update_temp_mb",
)


def results_table(results: Mapping[str, Any]) -> str:
    """Returns all sections; what does not apply or was not measured is left out."""
    ranges = results["ranges"]
    lines = [machine_line(results)]
    for section, rows in ROWS.items():
        lines += ["", section]
        for name, meaning in rows.items():
            value = results.get(name)
            if value is None:
                continue
            low, high = ranges.get(name, (None, None))
            cells = "".join(f"{number(each):>10}" for each in (value, low, high))
            lines.append(f"  {name:<24}{cells}  {meaning}")
    lines += [
        "",
        "Parts of the update are compiled and timed alone: they need not sum up to it.",
    ]
    if results["update_gflop_by_hand"] is None:
        lines.append("Utilisation is by XLA's count: none by hand for this method.")
    return "\n".join(lines)


def machine_line(results: Mapping[str, Any]) -> str:
    """Names what the numbers were measured on, in one line."""
    return (
        f"{results['num_devices']} x {results['device']}; {results['processor']}, "
        f"{results['usable_cores']} of {results['cores']} cores usable, "
        f"{results['threads']} threads; {results['repeats']} repeats"
    )


def comparison_table(pairs: Mapping[str, tuple[float, float]]) -> str:
    """Returns old, new and new / old of each name."""
    lines = [f"{'':<26}{'old':>10}{'new':>10}{'new/old':>10}"]
    for name, (old, new) in pairs.items():
        ratio = new / old if old else None
        cells = "".join(f"{number(each):>10}" for each in (old, new, ratio))
        lines.append(f"{name:<26}{cells}")
    return "\n".join(lines)


def sweep_table(field: str, all_results: Sequence[Mapping[str, Any]]) -> str:
    """Returns a row for each value of a swept field."""
    widths = {name: max(len(name) + 2, 10) for name in (field, *_SWEEP_COLUMNS)}
    lines = ["".join(f"{name:>{width}}" for name, width in widths.items())]
    for results in all_results:
        cells = [f"{results['sweep']['value']:>{widths[field]}}"]
        cells += [f"{number(results[name]):>{widths[name]}}" for name in _SWEEP_COLUMNS]
        lines.append("".join(cells))
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Writes a number with about four digits; nothing for None."""
    if value is None:
        return ""
    if abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.2f}" if abs(value) >= 0.1 or value == 0 else f"{value:.4f}"
