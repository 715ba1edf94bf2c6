"""POC sets (position and orientation characteristics) and the counts made of them, Eqs. 1 to 5.

How the theory is applied. A POC set is a pair of subspaces of R^3, one spanned by the directions
of translation, one by the axes of rotation, of a link's motion relative to the base. Union is the
span and intersection the common subspace, for translations and rotations apart, as the paper
writes its columns [t; r]; dim is the sum of the two ranks, so every number is a rank. About a base
point o' of the chain's end link, a revolute joint of axis s through a point p contributes r(|| s)
and the translation t along s x (o' - p), perpendicular to the axis; none if the axis passes through
o'. A group of three parallel revolutes thus contributes t^2(perpendicular to s), r^1(|| s).

Where the paper's notation is simplified. A subspace holds all its directions, so the paper's
symbols for them (perpendicular, parallel, in the plane of) are not reproduced, and neither are
braces around dependent elements: choose the base point so that there are none. (The paper writes
t^2 r^1 for R12, R13 alone, three elements of two revolutes; about a base point on one of the two
axes it is t^1 r^1.) Rules by column are exact for a chain that translates and rotates
independently; all chains of this mechanism do, and a test compares them with screw theory.
Directions are those at one configuration: dimensions can change at a singularity, and elsewhere
they are the full-cycle values of the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, finite_points, numbers
from tpm_gym.errors import InputError

# Directions closer than this (sine of the angle) count as one, and vectors shorter than this as
# none: far above rounding, far below anything away from a singularity.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Subspace:
    """A subspace of R^3.

    Attributes:
        basis: (k, 3), orthonormal rows; k is the dimension.
    """

    basis: FloatArray

    @classmethod
    def span(cls, vectors: ArrayLike) -> Subspace:
        """The smallest subspace that holds ``vectors`` (n, 3), of any lengths, zero included.

        Raises:
            InputError: If the shape is wrong or an entry is not finite.
        """
        rows = numbers("vectors", vectors)
        rows = finite_points("vectors", rows if rows.size else rows.reshape(0, 3))
        if rows.ndim != 2:
            raise InputError("vectors", rows.shape, "an array of shape (n, 3), by shape")
        lengths = np.linalg.norm(rows, axis=1)
        rows = rows[lengths > _SAME] / lengths[lengths > _SAME, None]
        _, values, right = np.linalg.svd(rows)
        return cls(right[: int((values > _SAME).sum())])

    @property
    def dim(self) -> int:
        """Dimension, 0 to 3."""
        return len(self.basis)

    @property
    def projector(self) -> FloatArray:
        """(3, 3): the orthogonal projection onto the subspace; equal for equal subspaces."""
        result: FloatArray = self.basis.T @ self.basis
        return result

    @property
    def complement(self) -> Subspace:
        """All vectors perpendicular to the subspace."""
        return Subspace(np.linalg.svd(self.basis)[2][self.dim :])

    def __or__(self, other: Subspace) -> Subspace:
        """Union in the sense of POC theory: the span of both."""
        return Subspace.span(np.concatenate([self.basis, other.basis]))

    def __and__(self, other: Subspace) -> Subspace:
        """Intersection: what is perpendicular to everything that is perpendicular to either."""
        return (self.complement | other.complement).complement


@dataclass(frozen=True, eq=False)
class POCSet:
    """Position and orientation characteristics of a link, the column [t; r] of the paper.

    Attributes:
        translations: Directions of translation of the base point.
        rotations: Axes of rotation.
    """

    translations: Subspace
    rotations: Subspace

    @property
    def dim(self) -> int:
        """Number of elements, dim{...} of Eq. (3b): 0 to 6."""
        return self.translations.dim + self.rotations.dim

    def __or__(self, other: POCSet) -> POCSet:
        """Union, the rule of Eq. (1)."""
        return POCSet(self.translations | other.translations, self.rotations | other.rotations)

    def __and__(self, other: POCSet) -> POCSet:
        """Intersection, the rule of Eq. (2)."""
        return POCSet(self.translations & other.translations, self.rotations & other.rotations)

    def __str__(self) -> str:
        """The paper's notation without directions, e.g. ``t^3 r^0``."""
        return f"t^{self.translations.dim} r^{self.rotations.dim}"


