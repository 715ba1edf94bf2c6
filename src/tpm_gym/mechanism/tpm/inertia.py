"""Sixteen constants of the TPM's bodies for :mod:`tpm_gym.mechanism.tpm.dynamics`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.namespaces import Numbers
from tpm_gym.mechanism.inertia import Bodies, Swing, X, Y, Z, three


class Inertia(NamedTuple):
    """Constants of the dynamics.

    The constants a and b of a bar are defined in :mod:`tpm_gym.mechanism.inertia`. b is called the
    coupling constant: it couples the velocities of the bar's two ends in the kinetic energy.

    Attributes:
        motors: For each leg, moment of inertia about the motor's axis, kg m^2. It is the sum for
            the arm and for masses at B_i: the constants a of the rods, and the masses of the
            crosses (leg 1) or of end link 9 (leg 3).
        weights: For each leg, mass at B_i minus the leg's entry of ``couples``, kg.
        couples: For each leg, sum of the coupling constants of its rods B_iC_i, kg.
        link3: Mass at C1, kg.
        link7: Coupling constant of link 7, kg.
        platform: Mass at P, kg.
        swing1: Inertia of the swing of leg 1, about x.
        swing3: Inertia of the swing of leg 3, about y.
    """

    motors: Triple
    weights: Triple
    couples: Triple
    link3: Numbers
    link7: Numbers
    platform: Numbers
    swing1: Swing
    swing3: Swing


def inertia_of(bodies: Bodies, geometry: Geometry) -> Inertia:
    """Compute the constants from the bodies of :func:`tpm_gym.mechanism.tpm.bodies.build`.

    Raises:
        ConfigurationError: If the formulas do not hold for a body.
    """
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
        platform=translating + far[2] + link7[2],
        swing1=Swing(crosses[0][1] + crosses[1][1], spin4),
        swing3=Swing(end9[1], spin11),
    )
    bodies.require_all_known()
    return found
