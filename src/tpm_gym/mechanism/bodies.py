"""Solids, joints, links and loop closures, and the mechanism as a tree of them.

Units: metres, radians, kilograms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector

ALUMINIUM, STEEL = 2700.0, 7850.0  # kg/m^3

LEVEL: Final = (0.0, 0.0, 0.0)
"""Roll, pitch and yaw of a frame that is parallel to its parent frame, rad."""

ALONG: Final = {"x": (0.0, math.pi / 2, 0.0), "y": (math.pi / 2, 0.0, 0.0), "z": LEVEL}
"""Roll, pitch and yaw that turn a cylinder along z onto the named axis, rad."""


def rotation_of(rpy: Vector) -> FloatArray:
    """Compute the matrix (3, 3) of roll, pitch and yaw, rad, about the fixed x, y and z axes."""
    (a, b, c), (p, q, r) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [b * c, p * q * c - a * r, a * q * c + p * r],
            [b * r, p * q * r + a * c, a * q * r - p * c],
            [-q, p * b, a * b],
        ]
    )


@dataclass(frozen=True)
class Solid:
    """A homogeneous box or cylinder, possibly hollow, fixed to a link.

    Attributes:
        kind: ``"box"``, or ``"cylinder"`` along ``axis``.
        size: Box: full edges (x, y, z), m. Cylinder: (radius, length, 0), m.
        centre: Position in the link's frame, m.
        density: Density of the material, kg/m^3; zero for parts that are only drawn.
        bore: Size of the hollow, m. Box: edges (x, y, z). Cylinder: (inner radius, length, 0). All
            three values are 0 for a solid without a hollow.
        axis: Axis of a cylinder in the solid's frame: ``"x"``, ``"y"`` or ``"z"``.
        colour: Name of a colour in :mod:`tpm_gym.mechanism.urdf`.
        collides: Whether the solid can touch objects and the table.
        rpy: Roll, pitch and yaw of the solid's frame in the link's frame, rad, as in URDF.
    """

    kind: Literal["box", "cylinder"]
    size: Vector
    centre: Vector
    density: float
    bore: Vector = (0.0, 0.0, 0.0)
    axis: Literal["x", "y", "z"] = "z"
    colour: str = "grey"
    collides: bool = False
    rpy: Vector = LEVEL

    @property
    def mass(self) -> float:
        """Mass in kg."""
        return self._mass(self.size) - self._mass(self.bore)

    @property
    def moments(self) -> FloatArray:
        """Principal moments of inertia (3,) about the centre, along the solid's axes, kg m^2."""
        return self._moments(self.size) - self._moments(self.bore)

    @property
    def inertia(self) -> FloatArray:
        """Inertia (3, 3) about the centre, along the link's axes, kg m^2."""
        if self.rpy == LEVEL:
            return np.diag(self.moments)
        turn = rotation_of(self.rpy)
        return np.asarray(turn @ np.diag(self.moments) @ turn.T)

    @property
    def rotation(self) -> FloatArray:
        """Matrix (3, 3) that turns a box, or a cylinder along z, to its orientation in the link."""
        turn = rotation_of(self.rpy)
        return turn if self.kind == "box" else turn @ rotation_of(ALONG[self.axis])

    @property
    def half_extent(self) -> FloatArray:
        """Half edges (3,) of the box around the solid, along the link's axes, m."""
        if self.kind == "box":
            half = np.asarray(self.size) / 2
        else:
            radius, length, _ = self.size
            half = np.full(3, radius)
            half["xyz".index(self.axis)] = length / 2
        return np.asarray(np.abs(rotation_of(self.rpy)) @ half)

    def _mass(self, size: Vector) -> float:
        if self.kind == "box":
            return self.density * size[0] * size[1] * size[2]
        return float(self.density * np.pi * size[0] ** 2 * size[1])

    def _moments(self, size: Vector) -> FloatArray:
        mass = self._mass(size)
        if self.kind == "box":
            squares: FloatArray = np.square(size)
            return np.asarray(mass / 12 * (squares.sum() - squares))
        radius, length, _ = size
        moments = np.full(3, mass * (3 * radius**2 + length**2) / 12)
        moments["xyz".index(self.axis)] = mass * radius**2 / 2
        return moments


@dataclass(frozen=True)
class Joint:
    """Joint between a link and its parent.

    Attributes:
        name: Name of the joint, as in the paper if the paper names it.
        kind: URDF joint type.
        parent: Name of the parent link.
        origin: Position of the joint in the parent's frame, m.
        axis: Axis in the joint's frame.
        lower: Lower limit, rad or m. Only motors and slides need limits; the loops limit the other
            joints.
        upper: Upper limit, rad or m.
        effort: Limit of torque or force, N m or N; zero for passive joints.
        speed: Lowest speed at which the limit of the effort is zero, rad/s or m/s; zero for passive
            joints.
        corner: Highest speed with full effort, rad/s or m/s. From ``corner`` to ``speed``, the
            limit of the effort falls linearly to zero.
        rpy: Roll, pitch and yaw of the joint's frame in the parent's frame, rad, as in URDF.
    """

    name: str
    kind: Literal["continuous", "revolute", "prismatic"]
    parent: str
    origin: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0
    speed: float = 0.0
    corner: float = 0.0
    rpy: Vector = LEVEL

    @property
    def unit(self) -> Literal["rad", "m"]:
        """Unit of the joint's position."""
        return "m" if self.kind == "prismatic" else "rad"


