"""States with any numbers in them."""

from __future__ import annotations

import numpy as np

from tpm_gym.simulation.state import State


def random_state(rng, shape=()):
    """A state with any numbers in it; tasks are pure functions."""
    quaternion = rng.normal(size=(*shape, 4))
    axis = rng.normal(size=(*shape, 3))
    return State(
        theta=rng.normal(size=(*shape, 3)),
        theta_dot=rng.normal(size=(*shape, 3)),
        torque=rng.normal(size=(*shape, 3)),
        fk_position=rng.normal(size=(*shape, 3)),
        fk_velocity=rng.normal(size=(*shape, 3)),
        conditioning=rng.random(shape),
        platform_position=rng.normal(size=(*shape, 3)),
        platform_tilt=rng.random(shape),
        closure_error=rng.random(shape),
        mode_change=None,
        command=rng.normal(size=(*shape, 3)),
        holding=rng.random(shape) > 0.5,
        object_position=rng.normal(size=(*shape, 3)),
        object_quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
        object_axis=axis / np.linalg.norm(axis, axis=-1, keepdims=True),
        object_velocity=rng.normal(size=(*shape, 3)),
        object_angular_velocity=rng.normal(size=(*shape, 3)),
    )
