"""Motor torques of any machine by finite differences, from its bodies and joint positions alone.

Tests compare closed forms with these torques, and machines without a closed form use them. The
relative error is about 1e-6, and 2e-4 next to a parallel singularity. A call takes milliseconds, as
it computes the places of all bodies nine times.

The place of a rigid body is F = [R | x] (3, 4), with its rotation R and its centre of mass x. Its
kinetic energy is T = trace(F' H F'^T) / 2, where F' is the derivative by time. H (4, 4) has two
diagonal blocks: the second moments of the mass (3, 3), and the mass. So the torques are sums of
trace(dF/dtheta H F''^T) over the bodies, without angular velocities.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.mechanism.bodies import Mechanism

_STEP = 1e-5  # rad or m
_TIME = 1e-5  # s


def torque(
    mechanism: Mechanism,
    joint_positions: Callable[[Vector], dict[str, float]],
    free_fall: Vector,
    link_masses: FloatArray,
    theta: FloatArray,
    theta_dot: FloatArray,
    theta_ddot: FloatArray,
) -> FloatArray:
    """Compute the motors' torques (3,) N m (N for a slide) for a motion.

    Args:
        joint_positions: Function from the motors' positions to all joint positions.
        free_fall: Acceleration of gravity in the machine's frame, m/s^2.
        link_masses: For each moving link, factor by which its mass and inertia are multiplied.
        theta: Positions of the motors (3,), rad or m.
        theta_dot: Velocities of the motors (3,), rad/s or m/s.
        theta_ddot: Accelerations of the motors (3,), rad/s^2 or m/s^2.
    """

    def frames(motors: FloatArray) -> FloatArray:
        a, b, c = motors.tolist()
        return _frames(mechanism, joint_positions((a, b, c)))

    before, now, after = (
        frames(theta + t * theta_dot + t * t / 2 * theta_ddot) for t in (-_TIME, 0.0, _TIME)
    )
    acceleration = (before - 2 * now + after) / _TIME**2
    acceleration[:, :, 3] -= free_fall
    forces = acceleration @ (link_masses[:, None, None] * _second_moments(mechanism))
    steps = _STEP * np.eye(3)
    return np.array(
        [(forces * (frames(theta + s) - frames(theta - s))).sum() / (2 * _STEP) for s in steps]
    )


def _second_moments(mechanism: Mechanism) -> FloatArray:
    """Compute H of the moving links, (links, 4, 4) kg m^2 and kg."""
    table = np.zeros((len(mechanism.links) - 1, 4, 4))
    for block, link in zip(table, mechanism.links[1:], strict=True):
        block[:3, :3] = np.trace(link.inertia) / 2 * np.eye(3) - link.inertia
        block[3, 3] = link.mass
    return table


def _frames(mechanism: Mechanism, joints: dict[str, float]) -> FloatArray:
    """Compute [R | centre of mass] of the moving links, (links, 3, 4), in the machine's frame."""
    places = mechanism.places(joints)
    moving = [(places[link.name], link.centre_of_mass) for link in mechanism.links[1:]]
    return np.array([np.column_stack([at.rotation, at.point(centre)]) for at, centre in moving])
