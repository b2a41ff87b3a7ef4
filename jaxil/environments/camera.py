"""Renders a simulation at one of three qualities."""

from collections.abc import Callable
from typing import Any

import numpy as np

RENDER_QUALITIES = ("paper", "fast", "smooth")
# Shadow maps and supersampling take most of a software renderer's time.
_FAST_FLAGS = {"shadow": False, "reflection": False}
_SMOOTH_FACTOR = 2
# What GL calls renderers that use no GPU.
_SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software")

# (physics, height and width in pixels, camera index) -> dm_control `Camera`. Raises
# RuntimeError or ImportError without usable GL.
OpenCamera = Callable[[Any, int, int], Any]


def renders_in_software(gl_name: str) -> bool:
    """Returns whether a renderer, as GL calls it, uses no GPU."""
    return any(word in gl_name.lower() for word in _SOFTWARE)


class Renderer:
    """One camera of one simulation, created once.

    dm_control's `physics.render` creates camera and scene for each image, which takes
    longer than software rendering itself.
    """

    def __init__(
        self,
        physics: Any,
        *,
        open_camera: OpenCamera,
        image_size: int,
        camera: int,
        render_quality: str,
    ):
        """Sets up the model; the first image creates the GL context.

        Args:
          physics: a dm_control `Physics` that has not been rendered yet.
          open_camera: see `OpenCamera`.
          image_size: height and width in pixels.
          camera: index of a camera of the model.
          render_quality: "paper" for dm_control's defaults; "fast" without
            supersampling, shadows and reflections; "smooth" for "fast" at twice the
            size, averaged over 2x2 pixels. Else a thin pole jumps between pixels, and
            small images do not show its speed.
        """
        self._physics, self._open_camera = physics, open_camera
        self._image_size, self._camera_index = image_size, camera
        self._flags = None if render_quality == "paper" else _FAST_FLAGS
        self._factor = _SMOOTH_FACTOR if render_quality == "smooth" else 1
        self._camera = None
        vis = physics.model.vis
        # These are read when the GL context is created.
        if render_quality != "paper":
            vis.quality.offsamples = 0
            # Fewer triangles per sphere halve the time or better, and change pixels by
            # 0.1 to 0.2 grey levels on average at 48x48.
            vis.quality.numslices, vis.quality.numstacks = 12, 8
        self._size = self._factor * image_size
        vis.global_.offwidth = max(int(vis.global_.offwidth), self._size)
        vis.global_.offheight = max(int(vis.global_.offheight), self._size)

    def render(self) -> np.ndarray:
        """Returns a new image, uint8 [H, W, 3]; RuntimeError without usable GL."""
        image = self.open().render(render_flag_overrides=self._flags)
        n, size = self._factor, self._image_size
        if n == 1:
            return image.copy()  # the camera reuses its buffer
        total = np.full((size, size, 3), n * n // 2, np.uint16)
        for i, j in np.ndindex(n, n):
            total += image[i::n, j::n]
        return (total // (n * n)).astype(np.uint8)

    def gl_name(self) -> str:
        """Returns GL's name of the rendering device, e.g. "llvmpipe (...)"."""
        self.open()
        from OpenGL import GL

        with self._physics.contexts.gl.make_current() as context:
            raw = context.call(GL.glGetString, GL.GL_RENDERER)
        return raw.decode() if isinstance(raw, bytes) else str(raw)

    def open(self) -> Any:
        """Returns the dm_control `Camera`; the first call creates the GL context."""
        if self._camera is None:
            try:
                self._camera = self._open_camera(
                    self._physics, self._size, self._camera_index
                )
            except Exception as error:  # MuJoCo's and GLFW's have no common class
                raise RuntimeError(
                    f"rendering is not available: {error}; "
                    "`python -m jaxil.doctor` says what to install"
                ) from error
        return self._camera
