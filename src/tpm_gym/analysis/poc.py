"""POC sets (position and orientation characteristics) and the counts of Eqs. (1) to (5).

A POC set is a pair of subspaces of R^3 for the motion of a link relative to the base: the span of
its directions of translation, and the span of its axes of rotation. The union of two sets is the
span of their subspaces, and the intersection is the subspace common to them. Translations and
rotations are treated separately, as in the columns [t; r] of the paper. A revolute joint with axis
s through a point p contributes r(|| s). It also contributes t along s x (o' - p), unless the axis
passes through the base point o' of the end link.

Subspaces replace the paper's symbols for directions. Choose the base point so that no element of a
set depends on the others: the paper writes dependent elements in braces, and this module cannot
mark them. The sets are exact for chains that translate and rotate independently, as all chains of
this mechanism do. The sets describe one configuration. The dimensions in the paper hold for all
configurations except singularities, where the dimension of a set can be different.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, finite, finite_points, numbers
from tpm_gym.errors import InputError

# Directions closer than this (sine of the angle) are equal, and shorter vectors are zero. The value
# is far above rounding errors, and far below all values away from a singularity.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Subspace:
    """Subspace of R^3 with an orthonormal ``basis`` (dimension, 3)."""

    basis: FloatArray

    @classmethod
    def span(cls, vectors: ArrayLike) -> Subspace:
        """Return the span of ``vectors`` (n, 3); their lengths do not matter, and may be zero.

        Raises:
            InputError: The shape is wrong, or an entry is not finite.
        """
        rows = numbers("vectors", vectors)
        rows = finite_points("vectors", rows if rows.size else rows.reshape(0, 3))
        if rows.ndim != 2:
            raise InputError("shape of vectors", rows.shape, "(n, 3)")
        lengths = np.hypot.reduce(rows, axis=1)  # without overflow
        rows = rows[lengths > _SAME] / lengths[lengths > _SAME, None]
        _, values, right = np.linalg.svd(rows)
        return cls(right[: int((values > _SAME).sum())])

    @property
    def dim(self) -> int:
        """Dimension, 0 to 3."""
        return len(self.basis)

    @property
    def projector(self) -> FloatArray:
        """Orthogonal projection (3, 3) onto the subspace; equal for equal subspaces."""
        result: FloatArray = self.basis.T @ self.basis
        return result

    @property
    def complement(self) -> Subspace:
        """Subspace of all vectors perpendicular to this one."""
        return Subspace(np.linalg.svd(self.basis)[2][self.dim :])

    def __or__(self, other: Subspace) -> Subspace:
        """Return the union in the sense of POC theory: the span of both subspaces."""
        return Subspace.span(np.concatenate([self.basis, other.basis]))

    def __and__(self, other: Subspace) -> Subspace:
        """Return the intersection: the complement of the union of the complements."""
        return (self.complement | other.complement).complement


@dataclass(frozen=True, eq=False)
class POCSet:
    """Directions of translation and axes of rotation of a link, the column [t; r] of the paper."""

    translations: Subspace
    rotations: Subspace

    @property
    def dim(self) -> int:
        """Number of elements, dim{...} of Eq. (3b): 0 to 6."""
        return self.translations.dim + self.rotations.dim

    def __or__(self, other: POCSet) -> POCSet:
        """Return the union, the rule of Eq. (1)."""
        return POCSet(self.translations | other.translations, self.rotations | other.rotations)

    def __and__(self, other: POCSet) -> POCSet:
        """Return the intersection, the rule of Eq. (2)."""
        return POCSet(self.translations & other.translations, self.rotations & other.rotations)

    def __str__(self) -> str:
        """Return the paper's notation without directions, for example ``t^3 r^0``."""
        return f"t^{self.translations.dim} r^{self.rotations.dim}"


