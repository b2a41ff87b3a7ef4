"""Writes folders of runs by hand, with numbers that can be worked out on paper."""

import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxil import config as jaxil_config
from jaxil.files import video
from jaxil.reporting import groups, runs

EVAL_HEADER = (
    "frame,seconds,episode,task_return_mean,task_return_std,expert_task_return_mean,"
    "wasserstein_to_expert"
)
_TRAIN_HEADER = (
    "frame,seconds,episode,task_return,imitation_return,length,frames_per_second,"
    "discriminator/expert_logit,discriminator/agent_logit,discriminator/loss"
)


def write_run(
    folder: pathlib.Path,
    method: str,
    task: str,
    seed: int,
    returns: Mapping[int, float] | None,
    *,
    expert: float | str = 1000.0,
    total_frames: int = 3000,
    changes: Mapping[str, Any] | None = None,
    logits: bool = False,
) -> pathlib.Path:
    """Writes config.json, eval.csv and train.csv.

    Args:
      folder: a new one.
      method, task, seed: of the run.
      returns: of each evaluation, by its frame; a frame takes 3.6 seconds, so that
        1000 frames take an hour. None for a run that has not begun.
      expert: mean return of its demonstrations; "" without any.
      total_frames: of the config.
      changes: further settings by their dotted names.
      logits: whether train.csv has those of a discriminator.
    """
    folder.mkdir(parents=True)
    config = jaxil_config.default_config(method, task)
    config.update_from_flattened_dict(
        {**(changes or {}), "seed": seed, "total_frames": total_frames}
    )
    stored = {"config": config.to_dict(), "versions": {}, "device": "cpu: cpu"}
    (folder / "config.json").write_text(json.dumps(stored))
    if returns is None:
        return folder
    rows = [
        f"{frame},{3.6 * frame},{frame // 1000},{value},1.0,{expert},"
        f"{1.0 - 0.0001 * frame}"
        for frame, value in returns.items()
    ]
    (folder / "eval.csv").write_text("\n".join([EVAL_HEADER, *rows]) + "\n")
    if logits:
        rows = [
            f"{frame},{3.6 * frame},{frame // 500},1.0,2.0,250,0.3,{frame / 1000},"
            f"{-frame / 1000},0.5"
            for frame in range(500, max(returns) + 1, 500)
        ]
        (folder / "train.csv").write_text("\n".join([_TRAIN_HEADER, *rows]) + "\n")
    return folder


def change_config(folder: pathlib.Path, changes: Mapping[str, Any]) -> None:
    """Replaces settings in a run's config.json, as another jaxil may have done."""
    path = folder / "config.json"
    stored = json.loads(path.read_text())
    stored["config"] |= changes
    path.write_text(json.dumps(stored))


def groups_below(root: pathlib.Path) -> list[groups.Group]:
    """Returns the groups of all runs below a folder."""
    return groups.make_groups(map(runs.read, runs.find([root])))


def film(folder: pathlib.Path, frame: int, *, plan: bool) -> None:
    """Adds a real video of 30 pictures with the rewards of its episode."""
    videos = folder / "videos"
    videos.mkdir(exist_ok=True)
    ramp = np.linspace(0, 255, 30).astype(np.uint8)
    frames = np.broadcast_to(ramp[:, None, None, None], (30, 32, 32, 3))
    path = videos / f"frame_{frame:09d}.mp4"
    video.write_video(path, frames, frames[::-1], fps=15)
    arrays: dict[str, Any] = {
        "imitation_rewards": -np.linspace(0.5, 0.1, 29, dtype=np.float32),
        "task_rewards": np.linspace(0, 1, 29, dtype=np.float32),
    }
    if plan:
        # Two columns of padding, as older runs wrote them.
        arrays["plan"] = np.eye(30, 28, dtype=np.float32) / 30
        arrays["step_seconds"] = np.asarray(0.1)
        arrays["agent_strip"] = arrays["expert_strip"] = frames[::3]
    np.savez_compressed(path.with_suffix(".npz"), **arrays)


def many_runs(root: pathlib.Path) -> pathlib.Path:
    """Writes two tasks, three variants, several seeds, and what can go wrong."""

    def write(name: str, method: str, seed: int, returns: Any, **options: Any):
        task = name.split("/")[0]
        return write_run(root / name, method, task, seed, returns, **options)

    cartpole, walker = "cartpole_swingup", "walker_walk"
    for seed, last in enumerate(((500, 800), (700, 900), (900, 1000))):
        returns = {1000: 100 * (seed + 1), 2000: last[0], 3000: last[1]}
        write(f"{cartpole}/pdac/seed{seed}", "pdac", seed, returns, logits=True)
    film(root / cartpole / "pdac" / "seed0", 2000, plan=False)
    write(f"{cartpole}/psil/seed0", "psil", 0, {1000: 100, 3000: 300})
    folder = write(f"{cartpole}/psil/seed1", "psil", 1, {2000: 400, 3000: 600})
    film(folder, 3000, plan=True)
    unfinished, changes = {1000: 50, 2000: 150}, {"shift_padding": 0}  # of 3000
    name = f"{cartpole}/pdac_no_augmentation/seed0"
    write(name, "pdac", 0, unfinished, changes=changes)
    for name, last in (("first", 400), ("again", 600)):  # the same seed twice
        write(f"{walker}/{name}", "pdac", 0, {1000: 100, 3000: last}, expert=500.0)
    changes = {"action_repeat": 4, "batch_size": 64}
    write(f"{walker}/repeat4", "pdac", 0, {3000: 450}, expert=900.0, changes=changes)
    write(f"{walker}/drqv2", "drqv2", 0, {3000: 800}, expert="")
    write(f"{walker}/not_begun", "psil", 0, None)
    header_only = write(f"{walker}/header_only", "psil", 1, {})
    (header_only / "train.csv").write_text("")
    cut_off = write(f"{walker}/cut_off", "psil", 2, {1000: float("nan"), 2000: 300})
    with (cut_off / "eval.csv").open("a") as file:
        file.write("3000,10800,3,9")  # killed in mid-line
    (cut_off / "videos").mkdir()
    (cut_off / "videos" / "frame_000002000.mp4").write_bytes(b"not a video")
    damaged = root / walker / "damaged"
    damaged.mkdir()
    (damaged / "config.json").write_text('{"config": {"method": "pdac"')
    return root
