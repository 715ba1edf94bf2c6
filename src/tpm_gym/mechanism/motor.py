"""Motors whose torque, size, inertia and speed are consistent.

A direct drive has no gear. Its torque follows from the magnetic shear stress sigma in the air gap,

    T = 2 pi r^2 L sigma,

with the gap's radius r and the length L of the iron. Frameless torque motors reach 30 to 60 kPa for
seconds, and 10 to 20 kPa continuously without a fan. The gap's radius determines the size of the
rotor, a ring of iron with magnets. The rotor's inertia is not negligible compared with the arm's.

The voltage of the amplifier limits the speed. The motor constant K is the torque over the square
root of the power that the winding loses as heat, N m/sqrt(W). With K and the no-load speed w0, the
largest torque at a speed w is K^2 (w0 - w). So the peak torque T is available up to the corner
speed, w0 - T / K^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Solid

_FACE = 0.002  # m, by which each end of a housing is shorter than the shaft

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Motor:
    """Frameless torque motor: equal halves on one shaft, one on each side of the arm.

    Attributes:
        peak_torque: Torque that both halves together can apply for seconds, N m.
        continuous_torque: Continuous torque of both halves together, N m.
        motor_constant: Motor constant, N m/sqrt(W).
        no_load_speed: Speed at which the amplifier's voltage allows no torque, rad/s.
        gap_radius: Radius of the air gap, m.
        length: Length of the iron of both halves together, m.
        ring: Thickness of the rotor's ring, iron and magnets, m.
        stator_radius: Radius of the housing, m.
        end_turns: Length of winding and housing beyond the iron at each end, m.
        clearance: Distance from the middle of the motor to the near end of each half, m.
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
    def corner_speed(self) -> float:
        """Highest speed with full peak torque, rad/s."""
        return self.no_load_speed - self.peak_torque / self.motor_constant**2

    @property
    def reach(self) -> float:
        """Distance from the middle of the motor to the far end of each half, m."""
        return self.clearance + self.length / 2 + 2 * self.end_turns

    def rotor(self, axis: Axis) -> list[Solid]:
        """Build the rotor: two rings about ``axis``, one on each side of the origin.

        The magnets are modelled as steel.
        """
        size = (self.gap_radius, self.length / 2, 0.0)
        bore = (self.gap_radius - self.ring, self.length / 2, 0.0)
        return [
            Solid("cylinder", size, at, STEEL, bore=bore, axis=axis, colour="steel")
            for at in self.halves(axis)
        ]

    def stator(self, axis: Axis, centre: Vector) -> list[Solid]:
        """Build the two housings about ``axis``, one on each side of ``centre``.

        The shaft projects beyond the housings.
        """
        size = (self.stator_radius, self.reach - self.clearance - 2 * _FACE, 0.0)
        return [
            Solid("cylinder", size, at, ALUMINIUM, axis=axis, colour="dark")
            for at in self.halves(axis, centre)
        ]

    def halves(self, axis: Axis, centre: Vector = (0.0, 0.0, 0.0)) -> tuple[Vector, Vector]:
        """Return the centres of the motor's two halves, m."""
        away = (self.clearance + self.reach) / 2
        x, y, z = (away if name == axis else 0.0 for name in "xyz")
        u, v, w = centre
        return (u + x, v + y, w + z), (u - x, v - y, w - z)


TORQUE_MOTOR = Motor(
    # Experts need at most 10 N m, and reversals at full speed need 43 N m. So motors with half this
    # peak torque would still follow their references. The shear stress in the air gap is 44 kPa at
    # the peak torque and 18 kPa at the continuous torque.
    peak_torque=100.0,
    continuous_torque=40.0,  # 100 W of heat make the housing (0.17 m^2) 60 K warmer than the room
    motor_constant=4.0,
    no_load_speed=25.0,
    gap_radius=0.060,
    length=0.100,
    ring=0.010,
    stator_radius=0.085,
    end_turns=0.010,
    clearance=0.022,
)
"""Motor of each arm: a frameless torque motor of 170 mm diameter."""
