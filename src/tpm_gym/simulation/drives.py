"""Drives of the motors.

Each engine has its own ideal drive (``None`` here): the motor reaches its reference within a time
step, as far as its effort allows. A :class:`Servo` is the drive of a real axis: stiffness, damping,
feed-forward, and a motor with a torque-speed line.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray, IntArray, is_number
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.randomisation import NOMINAL, Plant, Randomisation
from tpm_gym.simulation.settings import settings_of

if TYPE_CHECKING:
    from tpm_gym.simulation.engine import Path

__all__ = [
    "References",
    "Servo",
    "ServoDrives",
    "drive_of",
    "drives_and_randomisation",
    "require_servo",
]

FEEDFORWARDS = ("none", "gravity", "computed")


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
        feedforward: Torques of the nominal machine that are fed forward: ``"none"``, ``"gravity"``
            (those at rest), or ``"computed"`` (those of the whole motion).

    Raises:
        ConfigurationError: If a value is out of range.
    """

    stiffness: float = 7500.0
    damping: float = 60.0
    feedforward: str = "computed"

    def __post_init__(self) -> None:
        """Reject impossible values."""
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not is_number(value) or not value > 0:
                raise ConfigurationError(name, value, "a positive number")
        if self.feedforward not in FEEDFORWARDS:
            valid = ", ".join(map(repr, FEEDFORWARDS))
            raise ConfigurationError("feedforward", self.feedforward, valid)


def drive_of(value: Any) -> Servo | None:
    """Return the drive of an option: ``"ideal"`` or None, ``"servo"``, a Servo or a mapping.

    Raises:
        ConfigurationError: If the option is another, or a value is out of range.
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
    """Raise if an ideal drive is asked for what only a servo has.

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
    """Return the drive and the randomisation of two options.

    Raises:
        ConfigurationError: If one is not possible, or only a servo has what is randomised.
    """
    servo, drawn = drive_of(drive), settings_of(Randomisation, "randomisation", randomisation)
    require_servo(servo, drawn.servo_stiffness, drawn.joint_friction)
    return servo, drawn


class References(NamedTuple):
    """References of servo drives in the K time steps of a control period, for n robots.

    Attributes:
        theta: (K, n, 3) rad (m for a slide), at the end of each time step.
        theta_dot: (K, n, 3) rad/s.
        torque: (K, n, 3) N m, fed forward in each time step.
    """

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray


