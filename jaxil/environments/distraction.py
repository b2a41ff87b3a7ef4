"""Visual distractions: changes of appearance that say nothing about the task.

Colours, camera and background vary as in the Distracting Control Suite (Stone et al.
2021), at its three strengths. Random patterns replace its background videos, so no data
are needed, and all of it stays fixed within an episode.
"""

import importlib
from typing import Any

import numpy as np
from PIL import Image

STRENGTHS = {"none": 0.0, "easy": 0.1, "medium": 0.2, "hard": 0.3}
_COLOURS = ("mat_rgba", "geom_rgba")
# Which of these a camera uses depends on whether it follows a body.
_POSITIONS = ("cam_pos", "cam_pos0", "cam_poscom0")
_CAMERA = (*_POSITIONS, "cam_quat", "cam_mat0")
_PATCHES = 6  # of a background pattern, along a side


class Distraction:
    """Varies the appearance of one simulation."""

    def __init__(self, physics: Any, camera: int, strength: str) -> None:
        """Stores the original appearance; `strength` is a key of `STRENGTHS`."""
        self._physics, self._camera = physics, camera
        self._scale = STRENGTHS[strength]
        names = (*_COLOURS, *_CAMERA, "tex_data")
        self._own = {name: getattr(physics.model, name).copy() for name in names}

    def restart(self, seeds: np.ndarray) -> None:
        """Samples the appearance of an episode."""
        rng, model = np.random.default_rng(seeds), self._physics.model
        scale = self._scale
        for name in _COLOURS:
            colours = self._own[name].copy()
            colours[:, :3] += rng.uniform(-scale, scale, (len(colours), 3))
            getattr(model, name)[:] = np.clip(colours, 0.0, 1.0)
        angles = rng.uniform(-scale, scale, 2) * np.pi / 2
        if self._camera >= 0:  # -1 is the free camera, which is not in the model
            self._turn_camera(*angles)
        weight = scale / max(STRENGTHS.values())
        for index in self._backgrounds():
            width = int(model.tex_width[index])
            pattern = rng.integers(0, 256, (_PATCHES, _PATCHES, 3), dtype=np.uint8)
            image = np.asarray(Image.fromarray(pattern).resize((width, width)))
            start = int(model.tex_adr[index])
            faces = int(model.tex_height[index]) // width
            texels = slice(start, start + faces * image.size)
            own = self._own["tex_data"][texels].astype(float)
            mixed = (1 - weight) * own + weight * np.tile(image.ravel(), faces)
            model.tex_data[texels] = mixed.astype(np.uint8)

    def upload(self) -> None:
        """Copies the background to the GL context, which must exist."""
        mujoco = _mujoco()
        model, contexts = self._physics.model, self._physics.contexts
        with contexts.gl.make_current() as context:
            for index in self._backgrounds():
                arguments = (model.ptr, contexts.mujoco.ptr, index)
                context.call(mujoco.mjr_uploadTexture, *arguments)

    def _backgrounds(self) -> list[int]:
        """Returns the indices of the sky's and floors' textures, if of RGB squares."""
        mujoco = _mujoco()
        model, skybox = self._physics.model, mujoco.mjtTexture.mjTEXTURE_SKYBOX
        planes = model.geom_matid[model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE]
        of_planes = model.mat_texid[planes[planes >= 0]].ravel()
        return [
            index
            for index in range(model.ntex)
            if (model.tex_type[index] == skybox or index in of_planes)
            and model.tex_nchannel[index] == 3
            and model.tex_height[index] % model.tex_width[index] == 0
        ]

    def _turn_camera(self, yaw: float, roll: float) -> None:
        """Turns the camera about the vertical axis, and about its own."""
        mujoco = _mujoco()
        model, camera = self._physics.model, self._camera
        own = {name: self._own[name][camera] for name in _CAMERA}
        turn, tilt = _quaternion(yaw), _quaternion(roll)
        for name in _POSITIONS:
            position = np.empty(3)
            mujoco.mju_rotVecQuat(position, own[name], turn)
            getattr(model, name)[camera] = position
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, turn, own["cam_quat"])
        mujoco.mju_mulQuat(turned, turned.copy(), tilt)
        model.cam_quat[camera] = turned
        turn_matrix, tilt_matrix = np.empty(9), np.empty(9)
        mujoco.mju_quat2Mat(turn_matrix, turn)
        mujoco.mju_quat2Mat(tilt_matrix, tilt)
        own_matrix = own["cam_mat0"].reshape(3, 3)
        matrix = turn_matrix.reshape(3, 3) @ own_matrix @ tilt_matrix.reshape(3, 3)
        model.cam_mat0[camera] = matrix.ravel()


def _mujoco() -> Any:
    """Imports MuJoCo, which reads MUJOCO_GL then; its functions have no types."""
    return importlib.import_module("mujoco")


def _quaternion(angle: float) -> np.ndarray:
    """Returns the rotation about the z axis."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