@dataclass(frozen=True, eq=False)
class Unit:
    """A joint, or a parallelogram that serves as one, at one configuration; see the makers below.

    Attributes:
        name: The paper's name.
        point: (3,) m, a point that all its axes of rotation pass through.
        translations: (n, 3) directions in which that point can move.
        rotations: (n, 3) axes.
        actuated: Whether a motor drives it.
    """

    name: str
    point: FloatArray
    translations: FloatArray
    rotations: FloatArray
    actuated: bool = False

    @property
    def freedoms(self) -> int:
        """f_i of Eq. (3a)."""
        return len(self.translations) + len(self.rotations)

    def poc(self, base_point: ArrayLike) -> POCSet:
        """M_Ji of Eq. (1), about ``base_point`` (3,) m of the chain's end link."""
        arm = np.asarray(base_point, dtype=np.float64) - self.point
        carried = np.concatenate([self.translations, np.cross(self.rotations, arm)])
        return POCSet(Subspace.span(carried), Subspace.span(self.rotations))


def revolute(name: str, axis: FloatArray, point: FloatArray, actuated: bool = False) -> Unit:
    """A revolute joint R: ``axis`` (3,), ``point`` (3,) m on it."""
    return Unit(name, point, np.empty((0, 3)), axis[None], actuated)


def prismatic(name: str, axis: FloatArray, point: FloatArray, actuated: bool = False) -> Unit:
    """A prismatic joint P: ``axis`` (3,), ``point`` (3,) m on it."""
    return Unit(name, point, axis[None], np.empty((0, 3)), actuated)


def parallelogram_4s(name: str, short: FloatArray, rod: FloatArray, point: FloatArray) -> Unit:
    """A parallelogram of four spherical pairs, P^(4S) P^(4S) R^(4S) R^(4S) of the paper.

    Its rods, which spin idly about themselves, keep one distance each: the far short link loses
    the translation along the rods and the rotation about the normal of the parallelogram. ``short``
    and ``rod`` (3,) are directions of short links and rods, ``point`` (3,) m is the middle of the
    far short link.
    """
    normal = np.cross(short, rod)
    translations = np.stack([normal, np.cross(rod, normal)])
    return Unit(name, point, translations, np.stack([short, rod]))


