"""What the tests know by themselves: points, factors and branch labels, written out from the table.

Nothing here calls the package's formulas, so a slip in them cannot hide.
"""

from dataclasses import astuple
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    AssemblyMode,
    ForwardSolutions,
    WorkingMode,
    forward_all,
    inverse_all,
    jacobian,
)
from tpm_gym.kinematics.geometry import PAPER, Geometry


class Lengths(Protocol):
    """A Geometry, or lengths that Geometry would refuse."""

    l1: float
    l2: float
    l3: float
    l4: float
    l5: float
    l6: float
    l7: float


def scaled(g: Geometry, factor: float) -> Geometry:
    """All lengths times a factor."""
    return Geometry(*(factor * length for length in astuple(g)))


def grid(low: Vector, high: Vector, counts: tuple[int, int, int]) -> FloatArray:
    """Points (nx, ny, nz, 3) all over a box, faces included."""
    sides = [np.linspace(*ends) for ends in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)


def vector(x: Any, y: Any, z: Any) -> FloatArray:
    """Coordinates that broadcast, stacked into (..., 3)."""
    return np.stack(np.broadcast_arrays(np.asarray(x, dtype=float), y, z), axis=-1)


def points(theta: Any, x_c: Any, z_c: Any, beta: Any, g: Lengths) -> dict[str, FloatArray]:
    """All points of the mechanism for actuated angles, (xC, zC) of link 3' and angle beta."""
    theta = np.asarray(theta, dtype=float)
    c, s = np.cos(theta), np.sin(theta)
    p = {
        "A1": vector(0.0, g.l1, 0.0),
        "A2": vector(-g.l1, 0.0, 0.0),
        "A3": vector(g.l1, 0.0, 0.0),
        "B1": vector(0.0, g.l1 + g.l3 * c[..., 0], g.l3 * s[..., 0]),
        "B2": vector(-g.l1 + g.l3 * c[..., 1], 0.0, g.l3 * s[..., 1]),
        "B3": vector(g.l1 + g.l3 * c[..., 2], 0.0, g.l3 * s[..., 2]),
        "C1": vector(x_c, 0.0, z_c),
        "C2": vector(np.asarray(x_c) - 2 * g.l5, 0.0, z_c),
    }
    p["D1"] = p["C1"] + [0.0, 0.0, g.l6]
    p["E1"] = p["D1"] + g.l7 * vector(np.cos(beta), np.sin(beta), 0.0)
    p["F1"] = p["E1"] + [0.0, 0.0, g.l6]
    p["P"] = p["F1"] + [g.l2, 0.0, 0.0]
    p["D3"] = p["F1"] + [2 * g.l2, 0.0, 0.0]
    p["C3"] = p["D3"] - [0.0, 0.0, g.l6]
    return p


def turn_about_y(angle: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) by angles (...,) rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack(
        [vector(cos, 0.0, sin), vector(0 * cos, 1.0, 0.0), vector(-sin, 0.0, cos)], axis=-2
    )


def rods(p: dict[str, FloatArray]) -> FloatArray:
    """(..., 3, 3): row i is B_iC_i."""
    return np.stack([p[f"C{i}"] - p[f"B{i}"] for i in (1, 2, 3)], axis=-2)


def factors(theta: Any, x_c: Any, z_c: Any, beta: Any, g: Lengths) -> tuple[FloatArray, FloatArray]:
    """Parallel (..., 3) and serial (..., 4) factors, as mechanism notes and Eqs. 16, 17 have it."""
    theta = np.asarray(theta, dtype=float)
    c, s = np.cos(theta), np.sin(theta)
    parallel = np.stack(
        [
            np.sin(beta),
            g.l1 + g.l3 * c[..., 2] - x_c - 2 * g.l2,
            x_c * (z_c - g.l3 * s[..., 1])
            - (z_c - g.l3 * s[..., 0]) * (x_c - 2 * g.l5 + g.l1 - g.l3 * c[..., 1]),
        ],
        axis=-1,
    )
    bc = rods(points(theta, x_c, z_c, beta, g))
    rates = np.stack(
        [
            g.l3 * vector(0.0, -s[..., 0], c[..., 0]),
            g.l3 * vector(-s[..., 1], 0.0, c[..., 1]),
            g.l3 * vector(-s[..., 2], 0.0, c[..., 2]),
        ],
        axis=-2,
    )
    legs = (bc * rates).sum(axis=-1)
    return parallel, np.concatenate([np.cos(beta)[..., None], legs], axis=-1)


def link3(position: FloatArray, beta: Any, g: Lengths) -> tuple[FloatArray, FloatArray]:
    """xC and zC of link 3' for P (..., 3) and beta (...,)."""
    return position[..., 0] - g.l2 - g.l7 * np.cos(beta), position[..., 2] - 2 * g.l6


