"""The preset that learns on two CPU cores: `--config=tiny:METHOD,TASK`.

    jaxil train --config=tiny:pdac,cartpole_swingup --workdir=runs/tiny

The paper's methods with smaller images, networks and batches, and rendering without
shadows. Other deviations from the paper:

- The mean image of the demonstrations is subtracted and the contrast raised, since a
  small moving body is only a few pixels at 48x48.
- The squared pre-tanh mean is penalised, since small actors saturate permanently.
  Beside P-SIL's small rewards this weight counts a hundred times as much: with it
  `walker_stand` learned to lie still on state vectors, and `finger_spin` nothing in 33k
  frames from pixels, so it is smaller there.
- The average of the policies of about the last 1000 updates is evaluated and kept
  (`policy_tau`), since the newest policy is worse at times. Training never uses the
  average.
- Exploration ends sooner, the agent updates every step and learning rates are higher,
  since runs have to be short, and sooner still on finger_spin: training returns at 60k
  frames on state vectors were 292 with one seed, and 175, 122 and 262 with the preset's
  usual length. In P-DAC's short runs on the cup it ends after 20k frames.
- The replay is smaller, so that its rewards are newer, and they are recomputed
  (`reward_refresh_steps`): those of the first episodes come from an untrained
  discriminator and would teach the critic that random behaviour is best.
- On the walkers and on finger_spin P-DAC's discriminator judges 32 principal components
  of each frame instead of the critic's features, which mislead it: `walker_stand` and
  `finger_spin` are learned from components and not from features. On
  `ball_in_cup_catch` it is the other way round: components lose a small ball
  (launch/results/README.md, "Learning: the ladder"). On walker_run, where only 35k
  frames were tried, components are assumed. P-SIL compares them on finger_spin and
  walker_walk; on `walker_stand` they mislead it too.
- On ball_in_cup_catch P-DAC updates four times after each step. Its three seeds reached
  80 % of the expert at 20k, 30k and 50k frames; with one update three of five did, at
  40k to 80k, in about the same time.
- On ball_in_cup_catch the other methods repeat actions 4 times, which halves the
  time per frame. P-SIL's rewards stay as they were stored there: with rewards
  recomputed one of nine runs reached 80 % of the expert within 71k to 202k frames, and
  with stored ones all of eight did within 80k to 180k.
- cartpole_swingup is seen by the camera that follows the cart. DrQ-v2's shows the pole
  one pixel wide, and not at all at the rail's ends: agents needed more frames, and then
  kept dropping the pole. Demonstrations in pixels of another renderer may need
  `--config.camera=0`.
- cartpole_swingup repeats actions 4 times: with 2, a pole at 1 rad/s moves a quarter of
  a pixel between frames, which hides its speed, and agents only learned to spin it;
  with 8, none learned to balance it. P-DAC's gradient penalty has weight 1 there.
  Batches of 32 halved the time of an update, but one of two seeds learned nothing in
  260k frames.
- Learning rates fall on cartpole_swingup, finger_spin and walker_walk: agents that have
  learned to walk keep falling over at the first rate (457 of 961 at 500k frames), and
  less at the last. P-SIL's rate falls half as fast on cartpole_swingup: with that and
  the smaller penalty one seed had 843 of 856 at 280k frames, without them 373 at 300k.
"""

from jaxil import config as jaxil_config
from jaxil import methods
from jaxil.errors import Fault, UsageError

_ACTION_REPEATS = {"cartpole_swingup": 4, "ball_in_cup_catch": 4}
_ACTION_REPEATS_OF_PDAC = _ACTION_REPEATS | {"ball_in_cup_catch": 2}
_CAMERAS = {"cartpole_swingup": "lookatcart"}
_GRADIENT_PENALTIES = {("pdac", "cartpole_swingup"): 1.0}
# Frames of a run, and agent steps over which learning rates fall.
_FALLING_RATES = {
    "cartpole_swingup": (300_000, 75_000),
    "finger_spin": (400_000, 125_000),
    "walker_walk": (700_000, 250_000),
}
_FALLING_RATES_OF_PSIL = _FALLING_RATES | {"cartpole_swingup": (300_000, 150_000)}
_WALKERS = ("walker_stand", "walker_walk", "walker_run")
_SMALL_PENALTY_OF_PSIL = (*_WALKERS, "finger_spin", "cartpole_swingup")
_JUDGED_BY_COMPONENTS = {
    "pdac": (*_WALKERS, "finger_spin"),
    "psil": ("walker_walk", "finger_spin"),
}
_SMALL = {
    "cloning": {"batch_size": 64, "num_pairs": 64},
    "inverse_model": {
        "hidden_dim": 256,
        "learning_rate": 3e-4,
        "head_dim": 256,
        "model_learning_rate": 3e-4,
    },
    "latent": {"hidden_dim": 256},
}
# These have a separate encoder, and penalties need its second derivatives: with 64, an
# update of DAC takes five times as long.
_DISCRIMINATOR_BATCHES = {"dac": 16, "sil": 16, "gaifo": 16, "patchail": 8}


