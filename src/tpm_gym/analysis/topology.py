"""Topology of the mechanism, and its mobility from the rank of its loop closures.

Two independent counts of the degrees of freedom start from the axes of the joints:

* :func:`analyse` applies Eqs. (1) to (5) to branches I, II, III and the pair R12, R13.
* :func:`mobility` computes the rank of the closure Jacobian. It uses the mechanism that PyBullet
  and MuJoCo load, with all rods and ball joints of the parallelograms.

The counts agree at singularities too. If z_C1 = z_B1, both counts are 4 instantaneous freedoms,
because link 3' can begin to turn about y. Vectors are in the paper's frame. Functions of joint
angles take three finite numbers and raise InputError for anything else. They raise UnreachableError
if the assembly mode does not exist at these angles.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.analysis import poc
from tpm_gym.analysis.poc import Chain, POCSet, Subspace, Unit
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, AssemblyMode
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.closures import closure_jacobian, moving_joints, rank_of, rates
from tpm_gym.mechanism.tpm.bodies import ACTUATED_JOINTS, build, joint_angles


@dataclass(frozen=True, eq=False)
class Structure:
    """Mechanism as in the paper's topology section, at one configuration.

    Attributes:
        branches: Branches I, II (base to link 3') and III (base to platform 1).
        wrist: R12 and R13, from link 3' to platform 1.
        link_3p: (3,) m, base point C1 of link 3'.
        platform: (3,) m, base point E1 of platform 1. It lies on the axis of R13, so that no
            element of a POC set depends on the others.
    """

    branches: tuple[Chain, Chain, Chain]
    wrist: Chain
    link_3p: FloatArray
    platform: FloatArray

    @property
    def chains(self) -> tuple[Chain, Chain, Chain]:
        """Chains from the base to link 3'.

        The first two are branches I and II. The third is branch III, followed by R13 and R12.
        """
        first, second, third = self.branches
        return first, second, Chain("III, wrist", (*third.units, *self.wrist.units[::-1]))


def describe(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Structure:
    """Describe the mechanism at theta (3,) rad, with the names of the paper."""
    mechanism = build(geometry)
    places = mechanism.places(joint_angles(theta, branch, geometry))
    axes = {
        joint.name: (places[link.name], joint.axis)
        for link in mechanism.links
        if (joint := link.joint)
    }
    ends = {c.name: places[c.link_b].point(c.point_b) for c in mechanism.closures}

    def turning(*names: str) -> tuple[Unit, ...]:
        found = []
        for name in names:
            (origin, rotation), axis = axes[name]
            found.append(poc.revolute(name, rotation @ axis, origin, name in ACTUATED_JOINTS))
        return tuple(found)

    def sides(near: str, far: str, other: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return vectors along short link and rod of a parallelogram, and a point, (3,) m each.

        The point is the middle of the short link at the far end of the rods. This short link's
        vector is from ``other`` to ``far``, the rod's vector from ``near`` to ``far``.
        """
        foot = axes[near][0].origin
        return ends[far] - ends[other], ends[far] - foot, (ends[far] + ends[other]) / 2

    four_s = poc.parallelogram_4s("Pa(4S)", *sides("Sa_swing", "Sc", "Sd"))
    four_r = poc.parallelogram_4r("Pa(4R)", *sides("Re", "Rg", "Rh"))
    return Structure(
        branches=(
            Chain("I", (*turning("R11"), four_s)),
            Chain("II", turning("R21", "R22", "R23")),
            Chain("III", (*turning("R31", "R32"), four_r, *turning("R33"))),
        ),
        wrist=Chain("wrist", turning("R12", "R13")),
        link_3p=four_s.point,
        platform=axes["R13"][0].origin,
    )


@dataclass(frozen=True, eq=False)
class Topology(poc.ParallelMechanism):
    """Result of :func:`analyse`.

    The first entry of ``decompositions`` is the paper's: the first loop consists of branches I and
    II, and branch III with R12 and R13 closes the second loop.

    Attributes:
        sub_mechanism: POC set of link 3' on branches I and II. The paper calls it M_Pa(1-2), in the
            first of its two equations with the number (4).
        hsoc_1: POC set of the platform on branches I and II with R12, R13.
        hsoc_2: POC set of the platform on branch III.
    """

    sub_mechanism: POCSet
    hsoc_1: POCSet
    hsoc_2: POCSet


def analyse(structure: Structure) -> Topology:
    """Apply Eqs. (1) to (5) to the structure at its configuration."""
    first, second, third = structure.chains
    sub_mechanism = poc.parallel([chain.poc(structure.link_3p) for chain in (first, second)])
    # Link 3' does not turn, so its POC set is the same about any point.
    hsoc_1 = poc.serial([sub_mechanism, structure.wrist.poc(structure.platform)])
    hsoc_2 = structure.branches[2].poc(structure.platform)
    platform = poc.parallel([hsoc_1, hsoc_2])
    found = poc.decompositions((first, second, third), structure.link_3p)
    return Topology(platform, found, sub_mechanism, hsoc_1, hsoc_2)


@dataclass(frozen=True, eq=False)
class Mobility:
    """Degrees of freedom from the closure Jacobian.

    Attributes:
        dof: Freedoms that move the platform or a motor.
        idle: Freedoms that move neither. The TPM has one: end link 10 turns about its axis, R33.
        rank: Rank of the closure Jacobian.
        redundant: Number of dependent rows of the closure Jacobian.
        smallest: Smallest singular value that is not zero, as a fraction of the largest.
        platform: POC set of the platform: all directions in which the loops let it move.
    """

    dof: int
    idle: int
    rank: int
    redundant: int
    smallest: float
    platform: POCSet


def mobility(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> Mobility:
    """Count freedoms by the numerical rank of the closure Jacobian, at theta (3,) rad.

    Raises:
        SingularityError: theta is so close to a constraint singularity that the rank is uncertain:
            a singular value is between 1e-11 and 1e-7 of the largest.
    """
    return mobility_at(build(geometry), joint_angles(theta, branch, geometry))


def mobility_at(mechanism: Mechanism, angles: Mapping[str, float]) -> Mobility:
    """Count the freedoms of any mechanism, as :func:`mobility` does for the TPM.

    ``angles`` has the position of each joint by name, rad (m for a slide).
    """
    jacobian = closure_jacobian(mechanism, angles)
    _, values, right = np.linalg.svd(jacobian)
    rank = rank_of(values)
    free = right[rank:].T  # columns: joint rates that keep the loops closed
    places = mechanism.places(angles)
    joints = moving_joints(mechanism)
    linear, angular = rates(mechanism, places, mechanism.platform, mechanism.point_p)
    motors = np.eye(len(joints))[[joints.index(name) for name in mechanism.actuated]]
    seen = np.linalg.svd(np.concatenate([linear, angular, motors]) @ free, compute_uv=False)
    dof = rank_of(seen)
    platform = POCSet(Subspace.span((linear @ free).T), Subspace.span((angular @ free).T))
    smallest = float(values[rank - 1] / values[0])
    return Mobility(dof, free.shape[1] - dof, rank, len(jacobian) - rank, smallest, platform)
