"""Sixteen constants of the bodies for the closed-form dynamics.

A rigid bar from B to C, with mass m, length l, its centre at the share s of its length, and moment
of inertia I across it, has the kinetic energy of two coupled points:

    T = (a |vB|^2 + 2 b vB . vC + c |vC|^2) / 2,
    a = m (1 - s)^2 + I / l^2,  b = m s (1 - s) - I / l^2,  c = m s^2 + I / l^2.

Arms (with a fixed near end), rods and link 7 are such bars. A body that only translates is a mass
at the point with which it moves. The crosses and end link 9 also swing with their rods, and rods 4
and 11 also turn about their own axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.namespaces import Numbers
from tpm_gym.mechanism.bodies import Link, Mechanism

X, Y, Z = range(3)
_ROUNDING = 1e-9  # of a centre of mass, m; of two equal moments, relative


class Swing(NamedTuple):
    """Inertia of a leg's swing without its rods' masses: T = (fixed + spin out^2) rate^2 / 2.

    Here ``out`` is the component of BC along the swing's axis, m.

    Attributes:
        fixed: Moment of inertia about the axis of the swing, kg m^2.
        spin: Moment of inertia of the rods about their own axes, over l4^2, kg.
    """

    fixed: Numbers
    spin: Numbers


class Inertia(NamedTuple):
    """Constants of the dynamics.

    Attributes:
        motors: For each leg, inertia of arm and near ends of rods about the motor, kg m^2.
        weights: For each leg, mass at B_i less ``couples``, kg.
        couples: For each leg, b of the bars B_iC_i, kg.
        link3: Mass at C1, kg.
        link7: b of link 7, kg.
        platform: Mass at P, kg.
        swing1: Swing of leg 1, about the axis x.
        swing3: Swing of leg 3, about the axis y.
    """

    motors: tuple[Numbers, Numbers, Numbers]
    weights: tuple[Numbers, Numbers, Numbers]
    couples: tuple[Numbers, Numbers, Numbers]
    link3: Numbers
    link7: Numbers
    platform: Numbers
    swing1: Swing
    swing3: Swing


def flat(inertia: Inertia) -> list[float]:
    """List the sixteen constants, in the order of the attributes."""
    legs = [*inertia.motors, *inertia.weights, *inertia.couples]
    points = [inertia.link3, inertia.link7, inertia.platform]
    return [*legs, *points, *inertia.swing1, *inertia.swing3]


def inertia_of(
    mechanism: Mechanism,
    geometry: Geometry,
    link_masses: Sequence[float] = (),
    payload: float = 0.0,
) -> Inertia:
    """Compute the constants of a mechanism of :func:`tpm_gym.mechanism.tree.build`.

    Args:
        mechanism: Bodies of the mechanism.
        geometry: Lengths of the mechanism.
        link_masses: Factors of mass and inertia, one for each moving link; empty if all are one.
        payload: Mass that the cup carries, kg.

    Raises:
        ConfigurationError: If the number of factors is wrong, or if the formulas do not hold for a
            body.
    """
    bodies = Bodies(mechanism, link_masses)
    l3, l4, l7 = geometry.l3, geometry.l4, geometry.l7
    turning = ("arm_2", Y, X), ("arm_5", X, Y), ("arm_12", X, Y)
    arms = [bodies.bar(*arm, l3) for arm in turning]
    rods = [
        bodies.round_bar("rod_4a", Y, l4) + bodies.round_bar("rod_4b", Y, l4),
        bodies.bar("rod_6", X, Y, l4),
        bodies.round_bar("rod_11a", X, l4) + bodies.round_bar("rod_11b", X, l4),
    ]
    link7 = bodies.bar("link_7", X, Z, l7)
    crosses = [bodies.shaft(f"cross_4{suffix}", X) for suffix in "ab"]
    end9, end10 = bodies.shaft("end_link_9", Y), bodies.shaft("end_link_10", Y)
    elbows = [crosses[0][0] + crosses[1][0], 0.0, end9[0]]
    translating = bodies.mass("platform") + bodies.mass("cup") + end10[0]
    spin4, spin11 = (
        sum(bodies.moment(f"{rod}{suffix}", along) for suffix in "ab") / l4**2
        for rod, along in (("rod_4", Y), ("rod_11", X))
    )
    _, arm_couple, arm_far = np.transpose(arms)
    near, couple, far = np.transpose(rods)
    found = Inertia(
        motors=three((arm_far + near + elbows) * l3**2),
        weights=three(arm_couple + arm_far + near + elbows),
        couples=three(couple),
        link3=bodies.mass("link_3p") + far[0] + far[1] + link7[0],
        link7=link7[1],
        platform=translating + far[2] + link7[2] + payload,
        swing1=Swing(crosses[0][1] + crosses[1][1], spin4),
        swing3=Swing(end9[1], spin11),
    )
    bodies.require_all_known()
    return found


class Bodies:
    """Links with their factors; keeps the names of the links that were used."""

    def __init__(self, mechanism: Mechanism, factors: Sequence[float]) -> None:
        """Check the number of factors; empty if all are 1."""
        moving = mechanism.links[1:]
        if len(factors) not in (0, len(moving)):
            valid = f"one factor for each of the {len(moving)} moving links, or none"
            raise ConfigurationError("link_masses", tuple(factors), valid)
        self._links = {link.name: link for link in moving}
        self._factors = dict(zip(self._links, factors or [1.0] * len(moving), strict=True))
        self.known: set[str] = set()

    def require_all_known(self) -> None:
        """Refuse a mechanism with a body that was not used."""
        left = [name for name, link in self._links.items() if link.mass and name not in self.known]
        if left:
            raise ConfigurationError(
                "mechanism", left, "the links of the mechanism's builder alone"
            )

    def mass(self, name: str) -> float:
        """Return the mass, kg."""
        return self._factors[name] * self._link(name).mass

    def moment(self, name: str, axis: int) -> float:
        """Return the moment of inertia about an axis through the centre of mass, kg m^2."""
        return self._factors[name] * float(self._link(name).inertia[axis, axis])

    def shaft(self, name: str, axis: int) -> tuple[float, float]:
        """Return mass and moment of inertia of a body about its own axis through its centre."""
        self._require_on_axis(name, [k for k in (X, Y, Z) if k != axis])
        return self.mass(name), self.moment(name, axis)

    def bar(self, name: str, along: int, about: int, length: float) -> FloatArray:
        """Compute a, b and c of a bar that turns in a plane, about an axis across the bar."""
        self._require_on_axis(name, [k for k in (X, Y, Z) if k not in (along, about)])
        share = float(self._link(name).centre_of_mass[along]) / length
        mass, turning = self.mass(name), self.moment(name, about) / length**2
        near, far = mass * (1 - share) ** 2 + turning, mass * share**2 + turning
        return np.array([near, mass * share * (1 - share) - turning, far])

    def round_bar(self, name: str, along: int, length: float) -> FloatArray:
        """Compute a, b and c of a bar that turns in space, and so must be round."""
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
