"""Constants of bodies for closed-form dynamics.

A rigid bar from B to C has the kinetic energy of two coupled points:

    T = (a |vB|^2 + 2 b vB . vC + c |vC|^2) / 2,
    a = m (1 - s)^2 + I / l^2,  b = m s (1 - s) - I / l^2,  c = m s^2 + I / l^2.

Here m is the mass of the bar, l is its length, and s * l is the distance from B to the centre of
mass. I is the moment of inertia about an axis through the centre of mass, perpendicular to the bar.

Arms and rods are such bars; one end of an arm is fixed. A body that only translates is a mass at
the point with which it moves. Some bodies swing with their rods, and some rods also turn about
their own axes; see :class:`Swing`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import Numbers
from tpm_gym.mechanism.bodies import Link, Mechanism

X, Y, Z = range(3)
_ROUNDING = 1e-9  # of a centre of mass, m; of two equal moments, relative


class Swing(NamedTuple):
    """Part of a leg's inertia that the bars of the leg (see the module) do not include.

    The swing is the rotation of the rods in the plane of the arm. This part of the inertia has the
    kinetic energy T = ``(fixed + spin * out**2) * rate**2 / 2``. ``rate`` is the angular velocity
    of the swing, rad/s, and ``out`` is the component of BC along the axis of the swing, m.

    Attributes:
        fixed: Moment of inertia about the axis of the swing, kg m^2.
        spin: Moment of inertia of the rods about their own axes, divided by l4^2, kg.
    """

    fixed: Numbers
    spin: Numbers


def swing_force(rod: Triple, rates: Triple, changes: tuple[Numbers, Numbers], m: Swing) -> Triple:
    """Compute the force at C, N, that accelerates the swing of a leg; the force at B is opposite.

    The force follows from Lagrange's equation for the kinetic energy of :class:`Swing`.

    Args:
        rod: Components (out, level, z) of BC, m. ``out`` is along the axis of the swing, level and
            z are perpendicular to the axis. The angle of the swing is the direction of (level, z).
        rates: Derivatives of ``rod`` by time, m/s.
        changes: Second derivatives of level and z by time, m/s^2.
        m: Inertia of the swing.
    """
    (out, level, z), (out_rate, level_rate, z_rate), (level_change, z_change) = rod, rates, changes
    over = 1.0 / (level * level + z * z)
    rate = (level * z_rate - z * level_rate) * over
    change = level * z_change - z * level_change - 2 * rate * (level * level_rate + z * z_rate)
    moment = (m.fixed + m.spin * out * out) * change * over + 2 * m.spin * out * out_rate * rate
    force = moment * over
    return -m.spin * out * rate * rate, -z * force, level * force


class Bodies:
    """Moving links by name, with factors of their mass and inertia.

    ``known`` has the names of the links whose mass or inertia a method has read.
    """

    def __init__(self, mechanism: Mechanism, factors: Sequence[float]) -> None:
        """Store one factor of mass and inertia for each moving link; 1 if ``factors`` is empty.

        Raises:
            ConfigurationError: If the number of factors is wrong.
        """
        moving = mechanism.links[1:]
        if len(factors) not in (0, len(moving)):
            valid = f"one factor for each of the {len(moving)} moving links, or none"
            raise ConfigurationError("link_masses", tuple(factors), valid)
        self._links = {link.name: link for link in moving}
        self.factors = dict(zip(self._links, factors or [1.0] * len(moving), strict=True))
        self.known: set[str] = set()

    def require_all_known(self) -> None:
        """Refuse a mechanism with a moving link that no constant of the dynamics includes.

        A link counts as included if a method such as :meth:`mass` was called for it.
        """
        left = [name for name, link in self._links.items() if link.mass and name not in self.known]
        if left:
            raise ConfigurationError(
                "mechanism", left, "the links of the mechanism's builder alone"
            )

    def mass(self, name: str) -> float:
        """Return the mass, kg."""
        return self.factors[name] * self._link(name).mass

    def moment(self, name: str, axis: int) -> float:
        """Return the moment of inertia about an axis through the centre of mass, kg m^2."""
        return self.factors[name] * float(self._link(name).inertia[axis, axis])

    def shaft(self, name: str, axis: int) -> tuple[float, float]:
        """Return mass (kg) and moment of inertia (kg m^2) of a body about ``axis`` of its frame.

        Raises:
            ConfigurationError: If its centre of mass is not on this axis.
        """
        self._require_on_axis(name, [k for k in (X, Y, Z) if k != axis])
        return self.mass(name), self.moment(name, axis)

    def bar(self, name: str, along: int, about: int, length: float) -> FloatArray:
        """Compute a, b, c (kg, see the module) of a bar that turns only about axis ``about``."""
        self._require_on_axis(name, [k for k in (X, Y, Z) if k not in (along, about)])
        share = float(self._link(name).centre_of_mass[along]) / length
        mass, turning = self.mass(name), self.moment(name, about) / length**2
        near, far = mass * (1 - share) ** 2 + turning, mass * share**2 + turning
        return np.array([near, mass * share * (1 - share) - turning, far])

    def round_bar(self, name: str, along: int, length: float) -> FloatArray:
        """Compute a, b, c (kg, see the module) of a round bar, which may turn about any axis."""
        one, other = (k for k in (X, Y, Z) if k != along)
        self._require_on_axis(name, [one, other])
        moments = self._link(name).inertia
        expected = np.diag([moments[k, k] if k == along else moments[one, one] for k in (X, Y, Z)])
        if not np.allclose(moments, expected, rtol=_ROUNDING, atol=_ROUNDING * moments[one, one]):
            raise ConfigurationError("mechanism", name, "a rod with equal moments across its axis")
        return self.bar(name, along, one, length)

    def _require_on_axis(self, name: str, axes: list[int]) -> None:
        centre = self._link(name).centre_of_mass
        if np.abs(centre[axes]).max() > _ROUNDING:
            valid = f"a link with its centre of mass, now {centre.tolist()} m, on its axis"
            raise ConfigurationError("mechanism", name, valid)

    def _link(self, name: str) -> Link:
        self.known.add(name)
        return self._links[name]


def three(values: Iterable[float]) -> tuple[float, float, float]:
    """Return three numbers as a tuple."""
    one, two, three = values
    return one, two, three
