"""The equations of motion of the suite's acrobot."""

from typing import Any

import numpy as np
from studio import ACTION_REPEAT


class Arm:
    """A closed-form model of the arm, for many states at once.

    A state is four arrays [N]: angles of shoulder and elbow in radians, 0 when upright,
    and their speeds. In float64 it matches the simulator to rounding.
    """

    def __init__(self, physics: Any):
        """Reads the parameters of a dm_control `Physics`."""
        model = physics.model
        mass_1, mass_2 = model.body_mass[1:]
        centre_1, centre_2 = model.body_ipos[1:, 2]
        length = model.body_pos[2, 2]
        inertia_1, inertia_2 = model.body_inertia[1:, 1]
        gravity = -model.opt.gravity[2]
        far = inertia_2 + mass_2 * centre_2**2
        near = inertia_1 + mass_1 * centre_1**2 + mass_2 * length**2
        # Python floats: NumPy's would promote float32 arrays to float64.
        self._inertia, self._far = float(near + far), float(far)
        self._coupling = float(mass_2 * length * centre_2)
        self._weight_1 = float(gravity * (mass_1 * centre_1 + mass_2 * length))
        self._weight_2 = float(gravity * mass_2 * centre_2)
        self._damping = [float(value) for value in model.dof_damping]
        self._gear = float(model.actuator_gear[0, 0])
        self._frame_seconds = float(model.opt.timestep)
        self.greatest_energy = self._weight_1 + self._weight_2
        self.regulator = self._regulator()

    def energy(self, state: tuple) -> np.ndarray:
        """Returns kinetic and potential energy, in joules. Shape [N]."""
        q1, q2, v1, v2 = state
        bend = self._coupling * np.cos(q2)
        kinetic = 0.5 * (self._inertia + 2 * bend) * v1 * v1
        kinetic += (self._far + bend) * v1 * v2 + 0.5 * self._far * v2 * v2
        return kinetic + self._weight_1 * np.cos(q1) + self._weight_2 * np.cos(q1 + q2)

    def step(self, state: tuple, action: np.ndarray, num_frames: int = 1) -> tuple:
        """Returns the state after one Runge-Kutta step (order 4) over `num_frames`.

        Actions [N] are in [-1, 1]. The simulator takes one step per frame.
        """
        q1, q2, v1, v2 = state
        torque, h = self._gear * action, self._frame_seconds * num_frames
        a1, a2 = self._acceleration(q1, q2, v1, v2, torque)
        u1, u2 = v1 + h / 2 * a1, v2 + h / 2 * a2
        q = q1 + h / 2 * v1, q2 + h / 2 * v2
        b1, b2 = self._acceleration(*q, u1, u2, torque)
        w1, w2 = v1 + h / 2 * b1, v2 + h / 2 * b2
        c1, c2 = self._acceleration(q1 + h / 2 * u1, q2 + h / 2 * u2, w1, w2, torque)
        x1, x2 = v1 + h * c1, v2 + h * c2
        d1, d2 = self._acceleration(q1 + h * w1, q2 + h * w2, x1, x2, torque)
        return (
            q1 + h / 6 * (v1 + 2 * (u1 + w1) + x1),
            q2 + h / 6 * (v2 + 2 * (u2 + w2) + x2),
            v1 + h / 6 * (a1 + 2 * (b1 + c1) + d1),
            v2 + h / 6 * (a2 + 2 * (b2 + c2) + d2),
        )

    def _acceleration(self, q1, q2, v1, v2, torque) -> tuple[np.ndarray, np.ndarray]:
        bend = self._coupling * np.cos(q2)
        centrifugal = self._coupling * np.sin(q2)
        weight_2 = self._weight_2 * np.sin(q1 + q2)
        force_1 = self._weight_1 * np.sin(q1) + weight_2 - self._damping[0] * v1
        force_1 += centrifugal * v2 * (v1 + v1 + v2)
        force_2 = weight_2 + torque - self._damping[1] * v2 - centrifugal * v1 * v1
        mass_1, mass_12 = self._inertia + 2 * bend, self._far + bend
        scale = 1 / (mass_1 * self._far - mass_12 * mass_12)
        return (
            (self._far * force_1 - mass_12 * force_2) * scale,
            (mass_1 * force_2 - mass_12 * force_1) * scale,
        )

    def _regulator(self) -> np.ndarray:
        """Returns K of the optimal action = -K state near the top. Shape [4]."""
        small = 1e-5
        nudges = small * np.concatenate([np.eye(5), -np.eye(5)])
        state = tuple(nudges.T[:4])
        for _ in range(ACTION_REPEAT):
            state = self.step(state, nudges[:, 4])
        ends = np.stack(state)
        slopes = (ends[:, :5] - ends[:, 5:]) / (2 * small)
        a, b = slopes[:, :4], slopes[:, 4:]
        cost = to_go = np.diag([1.0, 1.0, 0.1, 0.1])
        gain = np.zeros((1, 4))
        for _ in range(2000):  # Riccati recursion, converged
            gain = np.linalg.solve(1 + b.T @ to_go @ b, b.T @ to_go @ a)
            to_go = cost + a.T @ to_go @ (a - b @ gain)
        return gain[0]


def task_reward(q1: np.ndarray, q2: np.ndarray) -> np.ndarray:
    """Returns the suite's reward of one frame, in [0, 1]. Shape [N].

    It is 1 within 0.2 m of the tip's highest point, and 0.1 at 1 m from there on.
    """
    x = np.sin(q1) + np.sin(q1 + q2)
    z = np.cos(q1) + np.cos(q1 + q2) - 2
    beyond = np.maximum(np.sqrt(x * x + z * z) - 0.2, 0)
    return np.exp(float(np.log(0.1)) * beyond * beyond)