@dataclass(frozen=True, eq=False)
class Unit:
    """Joint, or parallelogram that serves as a joint, at one configuration.

    Attributes:
        name: Name in the paper.
        point: (3,) m, common point of all axes of rotation.
        translations: (n, 3) directions in which this point can move.
        rotations: (n, 3) axes.
    """

    name: str
    point: FloatArray
    translations: FloatArray
    rotations: FloatArray
    actuated: bool = False

    @property
    def freedoms(self) -> int:
        """Degrees of freedom f_i of Eq. (3a)."""
        return len(self.translations) + len(self.rotations)

    def poc(self, base_point: ArrayLike) -> POCSet:
        """Return the POC set of this unit, M_Ji of Eq. (1).

        ``base_point`` (3,) m is the base point of the chain's end link.
        """
        arm = finite("base_point", base_point, (3,)) - self.point
        carried = np.concatenate([self.translations, np.cross(self.rotations, arm)])
        return POCSet(Subspace.span(carried), Subspace.span(self.rotations))


def revolute(name: str, axis: FloatArray, point: FloatArray, actuated: bool = False) -> Unit:
    """Return a revolute joint R with ``axis`` (3,) through ``point`` (3,) m."""
    return Unit(name, point, np.empty((0, 3)), axis[None], actuated)


def prismatic(name: str, axis: FloatArray, point: FloatArray, actuated: bool = False) -> Unit:
    """Return a prismatic joint P with ``axis`` (3,) through ``point`` (3,) m."""
    return Unit(name, point, axis[None], np.empty((0, 3)), actuated)


def parallelogram_4s(name: str, short: FloatArray, rod: FloatArray, point: FloatArray) -> Unit:
    """Return a parallelogram of four spherical pairs, the paper's P^(4S) P^(4S) R^(4S) R^(4S).

    The short links are parallel to ``short`` (3,), the rods to ``rod`` (3,). ``point`` (3,) m is
    the middle of the short link at the far end of the rods. This short link cannot translate along
    ``rod``, nor rotate about the normal of ``short`` and ``rod``.
    """
    normal = np.cross(short, rod)
    translations = np.stack([normal, np.cross(rod, normal)])
    return Unit(name, point, translations, np.stack([short, rod]))


