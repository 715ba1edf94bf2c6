"""Bodies in motion, known from their data and the tree walked joint by joint, by differences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from walk import place, walk

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.dynamics import Dynamics
from tpm_gym.mechanism.tree import build, joint_angles

IDLE = "R33"
"""End link 10, a round bar: nothing drives its roll, so none of the motors does."""


class Bodies:
    """The links of a mechanism, moved by its motors, as Dynamics describes them."""

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics
        self.mechanism: Mechanism = build(dynamics.geometry)
        self.moving = self.mechanism.links[1:]
        factors: Sequence[float] = dynamics.link_masses or [1.0] * len(self.moving)
        self.masses = np.array([k.mass for k in self.moving]) * factors
        self.inertias = np.array([k.inertia for k in self.moving]) * np.reshape(factors, (-1, 1, 1))
        self.payload = dynamics.payload

    def frames(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centres of mass (links, 3) m, and rotations (links, 3, 3); the payload is at the lip."""
        joints = joint_angles(theta, self.dynamics.branch, self.dynamics.geometry) | {IDLE: 0.0}
        frames = walk(self.mechanism, joints)
        centres = [place(frames, k.name, tuple(k.centre_of_mass)) for k in self.moving]
        lip = place(frames, self.mechanism.tool, self.mechanism.lip)
        return np.array([*centres, lip]), np.array([frames[k.name][1] for k in self.moving])

    def slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Per unit rate of each motor: velocities (3, links, 3) and angular velocities."""
        step, linear, angular = 1e-6, [], []
        _, rotation = self.frames(theta)
        for by in step * np.eye(3):
            (ahead, turned), (behind, unturned) = self.frames(theta + by), self.frames(theta - by)
            linear.append((ahead - behind) / (2 * step))
            spin = (turned - unturned) @ np.swapaxes(rotation, -1, -2) / (2 * step)
            angular.append(np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1))
        return np.array(linear), np.array(angular)

    def mass_matrix(self, theta: FloatArray) -> FloatArray:
        """(3, 3) kg m^2, the sum of all kinetic energies' second derivatives by the rates."""
        linear, angular = self.slopes(theta)
        _, rotation = self.frames(theta)
        moments = rotation @ self.inertias @ np.swapaxes(rotation, -1, -2)
        masses = [*self.masses, self.payload]
        return np.asarray(
            np.einsum("ink,n,jnk->ij", linear, masses, linear)
            + np.einsum("ina,nab,jnb->ij", angular, moments, angular)
        )

    def weights(self, theta: FloatArray) -> FloatArray:
        """(3,) N m, the slope of the potential energy."""
        linear, _ = self.slopes(theta)
        return -np.einsum(
            "ink,n,k->i", linear, [*self.masses, self.payload], self.dynamics.free_fall
        )