def factors_at(
    position: FloatArray, mode: WorkingMode, g: Geometry
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same at points (..., 3) on a working mode, and z_C1 - z_B1 (...,) m; NaN out of reach."""
    found = inverse_all(position, g)
    theta, beta = found.theta[..., mode.index, :], found.beta[..., mode.index]
    elevation = position[..., 2] - 2 * g.l6 - g.l3 * np.sin(theta[..., 0])
    return *factors(theta, *link3(position, beta, g), beta, g), elevation


def level_rod_4(
    theta_1: float, beta: float, side: int = 1, offset: float = 0.0, g: Geometry = PAPER
) -> FloatArray:
    """P (3,) with z_C1 = z_B1 + offset: at 0, a constraint singularity."""
    y_b, z_b = g.l1 + g.l3 * np.cos(theta_1), g.l3 * np.sin(theta_1)
    x_c = side * np.sqrt(g.l4**2 - y_b**2 - offset**2)
    x, y = x_c + g.l7 * np.cos(beta) + g.l2, g.l7 * np.sin(beta)
    return np.array([x, y, z_b + offset + 2 * g.l6])


def assembly_slots(parallel: FloatArray) -> NDArray[np.int64]:
    """Slots of the assembly modes whose labels are the signs of the factors (..., 3)."""
    signs = {(mode.planar, mode.sin_beta): slot for slot, mode in enumerate(ASSEMBLY_MODES)}
    pairs = np.sign(parallel[..., [2, 0]]).astype(int).reshape(-1, 2)
    slots = [signs[(planar, sin_beta)] for planar, sin_beta in pairs.tolist()]
    return np.array(slots).reshape(parallel.shape[:-1])


def reachable_points(rng: np.random.Generator, count: int, g: Geometry) -> FloatArray:
    """Points (count, 3) of the workspace that have at least one posture, on either side of y."""
    found = np.empty((0, 3))
    reach = g.l3 + g.l4
    high = np.array([g.l1 + reach, g.l7, reach])
    for _ in range(2000):
        draws = rng.uniform(-high, high, (4 * count, 3))
        valid = inverse_all(draws, g).valid.any(axis=-1)
        found = np.concatenate([found, draws[valid]])
        if len(found) >= count:
            return found[:count]
    raise AssertionError(f"hardly any point can be reached with {g}")


def postures(found: Any, given: FloatArray, g: Geometry) -> SimpleNamespace:
    """Every branch found for the angles or points given (n, 3), one row each, and its points."""
    row, slot = np.nonzero(found.valid)
    if isinstance(found, ForwardSolutions):
        theta, position = given[row], found.position[row, slot]
    else:
        theta, position = found.theta[row, slot], given[row]
    beta = found.beta[row, slot]
    x_c, z_c = link3(position, beta, g)
    rows = {"theta": theta, "position": position, "beta": beta, "x_c": x_c, "z_c": z_c}
    return SimpleNamespace(**rows, slot=slot, p=points(theta, x_c, z_c, beta, g))


def reachable_postures(rng: np.random.Generator, count: int, g: Geometry) -> SimpleNamespace:
    """Every posture of ``count`` random points."""
    some = reachable_points(rng, count, g)
    return postures(inverse_all(some, g), some, g)


def angles_on(
    branch: AssemblyMode, rng: np.random.Generator, count: int, g: Geometry, clear: float = 0.0
) -> FloatArray:
    """Angles (n, 3) of those postures on an assembly mode, every parallel factor clear of zero.

    ``clear`` is in units of the factors' sizes.
    """
    theta = reachable_postures(rng, count, g).theta
    theta = theta[forward_all(theta, g).valid[:, branch.index]]
    scaled = jacobian.factors(theta, branch, g).parallel / [1.0, g.l4, g.l4**2]
    on: FloatArray = theta[(np.abs(scaled) > clear).all(axis=-1)]
    return on


def geometries() -> st.SearchStrategy[Geometry]:
    """Lengths of all proportions, away from the combinations that Geometry refuses."""
    return st.builds(
        lambda l1, arm, **others: Geometry(l1=l1, l3=l1 * arm, **others),
        l1=st.floats(0.15, 0.5),
        l2=st.floats(0.02, 0.15),
        arm=st.one_of(st.floats(0.6, 0.95), st.floats(1.05, 1.6)),
        l4=st.floats(0.5, 1.2),
        l5=st.floats(0.03, 0.14),
        l6=st.one_of(st.just(0.0), st.floats(0.001, 0.05)),
        l7=st.floats(0.02, 0.15),
    )


def seeds() -> st.SearchStrategy[int]:
    """Seeds of numpy generators."""
    return st.integers(0, 2**32 - 1)