def get_config(argument: str = "pdac,cartpole_swingup"):
    """Returns the preset for `METHOD,TASK`."""
    method, comma, task = argument.partition(",")
    if not comma:
        raise UsageError(
            Fault(
                "--config",
                "lacks the task",
                "write METHOD,TASK, such as tiny:pdac,cartpole_swingup",
                f"tiny:{argument}",
            )
        )
    config = jaxil_config.default_config(method, task)
    rewarder = method.removesuffix("_cloning")
    is_psil = rewarder == "psil"
    repeats = _ACTION_REPEATS_OF_PDAC if method == "pdac" else _ACTION_REPEATS
    config.action_repeat = repeats.get(task, 2)
    config.total_frames = 500_000
    config.camera = _CAMERAS.get(task, "")
    config.image_size = 48
    config.render_quality = "fast"
    config.encoder.channels = (32, 32, 32)
    config.encoder.kernel_sizes = (4, 3, 3)
    config.encoder.strides = (4, 1, 1)
    config.encoder.contrast = 4.0
    config.encoder.subtract_mean_image = True
    config.shift_padding = 2
    config.hidden_dim = 256
    config.batch_size = 64
    config.update_every_steps = 1
    config.learning_rate = 3e-4
    falling = _FALLING_RATES_OF_PSIL if is_psil else _FALLING_RATES
    if task in falling:
        config.total_frames, config.learning_rate_steps = falling[task]
        config.learning_rate_end = 5e-5
    declared = methods.get(method)
    if not declared.plays:  # as many updates as with the paper's settings
        config.total_frames = declared.total_updates * config.action_repeat
    is_small = is_psil and task in _SMALL_PENALTY_OF_PSIL
    config.pre_tanh_penalty = 2e-5 if is_small else 2e-3
    config.policy_tau = 1e-3
    config.replay_size_steps = 50_000
    config.replay_on_device = True  # also on CPUs, where XLA stacks faster than NumPy
    config.exploration_std_steps = 20_000 if task == "finger_spin" else 50_000
    discriminator = config.get("discriminator", {})
    small = {
        "batch_size": _DISCRIMINATOR_BATCHES.get(method, 64),
        "gradient_penalty": _GRADIENT_PENALTIES.get((rewarder, task), 10.0),
        "hidden_dim": 256,
        "learning_rate": 3e-4,
        "width": 8,
    }
    discriminator.update({n: v for n, v in small.items() if n in discriminator})
    sinkhorn = config.get("sinkhorn", {})
    if task in _JUDGED_BY_COMPONENTS.get(rewarder, ()):
        (sinkhorn or discriminator).num_components = 32
    if "num_iterations" in sinkhorn:
        sinkhorn.num_iterations = 50
    for section in (sinkhorn, config.get("coverage", {})):
        if "target_update_steps" in section:
            section.target_update_steps = 5_000 if config.action_repeat == 2 else 2_500
    config.reward_refresh_steps = 2_500
    config.eval_every_frames = 20_000
    if task == "ball_in_cup_catch" and is_psil:
        config.total_frames = 200_000
        config.reward_refresh_steps = 0
    elif task == "ball_in_cup_catch" and method == "pdac":  # cloning is too slow for it
        config.total_frames, config.eval_every_frames = 50_000, 10_000
        config.updates_per_step = 4
        config.exploration_std_steps = 10_000
    config.checkpoint_every_frames = 10_000
    for section, sizes in _SMALL.items():
        if section in config:
            settings = config[section]
            settings.update({n: size for n, size in sizes.items() if n in settings})
    if config.action_repeat > 2:  # fewer agent steps in as many frames
        config.exploration_steps = 500
        config.exploration_std_steps = 20_000
        config.replay_size_steps = 25_000
    return config
