"""Runs of dummies: parts that write on a tape what they are asked to do."""

import types
from typing import Any

import numpy as np

from jaxil import config as jaxil_config
from jaxil import train
from jaxil.environments.evaluation import Evaluation
from jaxil.environments.player import Player
from jaxil.training.evaluator import Result
from jaxil.training.parts import Counters
from jaxil.training.stopwatch import Stopwatch
from tests.environments.counting import Counting, InTurn

_EPISODE_STEPS = 3
_part: Any = types.SimpleNamespace  # stands in for a part of any class


class Dummies:
    """The parts of a run, which write down on one tape what they are asked to do."""

    def __init__(self, *, lost=(), first_episode=0, reward=0.0, **changes):
        self.tape: list[str] = []
        self.config = make_config(**changes)
        self.environments = InTurn(
            [Counting(_EPISODE_STEPS) for _ in range(self.config.num_environments)],
            self.tape,
            lost,
        )
        self.run: Any = None  # set at the end; the parts ask it how far it has come
        self.num_stored = 0
        self.reward_value = reward
        self.act = lambda: None  # happens at each agent step
        counters = Counters(num_episodes=first_episode)
        state = _part(
            params=(None, None, None),
            newest_policy=(None, None),
            rewarder=None,
            num_updates=np.int32(12),
        )
        state.replace = lambda rewarder: state
        self.rewarder = _part(summary=lambda _: {}, rewards_changed=None)
        self.run = train.Run(
            config=self.config,
            agent=_part(
                sample_action=self._sample_action,
                observe=lambda rewarder, *_: rewarder,
                rewards=self._rewards,
                rewarder=self.rewarder,
                mean_image=None,
            ),
            state=state,
            counters=counters,
            player=Player(self.environments, first_episode=first_episode),
            episode_steps=_EPISODE_STEPS,
            replay=_part(
                can_sample=lambda: self.num_stored > 0,
                add_episode=self._store,
                mean_reward=lambda: 0.0,
            ),
            updates=_part(
                is_pending=False,
                collect=self._collect,
                run=lambda state: (state, None),
                episode_added=lambda: None,
                refresh_rewards=lambda *_: self.tape.append("refresh"),
            ),
            experts=None,
            evaluator=_part(
                environment=_part(
                    action_spec=lambda: _part(shape=(1,)), close=lambda: None
                ),
                evaluate=self._evaluate,
            ),
            checkpoints=_part(
                save=lambda **_: self.tape.append("save"), newest=lambda: 4000
            ),
            log=_part(
                episode=lambda when, row: self.rows.append(when._asdict() | row),
                evaluation=lambda *_, **__: "a line",
                close=lambda: None,
            ),
            progress=_part(
                update=lambda *_: None, message=lambda _: None, close=lambda: None
            ),
            stopwatch=Stopwatch(),
        )
        self.rows: list[dict] = []

    def _sample_action(self, encoder, actor, observations, key, steps):
        del encoder, actor, key
        assert len(observations) == len(steps) == self.config.num_environments
        assert steps[0] == self.run.counters.num_steps
        seen = (f"{number:.0f}" for number in observations[:, 0])
        self.tape.append(f"act {' '.join(seen)}")
        self.act()
        return np.zeros((len(observations), 1), np.float32)

    def _collect(self, rng):
        del rng
        self.tape.append("update")
        return True

    def _rewards(self, rewarder, params, episode, experts):
        del rewarder, params, experts
        return np.full(len(episode.actions), self.reward_value, np.float32)

    def _store(self, frames, actions, rewards, discounts):
        assert len(frames) == len(actions) + 1 == len(rewards) + 1 == len(discounts) + 1
        self.num_stored += 1
        self.tape.append(f"store {frames[:, 0].astype(int).tolist()}")

    def _evaluate(self, state, *, number, is_last, stop_asked):
        del state
        assert number == self.run.counters.num_evals
        if stop_asked():
            self.tape.append("evaluation stopped")
            return None
        self.tape.append("last evaluation" if is_last else "evaluate")
        return Result(
            Evaluation([], np.zeros(0), []), distance=None, sides=[], filmed={}
        )

    def loop(self, **kwargs):
        self.run.loop(**kwargs)
        return self


def make_config(**changes):
    config = jaxil_config.default_config("pdac", "walker_walk")
    settings = {
        "action_repeat": 2,
        "seed_frames": 6,
        "exploration_steps": 0,
        "update_every_steps": 2,
        "total_frames": 18,
        "eval_every_frames": 12,
        "checkpoint_every_frames": 6,
        "reward_refresh_steps": 0,
    }
    config.update(settings | changes)
    return config


def acts_and_episodes(tape):
    return [word for word in tape if word[:3] in ("act", "sto")]
