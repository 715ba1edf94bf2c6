"""Drives of the motors.

With ideal drives (``None`` here), each motor reaches its reference within a time step, as far as
its largest torque allows; every engine implements ideal drives itself. A :class:`Servo` models the
drive of a real axis: stiffness, damping, feed-forward, and a motor with a torque-speed line.
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

_LARGEST = 1e12  # N m/rad and N m s/rad; far larger ones overflow

FEEDFORWARDS = ("none", "gravity", "computed")


@dataclass(frozen=True)
class Servo:
    """Servo drive on each motor's axis.

    torque = stiffness (theta_ref - theta) + damping (theta_dot_ref - theta_dot) + feed-forward,
    clipped to the motor's torque-speed line.

    The defaults model a good direct drive: bandwidth f = 40 Hz, critically damped, at the inertia
    I = 0.12 kg m^2. The stiffness is I (2 pi f)^2 and the damping 2 I (2 pi f), rounded. I is the
    smallest inertia of the paper's machine in any direction of motion. Along y, next to the
    singularity, the inertia is up to 150 times larger, so motions are slower and less damped.

    Attributes:
        stiffness: Stiffness, N m/rad; at most 1e12.
        damping: Damping, N m s/rad; at most 1e12.
        feedforward: Torques of the nominal machine that are fed forward: ``"none"``, ``"gravity"``
            (torques at rest), or ``"computed"`` (torques of the whole motion).

    Raises:
        ConfigurationError: If a value is out of range.
    """

    stiffness: float = 7500.0
    damping: float = 60.0
    feedforward: str = "computed"

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("stiffness", "damping"):
            value = getattr(self, name)
            if not is_number(value) or not 0 < value <= _LARGEST:
                raise ConfigurationError(name, value, f"a positive number, at most {_LARGEST:g}")
        if self.feedforward not in FEEDFORWARDS:
            valid = ", ".join(map(repr, FEEDFORWARDS))
            raise ConfigurationError("feedforward", self.feedforward, valid)


def drive_of(value: Any) -> Servo | None:
    """Convert ``"ideal"``, None, ``"servo"``, a Servo or a mapping into a drive.

    Raises:
        ConfigurationError: If ``value`` is none of these, or an attribute is out of range.
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
    """Check that stiffness factors and joint friction are neutral if the drives are ideal.

    Raises:
        ConfigurationError: If the drives are ideal and a factor is not 1 or a friction is not 0.
    """
    if drive is not None:
        return
    asked = (("servo_stiffness", servo_stiffness, 1), ("joint_friction", joint_friction, 0))
    for name, values, neutral in asked:
        if np.any(np.not_equal(values, neutral)):
            valid = f"{neutral}, or set drive='servo': ideal drives have no {name}"
            raise ConfigurationError(name, values, valid)


def drives_and_randomisation(drive: Any, randomisation: Any) -> tuple[Servo | None, Randomisation]:
    """Convert the options ``drive`` and ``randomisation``.

    Raises:
        ConfigurationError: If an option is invalid, or the randomisation requires a servo drive.
    """
    servo, drawn = drive_of(drive), settings_of(Randomisation, "randomisation", randomisation)
    require_servo(servo, drawn.servo_stiffness, drawn.joint_friction)
    return servo, drawn


class References(NamedTuple):
    """References of servo drives in the K time steps of a control period, for n robots.

    Attributes:
        theta: (K, n, 3) rad (m for a slide), joint positions that the drives shall reach at the end
            of each time step; true joint positions, without encoder bias.
        theta_dot: (K, n, 3) rad/s, mean joint velocities in each time step.
        torque: (K, n, 3) N m, feed-forward torques in each time step.
    """

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray


