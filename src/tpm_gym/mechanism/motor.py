"""The motors: what torque, size, inertia and speed of one belong together.

A direct drive has no gear, so its torque is what the magnetic shear stress in its air gap gives,

    T = 2 pi r^2 L sigma,

r being the gap's radius, L the length of the iron; frameless torque motors peak at a sigma of 30 to
60 kPa, and hold 10 to 20 kPa without a fan. The gap's radius then fixes the rotor: a ring of iron
with magnets on it, whose inertia an arm cannot ignore.

Speed has its price in voltage: with the motor constant K (N m per root of a watt lost in the
winding), a torque T at a speed w takes as much voltage as T = K^2 (w0 - w), where w0, the no-load
speed, takes all that there is. So the peak torque is there up to w0 - T / K^2, the corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Solid

__all__ = ["TORQUE_MOTOR", "Motor"]

_FACE = 0.002  # m

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Motor:
    """A frameless torque motor in two equal halves on one shaft, either side of what it turns.

    Attributes:
        peak_torque: Of both halves together, for seconds, N m.
        continuous_torque: For ever, N m.
        motor_constant: N m/sqrt(W).
        no_load_speed: Where the amplifier's voltage leaves no torque, rad/s.
        gap_radius: Of the air gap, m.
        length: Of the iron of both halves together, m.
        ring: Thickness of the rotor's ring, iron and magnets, m.
        stator_radius: Of the housing, m.
        end_turns: By how much the winding, and so the housing, sticks out of the iron at each end.
        clearance: Between the middle and the nearer end of each housing, m.
    """

    peak_torque: float
    continuous_torque: float
    motor_constant: float
    no_load_speed: float
    gap_radius: float
    length: float
    ring: float
    stator_radius: float
    end_turns: float
    clearance: float

    @property
    def shear_stress(self) -> float:
        """In the air gap at the peak torque, Pa."""
        return self.peak_torque / (2 * math.pi * self.gap_radius**2 * self.length)

    @property
    def rotor_inertia(self) -> float:
        """Of both rings about the shaft, kg m^2."""
        outer, inner = self.gap_radius, self.gap_radius - self.ring
        return STEEL * math.pi * self.length * (outer**4 - inner**4) / 2

    @property
    def corner_speed(self) -> float:
        """Up to which the peak torque is there, rad/s."""
        return self.no_load_speed - self.peak_torque / self.motor_constant**2

    @property
    def reach(self) -> float:
        """From the middle to the far end of each housing, m."""
        return self.clearance + self.length / 2 + 2 * self.end_turns

    def rotor(self, axis: Axis) -> tuple[Solid, Solid]:
        """The rings, along ``axis`` about the origin; magnets weigh about as much as steel."""
        size = (self.gap_radius, self.length / 2, 0.0)
        bore = (self.gap_radius - self.ring, self.length / 2, 0.0)
        first, second = (
            Solid("cylinder", size, at, STEEL, bore=bore, axis=axis, colour="steel")
            for at in self.halves(axis)
        )
        return first, second

    def stator(self, axis: Axis, centre: Vector) -> tuple[Solid, Solid]:
        """The housings, along ``axis`` about ``centre``; the shaft ends in front of them."""
        size = (self.stator_radius, self.reach - self.clearance - 2 * _FACE, 0.0)
        first, second = (
            Solid("cylinder", size, at, ALUMINIUM, axis=axis, colour="dark")
            for at in self.halves(axis, centre)
        )
        return first, second

    def halves(self, axis: Axis, centre: Vector = (0.0, 0.0, 0.0)) -> tuple[Vector, Vector]:
        """The middles of both halves, m."""
        away = (self.clearance + self.reach) / 2
        x, y, z = (away if name == axis else 0.0 for name in "xyz")
        u, v, w = centre
        return (u + x, v + y, w + z), (u - x, v - y, w - z)


TORQUE_MOTOR = Motor(
    # Experts take 10 N m at most and full reversals 43, so motors at half their strength, the least
    # that may be drawn, still follow. 44 kPa of shear stress, and 18 for ever.
    peak_torque=100.0,
    continuous_torque=40.0,  # 100 W, which 0.17 m^2 of housing give off at 60 K above the room
    motor_constant=4.0,
    no_load_speed=25.0,
    gap_radius=0.060,
    length=0.100,
    ring=0.010,
    stator_radius=0.085,
    end_turns=0.010,
    clearance=0.022,
)
"""The motor of each arm: of the class of frameless torque motors of 170 mm diameter."""
