"""Delta and Orthoglide, for the comparison in docs/mechanisms.md.

Three legs hold the platform. Each has a motor, which turns an arm or moves a slider, and a
parallelogram, which keeps the platform from turning. So the closures are |B_iC_i| = l_i, as in
Eqs. (6) and (9), with C_i fixed to the platform. In A v = B q_dot the rods B_iC_i are the rows of
A, and B_iC_i . dB_i/dq_i are the diagonal of B. Lengths are in m, motors in rad or m, in any frame.

Functions take arrays (..., 3) of finite numbers and raise InputError for anything else. Rows
without a solution are NaN.
"""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis.poc import Chain, parallelogram_4r, parallelogram_4s, prismatic, revolute
from tpm_gym.arrays import FloatArray, Vector, finite_points
from tpm_gym.kinematics.geometry import PAPER


@dataclass(frozen=True)
class Leg:
    """One leg of a tripod.

    Attributes:
        pivot: Point A on the motor's axis, m.
        axis: Unit vector; the arm turns about it, or the slider moves along it.
        hinge: Unit vector, the axis of the revolutes at both ends of the parallelogram, and the
            direction of its short links.
        tip: Vector from P to C, m.
        rod: Length of the rods, m.
        arm: Vector from A to B at angle 0, m, perpendicular to the axis; None for a slider.
    """

    pivot: Vector
    axis: Vector
    hinge: Vector
    tip: Vector
    rod: float
    arm: Vector | None = None


@dataclass(frozen=True)
class Tripod:
    """Platform on three legs with three translational degrees of freedom."""

    legs: tuple[Leg, Leg, Leg]

    def inverse_all(self, position: ArrayLike) -> FloatArray:
        """Compute all 8 solutions (..., 8, 3) for P at ``position`` (..., 3) m, 2 for each leg."""
        points = finite_points("position", position)
        both = np.stack([_motor(leg, points) for leg in self.legs], axis=-1)  # (2, ..., 3)
        choices = [
            np.stack([both[side, ..., leg] for leg, side in enumerate(sides)], axis=-1)
            for sides in product((0, 1), repeat=3)
        ]
        return np.stack(choices, axis=-2)

    def forward_all(self, motors: ArrayLike) -> FloatArray:
        """Compute both positions (..., 2, 3) m of P, the intersections of three spheres."""
        centres = self.elbows(motors) - np.array([leg.tip for leg in self.legs])
        squares = np.array([leg.rod**2 for leg in self.legs])
        first, others = centres[..., :1, :], centres[..., 1:, :] - centres[..., :1, :]
        normal = np.cross(others[..., 0, :], others[..., 1, :])
        with np.errstate(all="ignore"):
            # Spheres 2 and 3 meet sphere 1 in two planes; reach has their distances ...
            reach = (squares[0] - squares[1:] + (others**2).sum(axis=-1)) / 2
            crossed = [np.cross(others[..., 1, :], normal), np.cross(normal, others[..., 0, :])]
            size = (normal**2).sum(axis=-1)[..., None]
            foot = sum(reach[..., i, None] * crossed[i] for i in range(2)) / size
            # ... and height goes along the common line of the planes to the sphere.
            height = np.sqrt((squares[0] - (foot**2).sum(axis=-1, keepdims=True)) / size)
        ways = np.array([[-1.0], [1.0]]) * (height * normal)[..., None, :]
        found: FloatArray = first + foot[..., None, :] + ways
        return found

    def elbows(self, motors: ArrayLike) -> FloatArray:
        """Compute B1, B2, B3 (..., 3, 3) m at ``motors`` (..., 3)."""
        return _elbows(self, finite_points("motors", motors))[0]

    def parallel(self, position: ArrayLike, motors: ArrayLike) -> FloatArray:
        """Compute A (..., 3, 3) m; it is singular where the rods are parallel to one plane."""
        tips = np.array([leg.tip for leg in self.legs])
        points = finite_points("position", position)[..., None, :]
        rods: FloatArray = points + tips - self.elbows(motors)
        return rods

    def serial(self, position: ArrayLike, motors: ArrayLike) -> FloatArray:
        """Compute the diagonal of B (..., 3): 0 where the rod is normal to the elbow's velocity."""
        _, rates = _elbows(self, finite_points("motors", motors))
        factors: FloatArray = (self.parallel(position, motors) * rates).sum(axis=-1)
        return factors

    def velocity(self, position: ArrayLike, motors: ArrayLike) -> FloatArray:
        """Compute J = A^-1 B (..., 3, 3), with v = J q_dot."""
        b = self.serial(position, motors)
        jacobian: FloatArray = np.linalg.inv(self.parallel(position, motors)) * b[..., None, :]
        return jacobian

    def chains(self, position: ArrayLike, motors: ArrayLike, balls: bool = False) -> list[Chain]:
        """Return the legs at one configuration for :func:`tpm_gym.analysis.poc.analyse`.

        Args:
            position: P (3,) m.
            motors: Motor positions (3,).
            balls: Whether a leg is a motor and a parallelogram of spherical pairs, as in the
                paper's branch I, or motor, R, parallelogram of revolutes, R, as in branch III.
        """
        rods, elbows = self.parallel(position, motors), self.elbows(motors)
        chains = []
        for number, (leg, rod, elbow) in enumerate(zip(self.legs, rods, elbows, strict=True), 1):
            motor = prismatic if leg.arm is None else revolute
            axis, hinge, end = np.array(leg.axis), np.array(leg.hinge), elbow + rod
            units = [motor("motor", axis, np.array(leg.pivot), actuated=True)]
            if balls:
                units.append(parallelogram_4s("Pa(4S)", hinge, rod, end))
            else:
                middle = parallelogram_4r("Pa(4R)", hinge, rod, end)
                units += [revolute("R", hinge, elbow), middle, revolute("R", hinge, end)]
            chains.append(Chain(f"leg {number}", tuple(units)))
        return chains