@dataclass(frozen=True)
class Link:
    """A rigid body: solids, and the joint that holds it (None for the base)."""

    name: str
    solids: tuple[Solid, ...]
    joint: Joint | None = None

    @property
    def mass(self) -> float:
        """Mass in kg."""
        return sum(solid.mass for solid in self.solids)

    @property
    def centre_of_mass(self) -> FloatArray:
        """Centre of mass (3,) in the link's frame, m."""
        weighted = sum(solid.mass * np.asarray(solid.centre) for solid in self.solids)
        return np.asarray(weighted) / self.mass

    @property
    def inertia(self) -> FloatArray:
        """Inertia (3, 3) about the centre of mass, along the link's axes, kg m^2."""
        total = np.zeros((3, 3))
        for solid in self.solids:
            arm = np.asarray(solid.centre) - self.centre_of_mass
            steiner = solid.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
            total += solid.inertia + steiner
        return total


@dataclass(frozen=True)
class Closure:
    """A ball joint that closes a loop: two points that must coincide.

    Attributes:
        name: Name of the joint, as in the paper if the paper names it.
        link_a: Link on one side.
        point_a: Point in the frame of ``link_a``, m.
        link_b: Link on the other side.
        point_b: Point in the frame of ``link_b``, m.
    """

    name: str
    link_a: str
    point_a: Vector
    link_b: str
    point_b: Vector


class Place(NamedTuple):
    """Position and orientation of a link in the base's frame.

    Attributes:
        origin: Origin of the link's frame, (..., 3) m.
        rotation: Rotation matrix (..., 3, 3).
    """

    origin: FloatArray
    rotation: FloatArray

    def point(self, point: ArrayLike) -> FloatArray:
        """Convert a point of the link's frame to the base's frame, (..., 3) m."""
        placed: FloatArray = self.origin + self.rotation @ np.asarray(point)
        return placed


@dataclass(frozen=True)
class Mechanism:
    """Links, joints and loop closures of a robot, as engines load them.

    Attributes:
        links: Links, parents before children; the first is the base.
        closures: The ball joints that close the loops.
        platform: Name of the platform link.
        point_p: Point P in the platform's frame, m.
        tool: Name of the link that slides in the platform, with the vacuum cup.
        lip: Centre of the cup's lip in the tool's frame, m.
        actuated: Names of the motors' joints, in the order of theta_1, theta_2, theta_3.
        name: Name of the robot in its URDF and MJCF files; the files' names begin with this name.
    """

    links: tuple[Link, ...]
    closures: tuple[Closure, ...]
    platform: str
    point_p: Vector
    tool: str
    lip: Vector
    actuated: tuple[str, ...]
    name: str = "robot"

    @cached_property
    def _by_name(self) -> dict[str, Link]:
        return {link.name: link for link in self.links}

    @cached_property
    def _held(self) -> list[tuple[Link, Joint]]:
        return [(link, link.joint) for link in self.links if link.joint]

    def link(self, name: str) -> Link:
        """Return the link with this name.

        Raises:
            KeyError: If no link has this name.
        """
        return self._by_name[name]

    @cached_property
    def motors(self) -> tuple[Joint, ...]:
        """Joints of the motors, in the order of :attr:`actuated`."""
        joints = {joint.name: joint for _, joint in self._held}
        return tuple(joints[name] for name in self.actuated)

    @cached_property
    def stops(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest positions of the motors, rad or m; infinite if there are no stops."""
        endless = (-math.inf, math.inf)
        return tuple(
            endless if motor.kind == "continuous" else (motor.lower, motor.upper)
            for motor in self.motors
        )

    def places(self, joints: Mapping[str, ArrayLike]) -> dict[str, Place]:
        """Compute positions and orientations of all links in the base's frame.

        Args:
            joints: Position (...,) of each joint by name, rad or m. A slide that is not in
                ``joints`` is at 0 m.
        """
        shape = np.shape(next(iter(joints.values())))
        identity = np.broadcast_to(np.eye(3), (*shape, 3, 3))
        found = {self.links[0].name: Place(np.zeros((*shape, 3)), identity)}
        for link, joint in self._held:
            parent = found[joint.parent]
            origin, rotation = parent.point(joint.origin), parent.rotation
            if joint.rpy != LEVEL:
                rotation = rotation @ rotation_of(joint.rpy)
            if joint.kind == "prismatic":
                slide = np.asarray(joints.get(joint.name, 0.0))[..., None]
                origin = origin + slide * (rotation @ np.asarray(joint.axis))
            else:
                rotation = rotation @ _rotation(joint.axis, np.asarray(joints[joint.name]))
            found[link.name] = Place(origin, rotation)
        return found

    def legs(self) -> tuple[Mechanism, ...]:
        """Split the spanning tree at the base into one tree for each leg."""
        arm: dict[str, str] = {}
        for link, joint in self._held:
            arm[link.name] = arm.get(joint.parent, link.name)
        base, *moving = self.links
        return tuple(
            replace(self, links=(base, *(link for link in moving if arm[link.name] == name)))
            for name in dict.fromkeys(arm.values())
        )


def _rotation(axis: Vector, angle: FloatArray) -> FloatArray:
    """Compute rotation matrices (..., 3, 3) by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sin, cos = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    turned: FloatArray = np.eye(3) + sin * cross + (1 - cos) * cross @ cross
    return turned
