"""Domain randomisation: differences between the robot of an episode and the nominal machine.

A :class:`Randomisation` defines ranges, and :meth:`Randomisation.draw` draws the :class:`Plant` of
one episode. The controller, the forward kinematics of the observation and the expert use the
nominal machine, as on a real robot.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tpm_gym.arrays import Vector, is_number
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine

Range = tuple[float, float]

# The limits are so wide that trained policies fail within them.
_RANGES: dict[str, Range] = {
    "link_mass": (0.5, 16.0),
    "block_mass": (0.1, 10.0),
    "friction": (0.1, 3.0),
    "motor_strength": (0.05, 1.5),
    "servo_stiffness": (0.01, 4.0),
    "joint_friction": (0.0, 100.0),
}
# With the largest bias and length errors together, every robot can be assembled at home. With
# twice these errors, some robots have no assembly at the joint positions of the encoders.
_SIZES: dict[str, float] = {"encoder_noise": 0.02, "encoder_bias": 1e-3, "length_error": 1e-3}
_LATEST = 5  # control steps
LIMITS: dict[str, Range] = {
    **_RANGES,
    **{name: (0.0, largest) for name, largest in _SIZES.items()},
    "latency": (0.0, _LATEST),
}
"""Smallest and largest value of each attribute of :class:`Randomisation`."""

_SIGNED = ("encoder_bias", "length_errors")
_OF_MOTORS = ("motor_strength", "servo_stiffness", "joint_friction", "encoder_bias")


@dataclass(frozen=True)
class Plant:
    """Differences between the true robot of one episode and the nominal machine.

    Attributes:
        link_masses: Factor of mass and inertia for each moving link, in the order of the
            machine's mechanism; empty if all factors are 1.
        block_mass: Factor of the objects' masses.
        friction: Factor of the objects' friction coefficients, against table and cup.
        motor_strength: Factor of the largest torque of each motor.
        servo_stiffness: Factor of the stiffness of each servo drive.
        joint_friction: Coulomb friction on the axis of each motor, N m.
        encoder_bias: Encoder reading minus true joint position of each motor, rad.
        length_errors: True minus nominal lengths (l1 to l7), m; empty if all errors are zero.

    Raises:
        ConfigurationError: If a value is not finite, a factor or the friction is negative, or an
            attribute with one value for each motor does not have three values.
    """

    link_masses: tuple[float, ...] = ()
    block_mass: float = 1.0
    friction: float = 1.0
    motor_strength: Vector = (1.0, 1.0, 1.0)
    servo_stiffness: Vector = (1.0, 1.0, 1.0)
    joint_friction: Vector = (0.0, 0.0, 0.0)
    encoder_bias: Vector = (0.0, 0.0, 0.0)
    length_errors: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in vars(self).items():
            numbers = value if isinstance(value, tuple) else (value,)
            least = -math.inf if name in _SIGNED else 0.0
            sized = name not in _OF_MOTORS or len(numbers) == 3
            if not sized or not all(is_number(number) and number >= least for number in numbers):
                count = "three " if name in _OF_MOTORS else ""
                zero = "" if name in _SIGNED else ", 0 or more"
                raise ConfigurationError(name, value, f"{count}finite numbers{zero}")

    def lengths_of(self, nominal: Machine) -> tuple[float, ...]:
        """Return the true lengths, m; empty if all lengths are nominal."""
        if not self.length_errors:
            return ()
        lengths = zip(nominal.lengths, self.length_errors, strict=True)
        return tuple(length + error for length, error in lengths)

    def of(self, nominal: Machine) -> Machine:
        """Return the machine with the true lengths."""
        lengths = self.lengths_of(nominal)
        return nominal.with_lengths(lengths) if lengths else nominal


NOMINAL = Plant()
"""Plant without differences from the nominal machine."""


@dataclass(frozen=True)
class Randomisation:
    """Ranges from which the plant of each episode is drawn uniformly.

    A range is (low, high), or one number for a fixed value.

    Attributes:
        link_mass: Factor of mass and inertia, drawn for each moving link; within 0.5 to 16.
        block_mass: Factor of the objects' nominal masses (50 g); within 0.1 to 10.
        friction: Factor of the objects' nominal friction (0.6 on the table); within 0.1 to 3.
        motor_strength: Factor of each motor's nominal largest torque (100 N m); within 0.05 to 1.5.
        servo_stiffness: Factor of each drive's stiffness, at nominal damping; within 0.01 to 4.
            Requires ``drive="servo"``.
        joint_friction: Coulomb friction on each motor's axis, N m; within 0 to 100. Requires
            ``drive="servo"``.
        encoder_noise: Standard deviation of each encoder reading, rad; at most 0.02. The noise of
            a joint velocity is the difference between the noise of two successive readings,
            divided by the control period.
        encoder_bias: Largest bias of each encoder, rad; at most 0.001. The drive follows the
            encoder, so the true joint position has the opposite error.
        latency: Delay of the actions in control steps, at most 5.
        length_error: Largest error of each of l1 to l7, m; at most 0.001. If this value is above 0,
            PyBullet and MuJoCo rebuild the robot at each reset, which makes a reset several times
            slower. PyBullet leaks about 13 kB of memory per rebuild.

    If the plant is not nominal, actions at full speed towards a corner of the region near y = 0
    can move the platform through the singularity. The State reports this. With random actions and
    length errors of 1 mm, this happens in a few out of 100 episodes. Heavy links and weak motors
    make it more frequent.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    link_mass: Range | float = (1.0, 1.0)
    block_mass: Range | float = (1.0, 1.0)
    friction: Range | float = (1.0, 1.0)
    motor_strength: Range | float = (1.0, 1.0)
    servo_stiffness: Range | float = (1.0, 1.0)
    joint_friction: Range | float = (0.0, 0.0)
    encoder_noise: float = 0.0
    encoder_bias: float = 0.0
    latency: int = 0
    length_error: float = 0.0

    def __post_init__(self) -> None:
        """Check the values, and convert single numbers to pairs."""
        for name, (low, high) in _RANGES.items():
            object.__setattr__(self, name, _pair(name, getattr(self, name), low, high))
        for name, largest in _SIZES.items():
            value = getattr(self, name)
            if not is_number(value) or not 0 <= value <= largest:
                raise ConfigurationError(name, value, f"a number from 0 to {largest}")
        if not is_number(self.latency) or self.latency not in range(_LATEST + 1):
            valid = f"a whole number of control steps from 0 to {_LATEST}"
            raise ConfigurationError("latency", self.latency, valid)
        object.__setattr__(self, "latency", int(self.latency))

    def require_fitting(self, machine: Machine) -> None:
        """Raise ConfigurationError if length errors could make a length of a machine negative."""
        shortest = min(machine.lengths, default=1.0)
        if self.length_error > shortest:
            valid = f"at most the shortest length of {machine.name!r}, {shortest:.6g} m"
            raise ConfigurationError("length_error", self.length_error, valid)

    def draw(self, rng: np.random.Generator, machine: Machine) -> Plant:
        """Draw the plant of one episode; attributes that are not randomised do not use ``rng``."""
        if self == _NOTHING:
            return NOMINAL
        one, two, three = self._numbers(rng, "motor_strength", 3)
        biases = _deviations(rng, self.encoder_bias, 3) or (0.0, 0.0, 0.0)
        # New attributes are drawn last, so that equal seeds still draw equal values of the others.
        plant = Plant(
            link_masses=self._numbers(rng, "link_mass", len(machine.mechanism.links) - 1),
            block_mass=self._numbers(rng, "block_mass", 1)[0],
            friction=self._numbers(rng, "friction", 1)[0],
            motor_strength=(one, two, three),
            encoder_bias=(biases[0], biases[1], biases[2]),
            length_errors=_deviations(rng, self.length_error, len(machine.lengths)),
        )
        a, b, c = self._numbers(rng, "servo_stiffness", 3)
        d, e, f = self._numbers(rng, "joint_friction", 3)
        return replace(plant, servo_stiffness=(a, b, c), joint_friction=(d, e, f))

    def told(self, plant: Plant) -> dict[str, Any]:
        """Return the plant and the latency of an episode as entries of ``info``."""
        return {**asdict(plant), "latency": self.latency}

    def _numbers(self, rng: np.random.Generator, name: str, count: int) -> tuple[float, ...]:
        low, high = getattr(self, name)
        return tuple(rng.uniform(low, high, count).tolist()) if high > low else (low,) * count


def _pair(name: str, value: Any, low: float, high: float) -> Range:
    """Convert a number or a pair of numbers to a pair within the limits."""
    pair = (value, value) if is_number(value) else value
    sized = isinstance(pair, (tuple, list, np.ndarray)) and len(pair) == 2
    if sized and all(map(is_number, pair)):
        first, last = float(pair[0]), float(pair[1])
        if low <= first <= last <= high:
            return first, last
    valid = f"a number, or (low, high) with low <= high, within {low} to {high}"
    raise ConfigurationError(name, value, valid)


def _deviations(rng: np.random.Generator, size: float, count: int) -> tuple[float, ...]:
    return tuple(rng.uniform(-size, size, count).tolist()) if size > 0 else ()


_NOTHING = Randomisation()
