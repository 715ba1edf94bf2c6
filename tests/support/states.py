"""States with any numbers in them: tasks are pure functions of them."""

from typing import Any

import numpy as np

from tpm_gym.mechanism.cup import CUP
from tpm_gym.simulation.state import State


def apart(state: State) -> float:
    """Forward kinematics against the truth, m."""
    return float(np.linalg.norm(state.fk_position - state.platform_position))


def random_state(
    rng: np.random.Generator, shape: tuple[int, ...] = (), objects: int = 1, **values: Any
) -> State:
    """A state with leading axes ``shape``; ``values`` are taken as they are."""

    def normal(*size):
        return rng.normal(size=(*shape, *size))

    def unit(*size):
        vectors = normal(*size)
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    drawn = {
        **{name: normal(3) for name in ("theta", "theta_dot", "torque", "command")},
        **{name: normal(3) for name in ("fk_position", "fk_velocity", "platform_position")},
        **{name: rng.random(shape) for name in ("conditioning", "platform_tilt", "closure_error")},
        "assembly_mode_changed": np.zeros(shape, dtype=bool),
        "working_mode_changed": np.zeros(shape, dtype=bool),
        "held": rng.integers(-1, objects, shape),
        "vacuum": rng.uniform(0.0, CUP.vacuum, shape),
        "object_position": normal(objects, 3),
        "object_quaternion": unit(objects, 4),
        "object_axis": unit(objects, 3),
        "object_velocity": normal(objects, 3),
        "object_angular_velocity": normal(objects, 3),
        "belt_speed": rng.normal(size=shape),
    }
    return State(**{**drawn, **values})
