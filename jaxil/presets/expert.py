"""Experts in minutes: DrQ-v2's learner on the state vector, with the true reward.

    jaxil train --config=expert:cartpole_swingup --workdir=runs/expert
    jaxil collect --workdirs=runs/expert --output=cartpole_swingup.npz

It uses the simulator's observation instead of pixels, and one hidden layer instead of
convolutions: about 500 frames per second on one CPU core.
"""

from jaxil import config as jaxil_config

# Enough frames for an expert worth imitating; those of the included demonstrations.
_FRAMES = {
    "ball_in_cup_catch": 80_000,
    "cartpole_swingup": 100_000,
    "walker_walk": 500_000,
    "walker_stand": 900_000,
    "finger_spin": 900_000,
    "walker_run": 1_400_000,
    "cheetah_run": 1_500_000,
}
_MANY_FRAMES = 1_000_000
# Agent steps until exploration has decayed. A slowly spinning finger is rewarded too,
# so it has to explore for longer to spin faster.
_EXPLORATION_STEPS = {
    "ball_in_cup_catch": 50_000,
    "cartpole_swingup": 50_000,
    "walker_stand": 50_000,
    "finger_spin": 150_000,
}
_LONG_EXPLORATION_STEPS = 100_000
# 3-step returns speed up most tasks. The finger has to hit at the right time, where the
# rewards of older, noisier policies mislead.
_NUM_STEPS = {"finger_spin": 1}
# Prevents saturation of the actor, see `losses.saturation_penalty`.
_PENALTIES = {"finger_spin": 1e-2}
_PENALTY = 3e-3


def get_config(task: str = "cartpole_swingup"):
    """Returns the settings for `task`."""
    config = jaxil_config.default_config("drqv2", task)
    config.observation = "state"
    config.total_frames = _FRAMES.get(task, _MANY_FRAMES)
    config.batch_size = 128
    config.learning_rate = 3e-4
    config.hidden_dim = 256
    config.num_steps = _NUM_STEPS.get(task, 3)  # on walkers too
    config.exploration_std_steps = _EXPLORATION_STEPS.get(task, _LONG_EXPLORATION_STEPS)
    config.pre_tanh_penalty = _PENALTIES.get(task, _PENALTY)
    config.eval_every_frames = 20_000
    config.checkpoint_every_frames = 20_000
    config.video_every_evals = 0
    return config