class ServoDrives:
    """Servo drives of n machines, in an engine of fixed time steps.

    A real amplifier closes its loops some ten thousand times a second, an engine a few hundred
    times. Computed from the joint positions at the beginning of each time step, the law would
    explode at the stiffness of a real axis. It is therefore taken at the end of the time step
    (backward Euler), which is stable at any stiffness. The acceleration until then follows from the
    machine's inertia M and from the load. The load is the last time step's torque minus M times
    its acceleration. So the static stiffness is the stated one against any force, and motion is
    that of a spring and a damper under backward Euler, which damps ``stiffness`` x ``time_step``
    more than the stated damping.

    Args:
        servo: The law.
        machine: The nominal machine.
        count: Number of machines, n.
        time_step: s.

    Attributes:
        memory: (2, n, 3), the torques (N m) of the last time step and the joint velocities (rad/s)
            at its beginning.
        friction: (n, 3) N m, Coulomb friction of the motors' axes.
        law: Parameters of :func:`tpm_gym.simulation.compiled.servo_torques`, from :meth:`begin`.

    Raises:
        ConfigurationError: If a motor of the machine has no torque-speed line.
    """

    def __init__(self, servo: Servo, machine: Machine, count: int, time_step: float) -> None:
        """Start as the nominal drives, with the machines at rest at home."""
        from tpm_gym.simulation import compiled  # imports Numba

        self._step_law, self._braced = compiled.servo_torques, compiled.braced_inverse
        self._servo, self._machine, self._step = servo, machine, time_step
        motors = machine.mechanism.motors
        for motor in motors:
            if not 0 <= motor.corner < motor.speed:
                valid = f"motors whose corner speed is below their speed, unlike {motor}"
                raise ConfigurationError("drive", servo, valid)
        self._line = np.array([(motor.corner, motor.speed) for motor in motors])
        self._nominal_effort = np.array([motor.effort for motor in motors])
        self._home = machine.require_inverse(np.array(machine.home))
        self._built: FloatArray | None = None  # parameters of machines with other lengths
        self._stiffness, self._effort, self.friction = np.zeros((3, count, 3))
        self._lightest = np.ones((count, 1, 1))
        self.memory = np.zeros((2, count, 3))
        rows = np.arange(count)
        self.alter(rows, [NOMINAL] * count)
        self.rest(rows, np.tile(self._home, (count, 1)))

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Become the drives of some plants."""
        lengths = [plant.lengths_of(self._machine) for plant in plants]
        if self._built is None and any(lengths):
            self._built = np.tile(self._machine.built(), (len(self.friction), 1))
        if self._built is not None:
            self._built[rows] = [self._machine.built(own) for own in lengths]
        self._stiffness[rows] = self._servo.stiffness * np.array(
            [p.servo_stiffness for p in plants]
        )
        self._effort[rows] = self._nominal_effort * np.array([p.motor_strength for p in plants])
        self.friction[rows] = [p.joint_friction for p in plants]
        # Too large an inertia would be unstable. M with each link's own factor lies between those
        # with the smallest and the largest factor for all links.
        self._lightest[rows, 0, 0] = [min(p.link_masses, default=1.0) for p in plants]

    def rest(self, rows: IntArray, theta: FloatArray) -> None:
        """Start at rest at ``theta`` (r, 3) rad, with the torques that carry the machines."""
        built = None if self._built is None else self._built[rows]
        self.memory[0, rows] = self._machine.motion(theta, np.zeros_like(theta), built).bias
        self.memory[1, rows] = 0.0

    def references(self, path: Path) -> References:
        """Compute references along a path, and the feed-forward of the nominal machine.

        The feed-forward is computed for the first and the last time step and interpolated: within a
        control period it differs little from a straight line.
        """
        from tpm_gym.simulation import compiled  # imports Numba

        machine, step = path.machine, self._step
        theta = machine.reach(np.concatenate([path.start[:, None], path.points()], axis=1))
        steps = theta.shape[1] - 1
        references = References(*np.empty((3, steps, len(theta), 3)))
        torques = np.zeros((2, len(theta), 3))
        if self._servo.feedforward != "none":
            moving = float(self._servo.feedforward == "computed")
            for k, start in enumerate((0, steps - 1)):
                rates = (theta[:, start + 1] - theta[:, start]) / step
                changes = np.zeros_like(rates)
                if steps > 1:
                    # Across a border of control periods the acceleration jumps to the new one's.
                    here = theta[:, start : start + 3] if k == 0 else theta[:, -3:]
                    changes = np.diff(np.diff(here, axis=1) / step, axis=1)[:, 0] / step
                torques[k] = machine.torque(theta[:, start], moving * rates, moving * changes)
        compiled.along(theta, path.true(theta), torques, step, references)
        return references

    def begin(self, theta: FloatArray) -> None:
        """Compute the inertia at ``theta`` (n, 3) rad, for a control period."""
        still = np.zeros_like(theta)
        mass = self._machine.motion(theta, still, self._built).mass
        lost = np.isnan(mass[:, 0, 0])
        if lost.any():  # a machine of other lengths cannot be there
            home = np.tile(self._home, (int(lost.sum()), 1))
            built = None if self._built is None else self._built[lost]
            mass[lost] = self._machine.motion(home, 0.0 * home, built).mass
        mass *= self._lightest
        stiffness, damping = self._stiffness, self._servo.damping
        inverse = self._braced(mass, stiffness, damping, self._step)
        self.law = stiffness, damping, mass, inverse, self._effort, self._line

    def torque(
        self, references: References, index: int, theta: FloatArray, theta_dot: FloatArray
    ) -> FloatArray:
        """Compute what the motors apply in a time step, (n, 3) N m.

        Args:
            references: For the control period.
            index: Number of the time step in it.
            theta: (n, 3) rad, at the beginning of the time step.
            theta_dot: (n, 3) rad/s.
        """
        self._step_law(index, references, self.law, theta, theta_dot, self._step, self.memory)
        torque: FloatArray = self.memory[0]
        return torque
