"""Experts in minutes: DrQ-v2's learner on the state vector, with the true reward.

    jaxil train --config=expert:cartpole_swingup --workdir=runs/expert
    jaxil collect --workdirs=runs/expert --output=cartpole_swingup.npz

It uses the simulator's observation instead of pixels, and one hidden layer instead of
convolutions: about 500 frames per second on one CPU core.
"""

from jaxil import config as jaxil_config

_ALL = {
    "observation": "state",
    "total_frames": 1_000_000,
    "batch_size": 128,
    "learning_rate": 3e-4,
    "hidden_dim": 256,
    "num_steps": 3,  # on walkers too; it speeds up most tasks
    "exploration_std_steps": 100_000,
    "pre_tanh_penalty": 3e-3,  # against a saturated actor
    "eval_every_frames": 20_000,
    "checkpoint_every_frames": 20_000,
    "video_every_evals": 0,
}
# Enough frames for an expert worth imitating; those of the included demonstrations.
_TASKS = {
    "ball_in_cup_catch": {"total_frames": 80_000, "exploration_std_steps": 50_000},
    "cartpole_swingup": {"total_frames": 100_000, "exploration_std_steps": 50_000},
    "walker_walk": {"total_frames": 500_000},
    "walker_stand": {"total_frames": 900_000, "exploration_std_steps": 50_000},
    "finger_spin": {
        "total_frames": 900_000,
        # Spinning slowly is rewarded too, so it explores for longer to spin faster.
        "exploration_std_steps": 150_000,
        # It has to hit at the right time, and rewards of older, noisier policies, which
        # are part of longer returns, mislead.
        "num_steps": 1,
        "pre_tanh_penalty": 1e-2,
    },
    "walker_run": {"total_frames": 1_400_000},
    "cheetah_run": {"total_frames": 1_500_000},
}


def get_config(task: str = "cartpole_swingup"):
    """Returns the settings for `task`."""
    config = jaxil_config.default_config("drqv2", task)
    config.update(_ALL | _TASKS.get(task, {}))
    return config