def parallelogram_4r(name: str, short: FloatArray, rod: FloatArray, point: FloatArray) -> Unit:
    """A parallelogram of four revolutes, P^(4R): a translation in its plane, across the rods.

    The paper writes t^1(|| R32), the direction of its short links; that is where the rods are
    perpendicular to them. The arguments are those of :func:`parallelogram_4s`.
    """
    normal = np.cross(short, rod)
    return Unit(name, point, np.cross(rod, normal)[None], np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Chain:
    """Units in series."""

    name: str
    units: tuple[Unit, ...]

    @property
    def freedoms(self) -> int:
        """Sum of f_i."""
        return sum(unit.freedoms for unit in self.units)

    @property
    def actuated(self) -> int:
        """Number of motors, I_j of Eq. (4)."""
        return sum(unit.actuated for unit in self.units)

    def poc(self, base_point: ArrayLike) -> POCSet:
        """Eq. (1) for this chain, about ``base_point`` (3,) m of its end link."""
        return serial([unit.poc(base_point) for unit in self.units])


def serial(sets: Sequence[POCSet]) -> POCSet:
    """Eq. (1): POC set of a serial chain, the union of those of its joints.

    Raises:
        InputError: If there is none.
    """
    if not sets:
        raise InputError("sets", sets, "at least one POC set")
    return reduce(POCSet.__or__, sets)


def parallel(sets: Sequence[POCSet]) -> POCSet:
    """Eq. (2): POC set of a link that several chains hold, the intersection of theirs.

    Raises:
        InputError: If there is none.
    """
    if not sets:
        raise InputError("sets", sets, "at least one POC set")
    return reduce(POCSet.__and__, sets)


def degrees_of_freedom(freedoms: Sequence[int], equations: Sequence[int]) -> int:
    """Eq. (3a): F = sum of f_i - sum of xi_Lj."""
    return sum(freedoms) - sum(equations)


def independent_equations(previous: Sequence[POCSet], added: POCSet) -> int:
    """Eq. (3b): xi_Lj = dim{(intersection of the j previous chains) union chain j + 1}."""
    return (parallel(previous) | added).dim


def constraint_degree(freedoms: int, actuated: int, equations: int) -> int:
    """Eq. (4), the second of that number: Delta_j = sum of f_i - I_j - xi_Lj."""
    return freedoms - actuated - equations


def coupling_degrees(decompositions: Sequence[Sequence[int]]) -> tuple[float, ...]:
    """Eq. (5): kappa of each Assur kinematic chain (AKC), from the Delta_j of each decomposition.

    The decomposition with the least sum of |Delta_j| counts. An AKC ends where the constraint
    degrees so far add up to zero.

    Raises:
        InputError: If the constraint degrees of the one that counts do not add up to zero.
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
    """One independent loop, closed by one single open chain (SOC).

    Attributes:
        chains: Names of the chains that the SOC is made of.
        freedoms: Sum of f_i over the SOC.
        actuated: Number of its motors, I_j.
        equations: xi_Lj.
    """

    chains: tuple[str, ...]
    freedoms: int
    actuated: int
    equations: int

    @property
    def constraint(self) -> int:
        """Delta_j of Eq. (4)."""
        return constraint_degree(self.freedoms, self.actuated, self.equations)


@dataclass(frozen=True, eq=False)
class ParallelMechanism:
    """What :func:`analyse` finds.

    Attributes:
        platform: POC set of the platform.
        decompositions: The independent loops, for every order in which the chains can be taken;
            the order in which they were given comes first.
    """

    platform: POCSet
    decompositions: tuple[tuple[Loop, ...], ...]

    @property
    def loops(self) -> tuple[Loop, ...]:
        """The loops of the first decomposition."""
        return self.decompositions[0]

    @property
    def coupling(self) -> tuple[float, ...]:
        """Eq. (5): kappa of each Assur kinematic chain.

        Raises:
            InputError: If there are not as many motors as freedoms, as at a constraint singularity:
                the constraint degrees do not add up to zero.
        """
        return coupling_degrees([[x.constraint for x in loops] for loops in self.decompositions])

    def dof(self, loops: int | None = None) -> int:
        """F of Eq. (3a), counting the first ``loops`` of the loops, or all."""
        counted = self.loops[:loops]
        return degrees_of_freedom([x.freedoms for x in counted], [x.equations for x in counted])


def analyse(chains: Sequence[Chain], point: ArrayLike) -> ParallelMechanism:
    """Apply Eqs. (1) to (5) to two chains or more from the base to one platform.

    ``point`` (3,) m is the base point of the platform, at the configuration of the chains.

    Raises:
        InputError: If there are fewer chains.
    """
    if len(chains) < 2:
        raise InputError("chains", len(chains), "two chains or more, by number")
    platform = parallel([chain.poc(point) for chain in chains])
    return ParallelMechanism(platform, decompositions(chains, point))


def decompositions(chains: Sequence[Chain], point: ArrayLike) -> tuple[tuple[Loop, ...], ...]:
    """The independent loops for every order of the chains, about ``point`` (3,) m of their end."""
    held = [(chain, chain.poc(point)) for chain in chains]
    return tuple(_loops(order) for order in permutations(held))


def _loops(order: tuple[tuple[Chain, POCSet], ...]) -> tuple[Loop, ...]:
    """The loops that form as the chains are mounted in this order, the first by two of them."""
    chains, sets = zip(*order, strict=True)
    loops = []
    for j in range(1, len(order)):
        added = chains[: j + 1] if j == 1 else chains[j : j + 1]
        loops.append(
            Loop(
                chains=tuple(chain.name for chain in added),
                freedoms=sum(chain.freedoms for chain in added),
                actuated=sum(chain.actuated for chain in added),
                equations=independent_equations(sets[:j], sets[j]),
            )
        )
    return tuple(loops)