def _motor(leg: Leg, position: FloatArray) -> FloatArray:
    """Return both solutions (2, ...) of one leg."""
    span = position + leg.tip - np.array(leg.pivot)
    square = (span**2).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        if leg.arm is None:
            along = span @ np.array(leg.axis)
            root = np.sqrt(along**2 - square + leg.rod**2)
            return np.stack([along - root, along + root])
        arm = np.array(leg.arm)
        level, up = span @ arm, span @ np.cross(leg.axis, arm)
        fold = np.arccos((square + arm @ arm - leg.rod**2) / (2 * np.hypot(level, up)))
        direction = np.arctan2(up, level)
        return np.stack([direction - fold, direction + fold])


def _elbows(tripod: Tripod, motors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return B_i and dB_i/dq_i, each (..., 3, 3)."""
    elbows, rates = [], []
    for i, leg in enumerate(tripod.legs):
        q, axis = motors[..., i, None], np.array(leg.axis)
        if leg.arm is None:
            elbows.append(leg.pivot + q * axis)
            rates.append(np.broadcast_to(axis, elbows[-1].shape))
        else:
            arm, across = np.array(leg.arm), np.cross(leg.axis, leg.arm)
            elbows.append(leg.pivot + np.cos(q) * arm + np.sin(q) * across)
            rates.append(np.cos(q) * across - np.sin(q) * arm)
    return np.stack(elbows, axis=-2), np.stack(rates, axis=-2)


def delta(base: float, platform: float, arm: float, rod: float) -> Tripod:
    """Build Clavel's Delta from radii of base and platform, and lengths of arms and rods, m.

    z points from the base to the platform, as in the paper.
    """
    legs = []
    for turn in (0.0, 2 * math.pi / 3, 4 * math.pi / 3):
        x, y = math.cos(turn), math.sin(turn)
        pivot, tip, bar = ((r * x, r * y, 0.0) for r in (base, platform, arm))
        axis = (y, -x, 0.0)  # positive angles turn the arm towards +z
        legs.append(Leg(pivot, axis, axis, tip, rod, bar))
    return Tripod((legs[0], legs[1], legs[2]))


def orthoglide(rod: float) -> Tripod:
    """Build the Orthoglide of Chablat and Wenger: three sliders at right angles, rod length in m.

    At P = 0 each rod is parallel to its slider, and J is the identity.
    """
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    origin = (0.0, 0.0, 0.0)
    first, second, third = (
        Leg(origin, axis, hinge, origin, rod) for axis, hinge in ((x, y), (y, z), (z, x))
    )
    return Tripod((first, second, third))


DELTA = delta(PAPER.l1, PAPER.l2, PAPER.l3, PAPER.l4)
"""Delta with the lengths of the paper's case study."""

ORTHOGLIDE = orthoglide(PAPER.l4)
