"""What an environment is built for: a translational robot with closed-form kinematics, as a value.

A :class:`Machine` is asked only what any such robot can answer, so that another one (a Delta, a
gantry) stands under the same tasks: forward and inverse kinematics, the Jacobian, whether it is
still in its modes, where it may go, and the bodies to load.

Everything is in the machine's own frame, which its :class:`~tpm_gym.mechanism.mount.Mount` places
in the world; for the TPM that is the paper's. Joint positions theta are in rad (m for a slide).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, Vector, finite, vector
from tpm_gym.errors import (
    ConfigurationError,
    JointLimitError,
    SingularityError,
    UnreachableError,
)
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import virtual_work
from tpm_gym.mechanism.batch import Batch
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import Mount

__all__ = ["Machine", "Mode", "Reading", "find_machine", "register_machine"]

Mode = Literal["assembly", "working"]
Rows = tuple[Vector, Vector, Vector]

_ATTEMPTS = 1000
_MANY = 32  # points from which on arrays are faster than floats, one by one


class Reading(NamedTuple):
    """What follows from joint positions.

    Attributes:
        position: Point P, m.
        jacobian: Rows of J with v = J theta_dot, m/rad.
        conditioning: 1/cond(J), in [0, 1].
    """

    position: Vector
    jacobian: Rows
    conditioning: float


@dataclass(frozen=True, kw_only=True)
class Machine(ABC):
    """A translational robot with three motors over a table.

    Attributes:
        name: What the machine is called in messages.
        mount: Where its frame is in the world.
        region: Where the environments let point P go, a box in the machine's frame, m.
        goal_region: Where point P has to go to reach a goal, or an object on the table, in it; cut
            by ``safe_conditioning`` when sampled.
        home: Where point P is at the start of an episode, machine's frame, m.
        step_limit: Largest change of the command for P along x, y, z in one control step, m.
        joint_limit: Largest change of a joint's command in one control step, rad (m for a slide).
        safe_conditioning: Conditioning 1/cond(J) from which on the machine counts as safe from
            singularities; the penalty of the reward begins below it.
        table: Half edges of the table along x and y, m; its top is the world's z = 0.

    Raises:
        ConfigurationError: If a value cannot be, home or the goals lie outside the region, or the
            region reaches beyond a singularity, a motor's stop or, by more than the stroke of the
            cup, the table.
        UnreachableError: If a corner of the region cannot be reached.
    """

    name: str
    mount: Mount
    region: Region
    goal_region: Region
    home: Vector
    step_limit: Vector = (0.030, 0.030, 0.030)
    joint_limit: float = 0.08
    safe_conditioning: float = 0.08
    table: tuple[float, float] = (0.45, 0.30)

    def __post_init__(self) -> None:
        """Reject machines on which no episode could run."""
        self._require_values()
        for name, point in (
            ("home", self.home),
            ("goal_region", self.goal_region.low),
            ("goal_region", self.goal_region.high),
        ):
            if not self.region.contains(point):
                raise ConfigurationError(name, point, f"inside the region, {self.region}")
        limits = {
            "step_limit": self.step_limit,
            "joint_limit": (self.joint_limit,),
            "table": self.table,
        }
        for name, values in limits.items():
            if not min(values) > 0:
                raise ConfigurationError(name, getattr(self, name), "positive")
        if not 0 < self.safe_conditioning <= 1:  # the penalty is in units of it
            raise ConfigurationError("safe_conditioning", self.safe_conditioning, "in (0, 1]")
        for corner in self.region.corners():
            self._require_usable("region", corner)
        self._require_usable("home", self.home)
        least = self.region.high[2] + CUP.length - CUP.stroke
        if self.mount.height < least - 1e-6:
            valid = f"a height of {least:.6g} m or more: else the region is below the table"
            raise ConfigurationError("mount", self.mount, valid)

    def _require_values(self) -> None:
        """Refuse values of other types, and what is no finite number; arrays become tuples."""
        for name, kind in (("mount", Mount), ("region", Region), ("goal_region", Region)):
            if not isinstance(getattr(self, name), kind):
                raise ConfigurationError(name, getattr(self, name), f"a {kind.__name__}")
        for name in ("home", "step_limit"):
            object.__setattr__(self, name, vector(name, getattr(self, name), ConfigurationError))
        for name in ("joint_limit", "safe_conditioning"):
            finite(name, getattr(self, name), (), ConfigurationError)
        table = finite("table", self.table, (2,), ConfigurationError)
        object.__setattr__(self, "table", tuple(table.tolist()))

    def _require_usable(self, name: str, point: Vector) -> None:
        """Refuse the option of that name if P cannot be worked with at ``point``."""
        try:
            theta = self.inverse(point)
        except UnreachableError as error:
            error.hint = f"the machine's {name} has to lie within reach of its legs; choose another"
            raise
        if (mode := self.mode_left(theta, point)) is not None:
            valid = f"in one {mode} mode; {point} is beyond a singularity"
            raise ConfigurationError(name, getattr(self, name), valid)
        try:
            self.require_within_stops(theta)
        except JointLimitError as error:
            valid = f"where every motor is between its stops; at {point}, {error}"
            raise ConfigurationError(name, getattr(self, name), valid) from error

    # -- kinematics -------------------------------------------------------------------------

    @abstractmethod
    def inverse(self, point: Vector) -> Vector:
        """Joint positions at which P is at ``point``, on the machine's working mode.

        Raises:
            UnreachableError: If there are none.
        """

    @abstractmethod
    def evaluate(self, theta: Vector) -> Reading:
        """Point P, J and conditioning at ``theta``, on the machine's assembly mode.

        Raises:
            UnreachableError: If the machine cannot be assembled there.
            SingularityError: If theta is a parallel singularity.
        """

    def forward(self, theta: Vector) -> Vector:
        """Point P at ``theta``, in the machine's modes.

        Raises:
            UnreachableError: If the machine cannot be assembled there, or only in other modes.
        """
        position = self.evaluate(theta).position
        if (mode := self.mode_left(theta, position)) is not None:
            hint = "choose joint positions in the machine's modes"
            raise UnreachableError(theta, f"{mode} mode", 0.0, hint)
        return position

    def mode_left(self, theta: Vector, position: Vector) -> Mode | None:
        """The mode that a machine has left whose joints are at ``theta`` and P at ``position``.

        ``"assembly"`` where it passed a parallel singularity, so that the forward kinematics no
        longer say where P is; ``"working"`` where it passed a serial one, and the inverse
        kinematics no longer say how to get where. A machine without singularities leaves none.
        """
        del theta, position
        return None

    def require_within_stops(self, theta: Vector) -> None:
        """Refuse joint positions beyond a motor's stop.

        Raises:
            JointLimitError: If there is one.
        """
        mechanism = self.mechanism
        for index, (lower, upper) in enumerate(mechanism.stops):
            if not lower <= theta[index] <= upper:
                motor = mechanism.motors[index]
                raise JointLimitError(motor.name, theta[index], lower, upper, motor.unit)

    # -- regions ----------------------------------------------------------------------------

    def conditioning_at(self, points: ArrayLike) -> FloatArray:
        """Conditioning 1/cond(J) at points (..., 3) m, as (...,); 0 where P cannot be."""
        return _each(lambda point: self.evaluate(self.inverse(point)).conditioning, points)

    def conditioning(self, theta: ArrayLike) -> FloatArray:
        """Conditioning 1/cond(J) at joint positions (..., 3); 0 where it cannot be assembled."""
        return _each(lambda one: self.evaluate(one).conditioning, theta)

    def is_safe(self, point: Vector) -> bool:
        """Whether P can be at ``point``, with :attr:`safe_conditioning` or better."""
        with suppress(UnreachableError, SingularityError):
            return self.evaluate(self.inverse(point)).conditioning >= self.safe_conditioning
        return False

    def sample(self, rng: np.random.Generator, region: Region) -> FloatArray:
        """Draw a point (3,) m, uniform over the part of ``region`` that is safe.

        Raises:
            ConfigurationError: If no draw was safe.
        """
        point: FloatArray = self.sample_each([rng], [region])[0]
        return point

    def sample_each(
        self, rngs: Sequence[np.random.Generator], regions: Sequence[Region]
    ) -> FloatArray:
        """The same for r generators and regions, (r, 3) m; this is what tasks ask."""
        low, high = (np.array([getattr(r, end) for r in regions]) for end in ("low", "high"))
        points, rows = np.empty_like(low), np.arange(len(rngs))
        for _ in range(_ATTEMPTS):
            drawn = np.array([rngs[row].random(3) for row in rows.tolist()])
            points[rows] = low[rows] + (high[rows] - low[rows]) * drawn
            rows = rows[~self._are_safe(points[rows])]
            if not len(rows):
                return points
        valid = f"a value that some point of {regions[rows[0]]} reaches"
        raise ConfigurationError("safe_conditioning", self.safe_conditioning, valid)

    def _are_safe(self, points: FloatArray) -> BoolArray:
        """Whether P can safely be at points (r, 3)."""
        if len(points) < _MANY:
            return np.array([self.is_safe((x, y, z)) for x, y, z in points.tolist()])
        safe: BoolArray = self.conditioning_at(points) >= self.safe_conditioning
        return safe

    # -- bodies -----------------------------------------------------------------------------

    @cached_property
    @abstractmethod
    def mechanism(self) -> Mechanism:
        """Links, joints and closures, for an engine to load."""

    @abstractmethod
    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """Positions of all joints of :attr:`mechanism` at which its loops close, rad or m.

        Raises:
            UnreachableError: If it cannot be assembled at theta.
        """

    def torque(self, theta: Vector, theta_dot: Vector, theta_ddot: Vector) -> Vector:
        """Torques of the motors for a motion of the empty machine, N m (N for a slide).

        From the bodies, by differences, which takes milliseconds; a machine with a closed form
        overrides it.

        Raises:
            UnreachableError: If it cannot be assembled at theta.
            SingularityError: If theta is a parallel singularity.
        """
        fall = self.mount.free_fall
        motion = theta, theta_dot, theta_ddot
        return virtual_work.torque(self.mechanism, self.joint_positions, fall, *motion)

    @property
    def lengths(self) -> tuple[float, ...]:
        """The lengths, m, in which a machine that was built may differ from its drawing."""
        return ()

    def with_lengths(self, lengths: tuple[float, ...]) -> Machine:
        """The machine with other lengths (m, in the order of :attr:`lengths`)."""
        if lengths:
            raise ConfigurationError("length_error", lengths, f"0: {self.name} has no lengths")
        return self

    def batch(self, count: int) -> Batch:
        """So many of these machines, for an engine that computes all of them at a time.

        Raises:
            ConfigurationError: If the machine has no closed form for arrays.
        """
        del count
        valid = f"another one: {self.name!r} has no closed form for arrays (Machine.batch)"
        raise ConfigurationError("engine", "analytic", valid)

    def occupied(self, position: ArrayLike) -> list[tuple[FloatArray, FloatArray]]:
        """Boxes around platform and tool with P at ``position``: low and high corners, m, world."""
        platform = np.asarray(position, dtype=np.float64) - self.mechanism.point_p
        boxes = []
        for name in (self.mechanism.platform, self.mechanism.tool):
            link = self.mechanism.link(name)
            slides = link.joint is not None and link.joint.parent == self.mechanism.platform
            origin = platform + link.joint.origin if link.joint and slides else platform
            for solid in link.solids:
                centre = self.mount.to_world(origin + np.asarray(solid.centre))
                boxes.append((centre - solid.half_extent, centre + solid.half_extent))
        return boxes


def _each(function: Callable[[Vector], float], vectors: ArrayLike) -> FloatArray:
    """A function of vectors (..., 3), one by one, as (...,); 0 where there is no solution."""
    array = np.asarray(vectors, dtype=np.float64)
    values = np.zeros(array.shape[:-1])
    for index in np.ndindex(values.shape):
        with suppress(UnreachableError, SingularityError):
            a, b, c = array[index].tolist()
            values[index] = function((a, b, c))
    return values


_MACHINES: dict[str, Machine | Callable[[], Machine]] = {}


def register_machine(name: str, machine: Machine | Callable[[], Machine]) -> None:
    """Let environments be made with ``machine=name``; a callable is called when first asked for.

    Raises:
        ConfigurationError: If the name is none, or taken by another machine, or that is no machine.
    """
    if not isinstance(name, str) or not name:
        raise ConfigurationError("name", name, "a name")
    if not isinstance(machine, Machine) and not callable(machine):
        raise ConfigurationError("machine", machine, "a tpm_gym.Machine, or what makes one")
    if _MACHINES.get(name, machine) != machine:
        raise ConfigurationError("machine", name, f"a name other than {', '.join(_MACHINES)}")
    _MACHINES[name] = machine


def find_machine(machine: Any) -> Machine:
    """A machine by its name, or the machine itself.

    Raises:
        ConfigurationError: If there is none of that name, or it is no machine.
    """
    found = _MACHINES.get(machine) if isinstance(machine, str) else machine
    if isinstance(machine, str) and callable(found):
        found = found()
    if not isinstance(found, Machine):
        valid = f"{', '.join(map(repr, _MACHINES))}, or a tpm_gym.Machine"
        if isinstance(machine, Geometry):
            valid += ", such as dataclasses.replace(tpm_gym.PAPER_TPM, geometry=...)"
        raise ConfigurationError("machine", machine, valid)
    return found
