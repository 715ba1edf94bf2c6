"""Machines: translational robots with closed-form kinematics, as frozen dataclasses.

A :class:`Machine` has forward and inverse kinematics, the Jacobian, modes, dynamics, regions, and
the bodies that engines load. So other robots (a Delta, a gantry) can do the same tasks.

Arrays (..., 3) have one robot per row, and (x, y, z) or the three joints along the last axis.
Everything is in SI units and in the machine's own frame; its
:class:`~tpm_gym.mechanism.mount.Mount` places this frame in the world. Joint positions theta are in
rad (m for a slide). Results are NaN in rows without a solution.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, Vector, explained, finite, numbers, points, vector
from tpm_gym.errors import ConfigurationError, JointLimitError, SingularityError, UnreachableError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import virtual_work
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.closures import require_sound
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.inertia import Bodies
from tpm_gym.mechanism.mount import Mount

MODES: Final = (None, "assembly", "working")
"""Names of the modes that :meth:`Machine.mode_left` returns as 0, 1 and 2."""

SAME_PLACE: Final = 1e-6
"""Largest distance between positions that count as equal, m; far below the distance between the
assembly modes at a safe conditioning."""


class Reading(NamedTuple):
    """Position, Jacobian and modes at joint positions.

    Attributes:
        position: Point P (..., 3) m; NaN where the machine cannot be assembled or is singular.
        jacobian: J (..., 3, 3) with v = J theta_dot, m/rad.
        conditioning: 1/cond(J), (...,) in [0, 1].
        working: (...,) whether the machine is in its working mode.
    """

    position: FloatArray
    jacobian: FloatArray
    conditioning: FloatArray
    working: BoolArray


class Motion(NamedTuple):
    """Position, Jacobian and equation of motion: torque = mass theta_ddot + bias.

    The first three attributes are explained in :class:`Reading`.

    Attributes:
        mass: Mass matrix at the motors' axes, (..., 3, 3) kg m^2.
        bias: Torques for weight and velocities, (..., 3) N m.
    """

    position: FloatArray
    jacobian: FloatArray
    working: BoolArray
    mass: FloatArray
    bias: FloatArray


@dataclass(frozen=True, kw_only=True)
class Machine(ABC):
    """Translational robot with three motors over a table.

    Attributes:
        name: Name of the machine in messages.
        mount: Mount of the machine's frame in the world.
        region: Box in which environments keep point P, machine's frame, m.
        goal_region: Box of positions of P for goals, and for objects on the table. Positions with
            a conditioning below ``safe_conditioning`` are not sampled.
        home: Position of P at the start of an episode, machine's frame, m.
        step_limit: Largest change of the command for P along x, y, z in 40 ms, m. If a reversal at
            this speed needs more than the motors' peak torques (``State.torque`` shows them), P
            leaves its path, and no shield can prevent this.
        joint_limit: Largest change of a joint's command in 40 ms, rad (m for a slide).
        safe_conditioning: Smallest conditioning 1/cond(J) that counts as safe from singularities;
            the penalty of the reward begins below it.
        table: Half edges of the table along x and y, m; the table top is at z = 0 in the world.
        payload: Mass that a gripper holds at point P, kg; :attr:`mechanism` contains it.
        mirror_axis: Axis (0, 1, 2) normal to a plane of symmetry through the origin. This plane is
            a parallel singularity, which P may pass; the machine then is in the mirror image of its
            assembly mode. None for a machine that has to stay in its assembly mode.

    Raises:
        ConfigurationError: If a value is not possible, if home or the goals lie outside the region,
            if the region reaches beyond a singularity or a motor's stop, if it reaches below the
            table by more than the cup's stroke, or if the loops of the mechanism do not close at
            home.
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
    payload: float = 0.0

    mirror_axis: ClassVar[int | None] = None

    def __post_init__(self) -> None:
        """Reject machines on which no episode could run."""
        self._require_values()
        goals = self.goal_region
        inside = ("home", self.home), ("goal_region", goals.low), ("goal_region", goals.high)
        for name, point in inside:
            if not self.region.contains(point):
                raise ConfigurationError(name, point, f"inside the region, {self.region}")
        for name in ("step_limit", "joint_limit", "table"):
            if not np.min(getattr(self, name)) > 0:
                raise ConfigurationError(name, getattr(self, name), "positive")
        if not 0 < self.safe_conditioning <= 1:  # the penalty is in units of it
            raise ConfigurationError("safe_conditioning", self.safe_conditioning, "in (0, 1]")
        if self.payload < 0:
            raise ConfigurationError("payload", self.payload, "0 kg or more")
        self._require_usable("region", list(self.region.corners()))
        home = self._require_usable("home", [self.home])
        a, b, c = home[0].tolist()
        require_sound(self.mechanism, self.joint_positions((a, b, c)))
        least = self.region.high[2] + CUP.length - CUP.stroke
        if self.mount.height < least - 1e-6:
            valid = f"a height of {least:.6g} m or more: else the region is below the table"
            raise ConfigurationError("mount", self.mount, valid)

    def _require_values(self) -> None:
        """Reject wrong types, and numbers that are not finite; convert arrays to tuples."""
        for name, kind in (("mount", Mount), ("region", Region), ("goal_region", Region)):
            if not isinstance(getattr(self, name), kind):
                raise ConfigurationError(name, getattr(self, name), f"a {kind.__name__}")
        for name in ("home", "step_limit"):
            object.__setattr__(self, name, vector(name, getattr(self, name), ConfigurationError))
        for name in ("joint_limit", "safe_conditioning", "payload"):
            finite(name, getattr(self, name), (), ConfigurationError)
        table = finite("table", self.table, (2,), ConfigurationError)
        object.__setattr__(self, "table", tuple(table.tolist()))

    def _require_usable(self, name: str, points: list[Vector]) -> FloatArray:
        """Return joint positions (k, 3) for points (k, 3) of the attribute ``name``.

        Raises:
            UnreachableError: If a point is out of reach.
            ConfigurationError: If a point is beyond a singularity or a motor's stop.
        """
        try:
            theta, left = self._postures(np.array(points))
        except UnreachableError as error:
            error.hint = f"the machine's {name} has to lie within reach of its legs; choose another"
            error.index = ()  # the caller gave no array of points
            raise
        for point, one, mode in zip(points, theta, left.tolist(), strict=True):
            if mode:
                valid = f"in one {MODES[mode]} mode; {point} is beyond a singularity"
                raise ConfigurationError(name, getattr(self, name), valid)
            try:
                self.require_within_stops(one)
            except JointLimitError as error:
                valid = f"where every motor is between its stops; at {point}, {error}"
                raise ConfigurationError(name, getattr(self, name), valid) from error
        return theta

    def _postures(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.int8]]:
        """Return joint positions (k, 3) at points (k, 3), and :meth:`mode_left` there, (k,)."""
        theta = self.require_inverse(points)
        return theta, self.mode_left(theta, points)

    # -- kinematics -------------------------------------------------------------------------

    @abstractmethod
    def inverse(self, position: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """Compute joint positions (..., 3) for P at ``position``, in the machine's working mode.

        Args:
            position: Point P (..., 3) m.
            built: Parameters (b, k) of b machines from :meth:`built`; None for the nominal machine.
                Of n points, point i belongs to machine ``built[i // (n // b)]``. For b machines
                with q points each, pass points (b, q, 3).
        """

    @abstractmethod
    def evaluate(self, theta: ArrayLike, built: FloatArray | None = None) -> Reading:
        """Compute P, J and conditioning at ``theta`` (..., 3), in the machine's assembly mode."""

    def forward(self, theta: ArrayLike, built: FloatArray | None = None) -> FloatArray:
        """Compute P (..., 3) m at ``theta`` (..., 3), in the machine's assembly mode.

        The result is NaN where the machine is not in its working mode or cannot be assembled.
        """
        position = self.evaluate(theta, built).position
        left = self.mode_left(theta, position, built)
        return np.where(left[..., None], np.nan, position)

    def mode_left(
        self, theta: ArrayLike, position: ArrayLike, built: FloatArray | None = None
    ) -> NDArray[np.int8]:
        """Find the mode that a machine has left, from its joint positions and the position of P.

        Returns:
            Code (...,): 0 if the machine left no mode, 1 if it left the assembly mode, 2 if it left
            the working mode. A machine leaves the assembly mode when it passes a parallel
            singularity; from then on, the forward kinematics do not give P. It leaves the working
            mode when it passes a serial singularity; from then on, the inverse kinematics do not
            give its joint positions.
        """
        del theta, built
        return np.zeros(np.shape(position)[:-1], dtype=np.int8)

    def same_side(self, position: ArrayLike) -> BoolArray:
        """Return whether P at ``position`` (..., 3) m is on the assembly mode's side, as (...,).

        The parallel singularities divide the workspace into sides.
        """
        return np.ones(np.shape(position)[:-1], dtype=np.bool_)

    def mirrored(self) -> Machine:
        """Return the machine with its home and its assembly mode mirrored.

        The mirror is the plane of symmetry normal to ``mirror_axis``.
        """
        raise NotImplementedError(f"{self.name}: mirror_axis is None")

    def unreachable(self, position: Vector) -> UnreachableError:
        """Explain why :meth:`inverse` has no solution at a position (3,) m."""
        return UnreachableError(position, self.name, 0.0, "choose a point of its workspace")

    def unassembled(self, theta: Vector) -> UnreachableError | SingularityError:
        """Explain why :meth:`evaluate` or :meth:`forward` has no solution at ``theta`` (3,)."""
        return UnreachableError(theta, self.name, 0.0, "choose joint positions in its modes")

    def require_inverse(self, position: ArrayLike) -> FloatArray:
        """Compute joint positions like :meth:`inverse`; raise an error if some do not exist.

        Raises:
            UnreachableError: If a position is out of reach.
        """
        theta = self.inverse(position)
        if np.isnan(theta).any():
            raise explained(self.unreachable, np.asarray(position), np.isnan(theta[..., 0]))
        return theta

    def require_evaluate(self, theta: ArrayLike, built: FloatArray | None = None) -> Reading:
        """Compute P, J and conditioning like :meth:`evaluate`; raise an error if some do not exist.

        Raises:
            UnreachableError: If the machine cannot be assembled.
            SingularityError: If the machine is at a parallel singularity.
        """
        reading = self.evaluate(theta, built)
        if np.isnan(reading.conditioning).any():
            raise explained(self.unassembled, np.asarray(theta), np.isnan(reading.conditioning))
        return reading

    def require_within_stops(self, theta: ArrayLike) -> None:
        """Refuse joint positions (..., 3) beyond a motor's stop.

        Raises:
            JointLimitError: If a joint position is beyond a stop.
        """
        theta = points("theta", numbers("theta", theta))
        lower, upper = self.stops
        within = (theta >= lower) & (theta <= upper)
        if not within.all():
            index = int(np.argwhere(~within)[0, -1])
            motor, position = self.mechanism.motors[index], theta[~within][0]
            ends = float(lower[index]), float(upper[index])
            raise JointLimitError(motor.name, float(position), *ends, motor.unit)

    def reach(self, position: ArrayLike) -> FloatArray:
        """Compute joint positions like :meth:`inverse`; raise JointLimitError beyond a stop.

        Raises:
            UnreachableError: If a position is out of reach.
            JointLimitError: If a motor is beyond a stop at a position.
        """
        theta = self.require_inverse(position)
        self.require_within_stops(theta)
        return theta

    @cached_property
    def stops(self) -> FloatArray:
        """Lowest and highest joint positions, (2, 3)."""
        stops: FloatArray = np.array(self.mechanism.stops).T.copy()  # rows in one piece
        return stops

    # -- regions ----------------------------------------------------------------------------

    def conditioning_at(self, position: ArrayLike) -> FloatArray:
        """Compute 1/cond(J) (...,) with P at ``position`` (..., 3) m; 0 where P cannot go.

        The result is also 0 where the machine would have to be in another assembly mode.
        """
        found, _, conditioning, _ = self.evaluate(self.inverse(position))
        there = np.abs(np.subtract(found, position)).max(axis=-1) < SAME_PLACE
        return np.where(there, conditioning, 0.0)

    def conditioning(self, theta: ArrayLike) -> FloatArray:
        """Compute 1/cond(J) (...,) at ``theta`` (..., 3); 0 where :meth:`evaluate` returns NaN."""
        found = self.evaluate(theta).conditioning
        return np.where(np.isnan(found), 0.0, found)

    # -- bodies -----------------------------------------------------------------------------

    @cached_property
    @abstractmethod
    def mechanism(self) -> Mechanism:
        """Links, joints and closures, which engines load."""

    @abstractmethod
    def joint_positions(self, theta: Vector) -> dict[str, float]:
        """Compute the positions of all joints of :attr:`mechanism` from the motors' positions (3,).

        Returns:
            Name of the joint -> rad or m.

        Raises:
            UnreachableError: If the machine cannot be assembled at theta.
        """

    def torque(
        self,
        theta: ArrayLike,
        theta_dot: ArrayLike,
        theta_ddot: ArrayLike,
        force: ArrayLike | None = None,
        built: FloatArray | None = None,
    ) -> FloatArray:
        """Compute the motors' torques (..., 3) N m (N for a slide) for a motion.

        The base class computes the torques from the bodies by finite differences, which takes
        milliseconds for each row.

        Args:
            theta: Joint positions (..., 3) rad (m for a slide).
            theta_dot: Joint velocities (..., 3) rad/s (m/s for a slide).
            theta_ddot: Joint accelerations (..., 3) rad/s^2 (m/s^2 for a slide).
            force: Force (..., 3) N that acts on P, in the machine's frame; None for no force. The
                torques balance this force.
            built: Parameters of the machines, as for :meth:`inverse`.
        """
        motion = np.stack(np.broadcast_arrays(theta, theta_dot, theta_ddot), axis=-2, dtype=float)
        rows = motion.reshape(-1, 3, 3)
        factors = np.ones((1, len(self.mechanism.links) - 1)) if built is None else built
        factors = np.repeat(factors, len(rows) // len(factors), axis=0)
        found = np.full((len(rows), 3), np.nan)
        for row, (one, masses) in enumerate(zip(rows, factors, strict=True)):
            with suppress(UnreachableError, SingularityError):
                found[row] = virtual_work.torque(
                    self.mechanism, self.joint_positions, self.mount.free_fall, masses, *one
                )
        torques = found.reshape(motion.shape[:-1])
        if force is not None:
            jacobian = self.evaluate(theta, built).jacobian
            torques -= (jacobian * np.asarray(force)[..., None]).sum(axis=-2)
        return torques

    def motion(
        self, theta: ArrayLike, theta_dot: ArrayLike, built: FloatArray | None = None
    ) -> Motion:
        """Compute P, J and the equation of motion at ``theta`` and ``theta_dot`` (..., 3)."""
        position, jacobian, _, working = self.evaluate(theta, built)
        still = np.zeros_like(position)
        rest = self.torque(theta, still, still, None, built)
        columns = [self.torque(theta, still, still + unit, None, built) for unit in np.eye(3)]
        bias = self.torque(theta, theta_dot, still, None, built)
        mass = np.stack([column - rest for column in columns], axis=-1)
        return Motion(position, jacobian, working, mass, bias)

    @property
    def lengths(self) -> tuple[float, ...]:
        """Lengths, m, that can differ between a built machine and the nominal one."""
        return ()

    def with_lengths(self, lengths: tuple[float, ...]) -> Machine:
        """Return the machine with other lengths (m, in the order of :attr:`lengths`)."""
        if lengths:
            raise ConfigurationError("length_error", lengths, f"0: {self.name} has no lengths")
        return self

    def built(
        self, lengths: tuple[float, ...] = (), link_masses: tuple[float, ...] = ()
    ) -> FloatArray:
        """Return the parameters (k,) of one machine as it was built.

        Args:
            lengths: Lengths of the machine, m, in the order of :attr:`lengths`; empty for the
                nominal lengths.
            link_masses: Factors of mass and inertia of the moving links; empty if all are 1.

        Raises:
            ConfigurationError: If the number of factors is wrong.
        """
        bodies = Bodies(self.with_lengths(lengths).mechanism, link_masses)
        return np.array([*bodies.factors.values()])

    def occupied(self, position: ArrayLike) -> list[tuple[FloatArray, FloatArray]]:
        """Compute a box around each solid of platform and cup: low and high corner, m, world frame.

        ``position`` is point P (3,) m, machine's frame.
        """
        a, b, c = self.require_inverse(vector("position", position)).tolist()
        places = self.mechanism.places(self.joint_positions((a, b, c)))
        boxes = []
        for name in (self.mechanism.platform, self.mechanism.tool):
            for solid in self.mechanism.link(name).solids:
                centre = self.mount.to_world(places[name].point(solid.centre))
                boxes.append((centre - solid.half_extent, centre + solid.half_extent))
        return boxes


_MACHINES: dict[str, Machine | Callable[[], Machine]] = {}
_MADE: dict[str, tuple[Any, Machine]] = {}  # callables of registered machines, and their results


def register_machine(name: str, machine: Machine | Callable[[], Machine]) -> None:
    """Make a machine available as ``machine=name``; a callable is called at the first use.

    A second call with an equal machine changes nothing. If a notebook defines a class or a function
    again, a machine of the new class, or the new function, replaces the old one.

    Raises:
        ConfigurationError: If the name is empty or taken by another machine, or if the value is no
            machine.
    """
    if not isinstance(name, str) or not name:
        raise ConfigurationError("name", name, "a name")
    if not isinstance(machine, Machine) and not callable(machine):
        raise ConfigurationError("machine", machine, "a tpm_gym.Machine, or what makes one")
    old = _MACHINES.get(name)
    if old is None or _defined_again(old, machine):
        _MACHINES[name] = machine
    elif old != machine:
        raise ConfigurationError("machine", name, f"a name other than {', '.join(_MACHINES)}")


def _defined_again(old: Any, new: Any) -> bool:
    """Return whether a class or callable was defined a second time, under its old name.

    For machines, their classes are compared. The module has to be the same, too.
    """
    kinds = [type(value) if isinstance(value, Machine) else value for value in (old, new)]
    first, second = (getattr(kind, "__qualname__", None) for kind in kinds)
    same = first == second is not None and kinds[0].__module__ == kinds[1].__module__
    return same and kinds[0] is not kinds[1]


def machine_names() -> tuple[str, ...]:
    """Return the names of all registered machines."""
    return tuple(_MACHINES)


def registered_name(machine: Machine) -> str | None:
    """Return the first name under which an equal machine is registered; None if there is none."""
    return next((name for name in _MACHINES if find_machine(name) == machine), None)


def find_machine(machine: Any) -> Machine:
    """Return a machine by its name, or the machine itself.

    Raises:
        ConfigurationError: If no machine has this name, or the value is no machine.
    """
    found = _MACHINES.get(machine) if isinstance(machine, str) else machine
    if isinstance(machine, str) and callable(make := found):
        maker, found = _MADE.get(machine, (None, None))
        if maker is not make:
            found = make()
            if isinstance(found, Machine):
                _MADE[machine] = make, found
    if not isinstance(found, Machine):
        valid = f"{', '.join(map(repr, _MACHINES))}, or a tpm_gym.Machine"
        if isinstance(machine, Geometry):
            valid += ", such as dataclasses.replace(tpm_gym.PAPER_TPM, geometry=...)"
        raise ConfigurationError("machine", machine, valid)
    return found
