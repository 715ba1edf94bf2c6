"""Drives: how motors follow their references.

The ideal drive (``None`` here) is each engine's own: it is where it shall be at the end of a time
step, its motor's effort permitting. A :class:`Servo` is what a real axis has: stiffness, damping, a
feed-forward, and a motor with a torque-speed line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np

from tpm_gym.arrays import FloatArray, Vector, is_number
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.mechanism.bodies import Joint
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.randomisation import NOMINAL, Plant, Randomisation
from tpm_gym.simulation.settings import settings_of

__all__ = [
    "Gains",
    "Memory",
    "Reference",
    "Servo",
    "Servos",
    "drive_of",
    "drives_and_randomisation",
    "follow",
    "limited",
    "references",
    "require_servo",
    "wanted",
]

FEEDFORWARDS = ("none", "gravity", "computed")

_ZERO: Vector = (0.0, 0.0, 0.0)
_UNITS: tuple[Vector, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Reference(NamedTuple):
    """Where the motors shall be at the end of a time step: three floats, or columns (3, n).

    Attributes:
        theta: rad (m for a slide).
        theta_dot: rad/s; zero for the ideal drive, which needs none.
        torque: Fed forward in the time step, N m; zero for the ideal drive.
    """

    theta: Any
    theta_dot: Triple = _ZERO
    torque: Triple = _ZERO


@dataclass(frozen=True)
class Servo:
    """A servo drive on each motor's axis.

    The torque is stiffness x (reference - angle) + damping x (its rate - rate) + feed-forward, and
    not more than the motor has at its speed. The defaults are a good direct drive's: a bandwidth f
    of 40 Hz, critically damped, on I = 0.12 kg m^2, the lightest motion that the paper's machine
    has, I (2 pi f)^2 and 2 I (2 pi f), rounded. Motions along y, next to the singularity, are up to
    150 times as heavy, and that much slower and less damped.

    Attributes:
        stiffness: N m/rad.
        damping: N m s/rad.
        feedforward: What the drives know of the nominal machine: ``"none"``, ``"gravity"`` (the
            torques that carry it at rest), or ``"computed"`` (those of the whole motion).

    Raises:
        ConfigurationError: If a value is out of range.
    """

    stiffness: float = 7500.0
    damping: float = 60.0
    feedforward: str = "computed"

    def __post_init__(self) -> None:
        """Reject what is no servo."""
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not is_number(value) or not value > 0:
                raise ConfigurationError(name, value, "a positive number")
        if self.feedforward not in FEEDFORWARDS:
            valid = ", ".join(map(repr, FEEDFORWARDS))
            raise ConfigurationError("feedforward", self.feedforward, valid)


def drive_of(value: Any) -> Servo | None:
    """The drive that a user names: ``"ideal"`` or None, ``"servo"``, a Servo or a mapping.

    Raises:
        ConfigurationError: If it is none of these, or a value is out of range.
    """
    if value is None or value == "ideal":
        return None
    if value == "servo":
        return Servo()
    if isinstance(value, (Servo, Mapping)):
        return settings_of(Servo, "drive", value)
    names = ", ".join(field.name for field in fields(Servo))
    valid = f"'ideal', 'servo', a Servo, or a mapping with keys among {names}"
    raise ConfigurationError("drive", value, valid)


def require_servo(
    drive: Servo | None,
    servo_stiffness: Sequence[float] | float,
    joint_friction: Sequence[float] | float,
) -> None:
    """Refuse what only a servo has, where the drive is ideal.

    Raises:
        ConfigurationError: If a factor of the stiffness is not 1, or there is friction.
    """
    if drive is not None:
        return
    asked = (("servo_stiffness", servo_stiffness, 1), ("joint_friction", joint_friction, 0))
    for name, values, neutral in asked:
        if np.any(np.not_equal(values, neutral)):
            valid = f"{neutral}, or drive='servo': ideal drives have neither"
            raise ConfigurationError(name, values, valid)


def drives_and_randomisation(drive: Any, randomisation: Any) -> tuple[Servo | None, Randomisation]:
    """The drive and the randomisation that a user names, which fit each other.

    Raises:
        ConfigurationError: If one is none, or only a servo has what is to be randomised.
    """
    servo, drawn = drive_of(drive), settings_of(Randomisation, "randomisation", randomisation)
    require_servo(servo, drawn.servo_stiffness, drawn.joint_friction)
    return servo, drawn


def limited(torque: float, rate: float, effort: float, motor: Joint) -> float:
    """What a motor gives of a torque.

    Up to its corner speed that is ``effort`` at most; driving faster it falls in a straight line to
    nothing at the no-load speed, while braking, the voltage helps.

    Args:
        torque: Wanted, N m.
        rate: rad/s.
        effort: The largest torque, N m.
        motor: Its corner and no-load speeds.
    """
    share = (motor.speed - abs(rate)) / (motor.speed - motor.corner)
    driving = effort * min(1.0, max(0.0, share))
    high, low = (driving, -effort) if rate > 0 else (effort, -driving)
    return min(high, max(low, torque))


def references(
    machine: Any, servo: Servo, start: Any, path: Sequence[Any], time_step: float
) -> list[Reference]:
    """Angles with their rates, and the torques fed forward in each time step.

    Of one machine in plain floats; of many in arrays (3, n), with a path (K, 3, n).

    The torques are those of the first and the last time step, and in between a straight line: in a
    control period, they differ little from it.

    Args:
        machine: The nominal one.
        servo: Whose feed-forward it is.
        start: Angles at the beginning, rad.
        path: Angles at the end of each time step, rad.
        time_step: s.
    """
    points = [start, *path]
    rates = [_slope(now, before, time_step) for before, now in pairwise(points)]
    if servo.feedforward == "none":
        return [Reference(*one) for one in zip(path, rates, strict=True)]
    moving = servo.feedforward == "computed"
    # Across a border of control periods the acceleration jumps: to that of the new one.
    changes = [_slope(now, before, time_step) for before, now in pairwise(rates)] or [_ZERO]
    first, last = (
        machine.torque(theta, *(motion if moving else (_ZERO, _ZERO)))
        for theta, *motion in (
            (points[0], rates[0], changes[0]),
            (points[-2], rates[-1], changes[-1]),
        )
    )
    between: Any = np.linspace(first, last, len(path))
    if between.ndim == 2:
        between = between.tolist()
    return [
        Reference(theta, rate, (a, b, c))
        for theta, rate, (a, b, c) in zip(path, rates, between, strict=True)
    ]


def _slope(now: Triple, before: Triple, time: float) -> Triple:
    a, b, c = now
    d, e, f = before
    return (a - d) / time, (b - e) / time, (c - f) / time


class Memory(NamedTuple):
    """What servo drives remember of the last time step.

    Attributes:
        torque: What the motors applied, N m.
        theta_dot: Their rates at its beginning, rad/s.
    """

    torque: Triple
    theta_dot: Triple


class Servos:
    """The three drives of a machine, in an engine of fixed time steps.

    A real amplifier closes its loops some ten thousand times a second, an engine a few hundred
    times. Computed from the angles at the beginning of each time step, the law would then explode
    at the stiffness of a real axis. It is taken at the end of the time step instead (backward
    Euler), which is stable at any stiffness. To foresee that end, the acceleration follows from
    the machine's inertia M and from the load, which is what the last time step's torque was more
    than M times its acceleration. So the static stiffness is the stated one against any force, and
    motion is that of a spring and a damper that Euler's backward method integrates: it damps
    ``stiffness`` x ``time_step`` more than the stated damping.

    Args:
        servo: The law.
        machine: The one that is driven; its ``torque`` gives M.
        time_step: s.

    Attributes:
        memory: What the next time step depends on besides the motors' angles and rates.

    Raises:
        ConfigurationError: If a motor of the machine has no torque-speed line.
    """

    def __init__(self, servo: Servo, machine: Machine, time_step: float) -> None:
        """Be the nominal drives, the machine at rest at home."""
        self._servo, self._machine, self._step = servo, machine, time_step
        self._motors = machine.mechanism.motors
        for motor in self._motors:
            if not 0 <= motor.corner < motor.speed:
                valid = f"motors whose corner speed is below their speed, unlike {motor}"
                raise ConfigurationError("drive", servo, valid)
        self._home: Vector = tuple(machine.require_inverse(machine.home).tolist())
        self.alter(NOMINAL)
        self.rest(self._home)

    def alter(self, plant: Plant) -> None:
        """Become the drives of ``plant``."""
        strengths = zip(self._motors, plant.motor_strength, strict=True)
        self._effort = [motor.effort * strength for motor, strength in strengths]
        a, b, c = (self._servo.stiffness * factor for factor in plant.servo_stiffness)
        self._stiffness = (a, b, c)
        # Too large an inertia would be unstable; with each link's own factor M is between these.
        self._lightest = min(plant.link_masses, default=1.0)

    def rest(self, theta: Vector) -> None:
        """Start at rest at ``theta`` rad, with what carries the machine there."""
        self.memory = Memory(tuple(self._machine.torque(theta, _ZERO, _ZERO).tolist()), _ZERO)

    def begin(self, theta: Vector) -> None:
        """Take up the inertia at ``theta`` rad, for a control period."""
        mass = self._inertia(theta)
        if np.isnan(mass).any():  # not this machine, if its lengths are off
            mass = self._inertia(self._home)
        stiffness, damping, step = np.array(self._stiffness), self._servo.damping, self._step
        inverse = np.linalg.inv(mass + np.diag(step * (step * stiffness + damping)))
        self._gains = Gains(self._stiffness, damping, mass.tolist(), inverse.tolist(), step)

    def _inertia(self, theta: Vector) -> FloatArray:
        """(3, 3) kg m^2, at least as light as the true machine."""
        torque = self._machine.torque
        weight = torque(theta, _ZERO, _ZERO)
        columns = [torque(theta, _ZERO, unit) - weight for unit in _UNITS]
        return self._lightest * np.array(columns)

    def torque(self, reference: Reference, theta: Vector, theta_dot: Vector) -> Vector:
        """What the motors apply in a time step, N m, from angles and rates at its beginning."""
        asked = wanted(self._gains, self.memory, reference, theta, theta_dot)
        one, two, three = map(limited, asked, theta_dot, self._effort, self._motors)
        self.memory = Memory((one, two, three), theta_dot)
        return self.memory.torque


class Gains(NamedTuple):
    """What the law of servo drives multiplies by, in a control period.

    Attributes:
        stiffness: N m/rad.
        damping: N m s/rad.
        mass: (3, 3) kg m^2, the inertia that the drives believe in.
        inverse: Of mass + ``step`` x (``step`` x stiffness + damping).
        step: The time step, s.
    """

    stiffness: Triple
    damping: float
    mass: Sequence[Any]
    inverse: Sequence[Any]
    step: float


def wanted(
    gains: Gains, memory: Memory, reference: Reference, theta: Triple, theta_dot: Triple
) -> Triple:
    """The law of :class:`Servos`: torques, N m, before the motors' limits.

    In plain floats, or in arrays of one for each machine.
    """
    step, damping = gains.step, gains.damping
    before, rates = memory
    load = _minus(before, _times(gains.mass, _slope(theta_dot, rates, step)))
    motion = zip(
        gains.stiffness, reference.theta, reference.theta_dot, theta, theta_dot, strict=True
    )
    a, b, c = (
        stiffness * (wanted - angle - step * rate) + damping * (wanted_rate - rate)
        for stiffness, wanted, wanted_rate, angle, rate in motion
    )
    d, e, f = _minus(reference.torque, load)
    x, y, z = _times(gains.mass, _times(gains.inverse, (a + d, b + e, c + f)))
    u, v, w = load
    return u + x, v + y, w + z


class Driven(Protocol):
    """An engine's robot with three motors."""

    def motors(self) -> tuple[Vector, Vector, Vector]:
        """Angles (rad), rates (rad/s) and torques (N m)."""

    def drive(self, theta: Vector) -> None:
        """Let ideal motors go to ``theta`` rad in the next time step."""

    def apply(self, torque: Vector) -> None:
        """Let the motors apply ``torque`` N m in the next time step."""


def follow(robot: Driven, servos: Servos | None, reference: Reference) -> None:
    """Let a robot's motors follow a reference in the next time step; without servos, ideally."""
    if servos is None:
        robot.drive(reference.theta)
    else:
        theta, theta_dot, _ = robot.motors()
        robot.apply(servos.torque(reference, theta, theta_dot))


def _minus(left: Triple, right: Triple) -> Triple:
    (a, b, c), (d, e, f) = left, right
    return a - d, b - e, c - f


def _times(matrix: Sequence[Any], column: Triple) -> Triple:
    (a, b, c), (d, e, f), (g, h, i) = matrix
    x, y, z = column
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z