def parallelogram_4r(name: str, short: FloatArray, rod: FloatArray, point: FloatArray) -> Unit:
    """Return a parallelogram of four revolutes, P^(4R); arguments as in :func:`parallelogram_4s`.

    The short link at the far end of the rods translates in the plane of the parallelogram,
    perpendicular to the rods. The paper writes t^1(|| R32), a translation along the short links.
    The paper's direction is exact only if the rods are perpendicular to the short links.
    """
    return Unit(name, point, np.cross(rod, np.cross(short, rod))[None], np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Chain:
    """Units in series."""

    name: str
    units: tuple[Unit, ...]

    @property
    def freedoms(self) -> int:
        """Sum of the degrees of freedom f_i of the units."""
        return sum(unit.freedoms for unit in self.units)

    @property
    def actuated(self) -> int:
        """Number of motors, I_j of Eq. (4)."""
        return sum(unit.actuated for unit in self.units)

    def poc(self, base_point: ArrayLike) -> POCSet:
        """Return the POC set of the chain, Eq. (1).

        ``base_point`` (3,) m is the base point of the chain's end link.
        """
        return serial([unit.poc(base_point) for unit in self.units])


def serial(sets: Sequence[POCSet]) -> POCSet:
    """Return the POC set of a serial chain: the union of one or more sets, Eq. (1)."""
    if not sets:
        raise InputError("sets", sets, "at least one POC set")
    return reduce(POCSet.__or__, sets)


def parallel(sets: Sequence[POCSet]) -> POCSet:
    """Return the POC set of a link at the end of one or more chains, Eq. (2).

    The set is the intersection of ``sets``, the POC sets of the chains.
    """
    if not sets:
        raise InputError("sets", sets, "at least one POC set")
    return reduce(POCSet.__and__, sets)


def coupling_degrees(decompositions: Sequence[Sequence[int]]) -> tuple[float, ...]:
    """Return the coupling degree kappa of each Assur kinematic chain (AKC), Eq. (5).

    An AKC is a series of successive loops. It ends with the first loop at which the constraint
    degrees of its loops add up to zero; the next loop begins another AKC.

    Args:
        decompositions: Constraint degrees Delta_j of the loops, for each decomposition. The
            decomposition with the smallest sum of |Delta_j| is used.

    Raises:
        InputError: There is no decomposition, or the constraint degrees of the decomposition that
            is used do not add up to zero.
    """
    best = min(decompositions, key=lambda deltas: sum(abs(delta) for delta in deltas), default=())
    found, run = [], list[int]()
    for delta in best:
        run.append(delta)
        if sum(run) == 0:
            found.append(sum(abs(d) for d in run) / 2)
            run = []
    if run or not found:
        raise InputError("decompositions", decompositions, "constraint degrees that add up to 0")
    return tuple(found)


@dataclass(frozen=True)
class Loop:
    """Independent loop, closed by one single open chain (SOC).

    Attributes:
        chains: Names of the chains that form the SOC.
        freedoms: Sum of the degrees of freedom f_i of the units in the SOC.
        actuated: Number of motors, I_j.
        equations: Number of independent equations, xi_Lj.
    """

    chains: tuple[str, ...]
    freedoms: int
    actuated: int
    equations: int

    @property
    def constraint(self) -> int:
        """Constraint degree, Delta_j = sum of f_i - I_j - xi_Lj.

        It is the second of the paper's two equations with the number (4).
        """
        return self.freedoms - self.actuated - self.equations


@dataclass(frozen=True, eq=False)
class ParallelMechanism:
    """Structure of a parallel mechanism, from :func:`analyse`.

    Attributes:
        platform: POC set of the platform.
        decompositions: Independent loops for each order of the chains, the given order first.
    """

    platform: POCSet
    decompositions: tuple[tuple[Loop, ...], ...]

    @property
    def loops(self) -> tuple[Loop, ...]:
        """Loops of the first decomposition."""
        return self.decompositions[0]

    @property
    def coupling(self) -> tuple[float, ...]:
        """Coupling degree kappa of each Assur kinematic chain, Eq. (5).

        Raises:
            InputError: The numbers of motors and freedoms differ, as at a constraint singularity.
        """
        return coupling_degrees([[x.constraint for x in loops] for loops in self.decompositions])

    def dof(self, loops: int | None = None) -> int:
        """Return the degrees of freedom F = sum f_i - sum xi_Lj, Eq. (3a).

        ``loops`` is the number of loops in the sums, counted from the first; None for all loops.
        """
        return sum(loop.freedoms - loop.equations for loop in self.loops[:loops])


def analyse(chains: Sequence[Chain], point: ArrayLike) -> ParallelMechanism:
    """Apply Eqs. (1) to (5) to two or more chains from the base to one platform.

    The chains are at one configuration. ``point`` (3,) m is the base point of the platform.

    Raises:
        InputError: There are fewer than two chains.
    """
    if len(chains) < 2:
        raise InputError("chains", len(chains), "two chains or more, by number")
    platform = parallel([chain.poc(point) for chain in chains])
    return ParallelMechanism(platform, decompositions(chains, point))


def decompositions(chains: Sequence[Chain], point: ArrayLike) -> tuple[tuple[Loop, ...], ...]:
    """Return the independent loops, for each order in which the chains can be joined.

    POC sets are about ``point`` (3,) m, the base point of the platform.
    """
    return tuple(_loops(order) for order in permutations([(c, c.poc(point)) for c in chains]))


def _loops(order: tuple[tuple[Chain, POCSet], ...]) -> tuple[Loop, ...]:
    """Return the loops formed by adding the chains in order; the first loop has two chains."""
    chains, sets = zip(*order, strict=True)
    loops = []
    for j in range(1, len(order)):
        added = chains[: j + 1] if j == 1 else chains[j : j + 1]
        names = tuple(chain.name for chain in added)
        freedoms = sum(chain.freedoms for chain in added)
        actuated = sum(chain.actuated for chain in added)
        # Eq. (3b): xi_Lj = dim{(intersection of the j previous chains) union chain j + 1}
        equations = (parallel(sets[:j]) | sets[j]).dim
        loops.append(Loop(names, freedoms, actuated, equations))
    return tuple(loops)