class ServoDrives:
    """Servo drives of n robots, in an engine with a fixed time step.

    A real amplifier updates the torque about 10,000 times per second. An engine updates it only a
    few hundred times per second. With the engine's rate and the stiffness of a real axis, a servo
    law that uses the joint positions at the beginning of a time step is unstable. So the law uses
    the predicted joint positions at the end of the time step (backward Euler). This law is stable
    at any stiffness. The prediction uses the inertia M and the load. The load is the torque in the
    last time step minus M times the acceleration in the last time step. Under any load, the static
    stiffness of a drive equals the parameter ``stiffness``. The effective damping is ``damping`` +
    ``stiffness`` x ``time_step``.

    Args:
        servo: Parameters of the servo law.
        machine: Nominal machine.
        count: Number of robots, n.
        time_step: Time step of the engine, s.

    Attributes:
        memory: (2, n, 3), torques (N m) in the last time step, and joint velocities (rad/s) at its
            beginning.
        friction: (n, 3) N m, Coulomb friction of the motors' axes.
        law: Parameters of :func:`tpm_gym.simulation.compiled.servo_torques`, from :meth:`begin`.

    Raises:
        ConfigurationError: If a motor of the machine has no torque-speed line, or the machine may
            pass a parallel singularity.
    """

    def __init__(self, servo: Servo, machine: Machine, count: int, time_step: float) -> None:
        """Initialise the drives with nominal plants, at rest at home."""
        from tpm_gym.simulation import compiled  # imports Numba

        self._loops = compiled
        if machine.mirror_axis is not None:
            valid = f"'ideal': {machine.name!r} passes a plane in which the inertia is infinite"
            raise ConfigurationError("drive", servo, valid)
        self._servo, self._machine, self._step = servo, machine, time_step
        motors = machine.mechanism.motors
        for motor in motors:
            if not 0 <= motor.corner < motor.speed:
                valid = f"motors whose corner speed is below their speed, unlike {motor}"
                raise ConfigurationError("drive", servo, valid)
        self._line = np.array([(motor.corner, motor.speed) for motor in motors])
        self._nominal_effort = np.array([motor.effort for motor in motors])
        self._home = machine.require_inverse(np.array(machine.home))
        self._built: FloatArray | None = None  # machine parameters; None if all are nominal
        self._stiffness, self._effort, self.friction = np.zeros((3, count, 3))
        self._lightest = np.ones((count, 1, 1))
        self.memory = np.zeros((2, count, 3))
        rows = np.arange(count)
        self.alter(rows, [NOMINAL] * count)
        self.rest(rows, np.tile(self._home, (count, 1)))

    def alter(self, rows: IntArray, plants: Sequence[Plant]) -> None:
        """Apply plants to the drives of ``rows``."""
        lengths = [plant.lengths_of(self._machine) for plant in plants]
        if self._built is None and any(lengths):
            self._built = np.tile(self._machine.built(), (len(self.friction), 1))
        if self._built is not None:
            self._built[rows] = [self._machine.built(own) for own in lengths]
        factors = np.array([p.servo_stiffness for p in plants])
        self._stiffness[rows] = self._servo.stiffness * factors
        self._effort[rows] = self._nominal_effort * np.array([p.motor_strength for p in plants])
        self.friction[rows] = [p.joint_friction for p in plants]
        # Too large an inertia makes the law unstable. So M is scaled by the smallest link factor,
        # which gives a lower bound of the true inertia.
        self._lightest[rows, 0, 0] = [min(p.link_masses, default=1.0) for p in plants]

    def rest(self, rows: IntArray, theta: FloatArray) -> None:
        """Reset drives to rest at ``theta`` (r, 3) rad, with the torques that carry the weight."""
        built = None if self._built is None else self._built[rows]
        self.memory[0, rows] = self._machine.motion(theta, np.zeros_like(theta), built).bias
        self.memory[1, rows] = 0.0

    def references(self, path: Path) -> References:
        """Compute references along a path, and the feed-forward torques of the nominal machine.

        The feed-forward is computed for the first and the last time step and interpolated linearly,
        because it is almost linear within a control period.
        """
        theta = path.readings()
        steps = theta.shape[1] - 1
        references = References(*np.empty((3, steps, len(theta), 3)))
        torques = np.zeros((2, len(theta), 3))
        if self._servo.feedforward != "none":
            there, rates, changes = self._loops.ends(theta, self._step)
            moving = float(self._servo.feedforward == "computed")
            torques = path.machine.torque(there, moving * rates, moving * changes)
        self._loops.along(theta, path.true(theta), torques, self._step, references)
        return references

    def begin(self, theta: FloatArray) -> None:
        """Set ``law`` for a control period, with the inertia at ``theta`` (n, 3) rad."""
        still = np.zeros_like(theta)
        mass = self._machine.motion(theta, still, self._built).mass
        lost = np.isnan(mass[:, 0, 0])
        if lost.any():  # a machine with length errors may have no assembly at theta
            home = np.tile(self._home, (int(lost.sum()), 1))
            built = None if self._built is None else self._built[lost]
            mass[lost] = self._machine.motion(home, 0.0 * home, built).mass
        mass *= self._lightest
        stiffness, damping = self._stiffness, self._servo.damping
        inverse = self._loops.braced_inverse(mass, stiffness, damping, self._step)
        self.law = stiffness, damping, mass, inverse, self._effort, self._line

    def torque(
        self, references: References, index: int, theta: FloatArray, theta_dot: FloatArray
    ) -> FloatArray:
        """Compute the torques (n, 3) N m that the motors apply in a time step.

        Args:
            references: References of the control period.
            index: Index of the time step in the control period.
            theta: (n, 3) rad, joint positions at the beginning of the time step.
            theta_dot: (n, 3) rad/s, joint velocities at the beginning of the time step.
        """
        step, memory = self._step, self.memory
        self._loops.servo_torques(index, references, self.law, theta, theta_dot, step, memory)
        torque: FloatArray = self.memory[0]
        return torque
