"""Stored episodes, drawn by several processes at once where that pays.

A software renderer hardly uses more than one core for a small image, so processes
divide the time by their number. This process is one of them: it draws while the others
start, which takes them a second or two, and on a crowded machine half a minute.
"""

import collections
import logging
import multiprocessing.connection
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxil.demonstrations.drawer import Drawer, Episode, Lost, Take, images

_MOST_PROCESSES = 8  # some 250 MB each
_WORTH_SECONDS = 5.0  # less is drawn before another process has gained anything
_NUM_TIMED = 4  # images, after the first one, which takes longer
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software rasterizer")

_logger = logging.getLogger(__name__)


def draw(
    environment: Any,
    episodes: Sequence[Episode],
    *,
    settings: Mapping[str, Any],
    take: Take,
    processes: int | None = None,
) -> None:
    """Draws episodes, in whatever order.

    Of the other processes none is left when this returns or raises. One that dies,
    hangs or fails is done without, with a warning: what it left is drawn here.

    Args:
      environment: a `PixelEnvironment`.
      episodes: all that is to be drawn.
      settings: the arguments of `make_environment` that made `environment`.
      take: is handed every image once, those of an episode in their order.
      processes: how many draw, this one among them; None for as many as pay.

    Raises:
      ValueError: the states don't fit the task's model.
      RuntimeError: nothing here can render.
    """
    num_drawn = {episode.place: 0 for episode in episodes}

    def took(place: int, start: int, pictures: np.ndarray) -> None:
        num_drawn[place] += len(pictures)
        take(place, start, pictures)

    waiting = collections.deque(episodes)
    here = _draw_here(environment, waiting, took)
    if len(episodes) < 2:
        processes = 1
    if processes is None:
        next(here, None)
        begin = time.perf_counter()
        for _ in range(_NUM_TIMED):
            next(here, None)
        seconds = (time.perf_counter() - begin) / _NUM_TIMED
        left = sum(map(len, episodes)) - sum(num_drawn.values())
        gl_name = environment.renderer.gl_name()
        processes = how_many(len(episodes), seconds=seconds * left, gl_name=gl_name)
    drawers: list[Drawer] = []
    try:
        for _ in range(min(processes, len(episodes)) - 1):
            gl_name = environment.renderer.gl_name()
            try:
                drawers.append(Drawer(settings, gl_name, waiting))
            except OSError as error:
                _warn(f"could not be started ({error})")
        _draw_together(here, drawers, took)
    finally:
        for drawer in drawers:
            drawer.close()
    rest = [whole.part(num_drawn[whole.place], len(whole)) for whole in episodes]
    lost = collections.deque(episode for episode in rest if len(episode))
    for _ in _draw_here(environment, lost, took):
        pass


def how_many(num_episodes: int, *, seconds: float, gl_name: str) -> int:
    """Returns how many processes should draw; 1 where more don't pay.

    Args:
      num_episodes: to be drawn; each is drawn by one process.
      seconds: that one process would take.
      gl_name: what draws, see `Renderer.gl_name`.
    """
    # GPUs draw fast enough alone, and EGL contexts of several processes at once have
    # been seen to hang there.
    is_software = any(name in gl_name.lower() for name in _SOFTWARE)
    if not is_software or seconds < _WORTH_SECONDS:
        return 1
    cores = len(os.sched_getaffinity(0))
    return max(min(cores, num_episodes, _MOST_PROCESSES), 1)


def _draw_here(
    environment: Any, waiting: collections.deque[Episode], take: Take
) -> Iterator[bool]:
    """Takes episodes out of `waiting` and draws them; pauses after each image."""
    while waiting:
        episode = waiting.popleft()
        pictures = images(environment, episode.number, episode.states)
        for start, picture in enumerate(pictures, episode.start):
            take(episode.place, start, picture[None])
            yield True


def _draw_together(here: Iterator[bool], drawers: list[Drawer], take: Take) -> None:
    """Draws image by image, and in between takes what the other processes draw.

    Those that are lost are closed and leave the list.
    """
    is_busy = True  # this process
    while True:
        if is_busy:
            is_busy = next(here, False)
        at_work = [drawer for drawer in drawers if drawer.is_at_work()]
        if not is_busy and not at_work:
            return
        seconds = min((drawer.seconds_left() for drawer in at_work), default=0.0)
        ready = multiprocessing.connection.wait(
            [drawer.pipe for drawer in at_work], 0.0 if is_busy else max(seconds, 0.0)
        )
        for drawer in at_work:
            try:
                if drawer.pipe in ready:
                    drawer.receive(take)
                elif drawer.seconds_left() <= 0:
                    raise Lost("does not answer")
            except Lost as error:
                _warn(str(error))
                drawers.remove(drawer)
                drawer.close()


def _warn(reason: str) -> None:
    _logger.warning(
        "a process that was to draw %s; what it leaves is drawn without it", reason
    )
