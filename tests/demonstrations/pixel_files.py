"""jaxil's own files of pixels: written, changed and loaded."""

import json
from typing import Any

import numpy as np

from jaxil.demonstrations import loading
from jaxil.demonstrations.readers import own
from jaxil.demonstrations.readers.recording import (
    PixelEpisode,
    Recording,
)

TASK = "cartpole_swingup"  # 100 control steps in a second
LIMIT = 2**30
_ASKED: dict[str, Any] = {
    "task": TASK,
    "num_episodes": 2,
    "action_repeat": 2,
    "image_size": 8,
}


def make_episode(num_steps=6, size=8, seed=0, action_dim=1):
    rng = np.random.default_rng(seed)
    return PixelEpisode(
        rng.integers(0, 256, (num_steps + 1, size, size, 3), dtype=np.uint8),
        rng.uniform(-1, 1, (num_steps, action_dim)).astype(np.float32),
        rng.uniform(0, 1, num_steps).astype(np.float32),
    )


def write(path, episodes, **facts):
    recording = Recording("made up", len(episodes), iter(episodes), **facts)
    own.write_pixels(path, recording, origin="a test")
    return path


def load(path, **changes):
    return loading.load(path, render_quality="fast", **(_ASKED | changes))


def check(path, **changes):
    loading.check(path, **(_ASKED | changes))


def set_metadata(path, **changes):
    with np.load(path) as stored:
        arrays = dict(stored)
    metadata = {**json.loads(str(arrays.pop("metadata"))), **changes}
    np.savez(path, allow_pickle=False, metadata=json.dumps(metadata), **arrays)
