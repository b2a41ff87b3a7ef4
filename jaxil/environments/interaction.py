"""The agent and its environment, one decision at a time, or one of each of several."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

Act = Callable[[np.ndarray], np.ndarray]  # observation -> action [A]
ActTogether = Callable[[np.ndarray], np.ndarray]  # observations [E, ...] -> [E, A]


class Decision(NamedTuple):
    """One agent step.

    Attributes:
      frame: what came of it, not stacked. uint8 [H, W, 3] or float32 [S].
      first_frame: on an episode's first decision, the frame at its reset; else None.
      action: shape [A].
      task_reward: summed over the action repeat.
      discount: product over the action repeat; 1 at a time limit.
      is_last: whether the episode ended with it.
      episode: number of the episode, from 0.
    """

    frame: np.ndarray
    first_frame: np.ndarray | None
    action: np.ndarray
    task_reward: float
    discount: float
    is_last: bool
    episode: int


def interact(
    environment: Any,
    act: Act,
    *,
    first_episode: int,
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[Decision]:
    """Yields decisions without end, episode after episode.

    Episode i starts from the state that `environment.reset(episode=i)` gives, so a
    resumed run meets the same starts as an unbroken one.

    Args:
      environment: a `PixelEnvironment`, or anything with its `reset(episode)`,
        `step(action)` and `single_observation()`.
      act: the policy.
      first_episode: number of the first episode.
      meanwhile: called between a decision's action and its step: what it starts on a
        device goes on while the simulator steps and draws.
    """
    episode = first_episode
    while True:
        timestep = environment.reset(episode=episode)
        first_frame = environment.single_observation()
        while not timestep.last():
            action = np.asarray(act(timestep.observation), np.float32)
            meanwhile()
            timestep = environment.step(action)
            yield Decision(
                frame=environment.single_observation(),
                first_frame=first_frame,
                action=action,
                task_reward=float(timestep.reward),
                discount=float(timestep.discount),
                is_last=timestep.last(),
                episode=episode,
            )
            first_frame = None
        episode += 1


class Moment(NamedTuple):
    """What an environment shows after a reset or a step; arrays are the reader's.

    Attributes:
      observation: what the policy sees. uint8 [H, W, C] or float32 [S].
      frame: the present alone, as a replay stores it. uint8 [H, W, 3] or float32 [S].
      task_reward: summed over the action repeat; 0 at a reset.
      discount: product over the action repeat; 1 at a reset.
      is_last: whether the episode is over.
    """

    observation: np.ndarray
    frame: np.ndarray
    task_reward: float
    discount: float
    is_last: bool


class Environments(Protocol):
    """Several environments that work while one waits; see `pool.Pool`."""

    size: int

    def reset(self, place: int, episode: int) -> None:
        """Sends an environment to the start of an episode."""
        ...

    def step(self, place: int, action: np.ndarray) -> None:
        """Sends it an action."""
        ...

    def receive(self, place: int) -> Moment | None:
        """Waits for the outcome; None if it was lost, and the episode with it."""
        ...


@dataclasses.dataclass
class _Seat:
    """Where an episode is played: what it shows, and at its start the first frame."""

    episode: int
    moment: Moment | None = None
    first_frame: np.ndarray | None = None


def interact_together(
    environments: Environments,
    act: ActTogether,
    *,
    first_episode: int,
    begin: Callable[[int], bool],
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[list[Decision]]:
    """Yields rounds without end: one decision of each environment that plays.

    Each episode is one that `interact` could have played. A free environment is given
    the lowest number that is left; an episode that was lost is played again from its
    start. Rounds are sorted by the episodes' numbers, and empty if nothing plays.

    Args:
      environments: at least one.
      act: the policy; its rows are sorted as the round is.
      first_episode: number of the first episode.
      begin: asked before each episode, whether it is to be played.
      meanwhile: called once for each decision, between the sending of the actions and
        the waiting for what comes of them.
    """
    next_episode, lost = first_episode, []
    seats: dict[int, _Seat] = {}  # by place

    def receive(place: int) -> Moment | None:
        moment = environments.receive(place)
        if moment is None:
            lost.append(seats.pop(place).episode)
        return moment

    while True:
        free = [place for place in range(environments.size) if place not in seats]
        for place in free:
            episode = min(lost, default=next_episode)
            if not begin(episode):
                break
            if lost:
                lost.remove(episode)
            else:
                next_episode += 1
            environments.reset(place, episode)
            seats[place] = _Seat(episode)
        for place in [place for place in free if place in seats]:
            if (moment := receive(place)) is not None:
                seats[place].moment, seats[place].first_frame = moment, moment.frame

        places = sorted(seats, key=lambda place: seats[place].episode)
        moments = [seats[place].moment for place in places]
        actions = np.zeros((0, 0), np.float32)
        if places:
            seen = np.stack([moment.observation for moment in moments if moment])
            actions = np.asarray(act(seen), np.float32)
        for place, action in zip(places, actions, strict=True):
            environments.step(place, action)
        for _ in places:
            meanwhile()
        decisions = []
        for place, action in zip(places, actions, strict=True):
            seat = seats[place]
            if (moment := receive(place)) is None:
                continue
            decisions.append(
                Decision(
                    frame=moment.frame,
                    first_frame=seat.first_frame,
                    action=action,
                    task_reward=moment.task_reward,
                    discount=moment.discount,
                    is_last=moment.is_last,
                    episode=seat.episode,
                )
            )
            seat.moment, seat.first_frame = moment, None
            if moment.is_last:
                del seats[place]
        yield decisions


class FinishedEpisode(NamedTuple):
    """One whole episode, as the replay takes it.

    Attributes:
      frames: uint8 [T + 1, H, W, 3], or float32 [T + 1, S].
      actions: float32 [T, A].
      task_rewards: float32 [T].
      discounts: float32 [T].
    """

    frames: np.ndarray
    actions: np.ndarray
    task_rewards: np.ndarray
    discounts: np.ndarray


def join(decisions: list[Decision]) -> FinishedEpisode:
    """Returns the episode that `decisions` make up.

    Args:
      decisions: all of one episode, in order.

    Raises:
      ValueError: they do not start at a reset, or do not reach the end.
    """
    first, last = decisions[0], decisions[-1]
    if first.first_frame is None or not last.is_last:
        raise ValueError(
            f"episode {first.episode} is not whole: an episode runs from its reset to "
            "its last decision"
        )
    return FinishedEpisode(
        frames=np.stack([first.first_frame, *(d.frame for d in decisions)]),
        actions=np.stack([d.action for d in decisions]),
        task_rewards=np.asarray([d.task_reward for d in decisions], np.float32),
        discounts=np.asarray([d.discount for d in decisions], np.float32),
    )
