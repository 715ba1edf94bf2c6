"""Zero sets of the factors of det A and det B in Cartesian space, on one working mode.

Fields are sampled on a grid through the inverse kinematics and contoured at zero, then every point
found is moved along its grid edge until the factor vanishes. The factors of det A and that of the
constraint change sign inside the workspace. Those of det B keep theirs (they name the working mode)
and end with the workspace; their squares go on beyond it and change sign there, so we contour
those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import contourpy
import numpy as np

from tpm_gym.analysis.singularity import factors_at
from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import WorkingMode
from tpm_gym.kinematics.geometry import PAPER, Geometry

Field = Callable[[FloatArray], FloatArray]

_HALVINGS = 40  # of a grid edge of about 1 cm: to the last digit of a double


@dataclass(frozen=True)
class Section:
    """A plane through the workspace; its coordinates are x and the axis that is not fixed.

    Attributes:
        fixed: "y" for an x-z section, "z" for an x-y section.
        at: Where, m.
    """

    fixed: str
    at: float

    def points(self, plane: FloatArray) -> FloatArray:
        """Return points (..., 3) m in the paper's frame from section coordinates (..., 2) m."""
        x, other = plane[..., 0], plane[..., 1]
        fixed = np.full_like(x, self.at)
        yz = (fixed, other) if self.fixed == "y" else (other, fixed)
        return np.stack([x, *yz], axis=-1)


def serial_squares(
    points: FloatArray, cos_beta_sign: int, geometry: Geometry = PAPER
) -> FloatArray:
    """Compute squares of the four factors of det B, continued as negative numbers out of reach.

    With C_i - A_i = (a, b) in the arm's plane and ``out`` out of it, the closure of leg i is
    a cos + b sin = c, so its factor l3 (b cos - a sin) has the square l3^2 (a^2 + b^2 - c^2).

    Args:
        points: (..., 3) m.
        cos_beta_sign: To which side of link 3' link 7 points.
        geometry: Link lengths.

    Returns:
        (..., 4): cos^2(beta), and for each leg in m^4/rad^2. Where |y| > l7 the legs' are those of
        cos(beta) = 0.
    """
    l1, l2, l3, l4, l5, l6, l7 = vars(geometry).values()
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    cos2 = 1 - (y / l7) ** 2
    x_c = x - l2 - cos_beta_sign * l7 * np.sqrt(np.maximum(cos2, 0.0))
    z_c = z - 2 * l6
    legs = (
        (np.full_like(x, -l1), z_c, x_c),
        (x_c + l1 - 2 * l5, z_c, np.zeros_like(x)),
        (x + l2 - l1, z - l6, y),
    )
    squares = [cos2]
    for a, b, out in legs:
        c = (a * a + b * b + out * out + l3**2 - l4**2) / (2 * l3)
        squares.append(l3**2 * (a * a + b * b - c * c))
    return np.stack(squares, axis=-1)


def reach_margin(points: FloatArray, cos_beta_sign: int, geometry: Geometry = PAPER) -> FloatArray:
    """Compute a dimensionless margin: positive where all legs reach points (..., 3) m."""
    squares = serial_squares(points, cos_beta_sign, geometry)[..., 1:]
    margin: FloatArray = squares.min(axis=-1) / (geometry.l3 * geometry.l4) ** 2
    return margin


def zero_lines(field: Field, u: FloatArray, v: FloatArray) -> list[FloatArray]:
    """Find lines (n, 2) on which ``field`` changes sign, over the grid u (j,) by v (k,).

    Args:
        field: Values (...,) at section coordinates (..., 2); NaN where it does not exist.
        u: First coordinate, ascending.
        v: Second coordinate, ascending.

    Returns:
        Lines whose points are zeros of the field to rounding, each on an edge of the grid.
    """
    plane = np.stack(np.meshgrid(u, v), axis=-1)
    values = np.ma.masked_invalid(field(plane))
    # Whole cells only: then every point lies on a grid edge, with a sign change along it.
    generator = contourpy.contour_generator(u, v, values, corner_mask=False)
    lines = [np.asarray(line) for line in generator.lines(0.0)]
    if not lines:
        return []
    refined = _bisect(field, np.concatenate(lines), u, v)
    return np.split(refined, np.cumsum([len(line) for line in lines])[:-1])


def _bisect(field: Field, points: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Move points (n, 2) along their grid edges to where the field vanishes."""
    low, high = points.copy(), points.copy()
    for axis, nodes in enumerate((u, v)):
        cell = np.clip(np.searchsorted(nodes, points[:, axis]) - 1, 0, len(nodes) - 2)
        on_node = np.abs(points[:, axis, None] - nodes).min(axis=1) < 1e-9
        low[:, axis] = np.where(on_node, points[:, axis], nodes[cell])
        high[:, axis] = np.where(on_node, points[:, axis], nodes[cell + 1])
    sign = np.sign(field(low))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        same = (np.sign(field(middle)) == sign)[:, None]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return (low + high) / 2


def clip(lines: list[FloatArray], keep: Callable[[FloatArray], BoolArray]) -> list[FloatArray]:
    """Return the pieces of lines (n, 2) whose points satisfy ``keep``, of two points or more."""
    pieces = []
    for line in lines:
        cuts = np.flatnonzero(np.diff(keep(line).astype(int))) + 1
        pieces += [run for run in np.split(line, cuts) if len(run) > 1 and keep(run[:1])[0]]
    return pieces


def parallel_lines(
    index: int, mode: WorkingMode, section: Section, u: FloatArray, v: FloatArray
) -> list[FloatArray]:
    """Find zero lines of a factor of det A, or of the constraint, for the paper's lengths.

    ``index`` is that of :func:`sheets`.
    """
    return zero_lines(lambda p: sheets(section.points(p), mode)[..., index], u, v)


def sheets(points: FloatArray, mode: WorkingMode) -> FloatArray:
    """Return the factors that change sign inside the workspace, (..., 4): det A and elevation."""
    found = factors_at(points, mode)
    return np.stack([*found[:3], found.elevation], axis=-1)


def serial_lines(
    index: int,
    cos_beta_sign: int,
    section: Section,
    u: FloatArray,
    v: FloatArray,
    clipped: bool = True,
) -> list[FloatArray]:
    """Find zero lines of factor ``index`` (0 to 3) of det B in a section, for the paper's lengths.

    Clipped to where the other factors are real, they are edges of the reachable set.
    """

    def square(plane: FloatArray) -> FloatArray:
        return serial_squares(section.points(plane), cos_beta_sign)[..., index]

    def reached(plane: FloatArray) -> BoolArray:
        squares = serial_squares(section.points(plane), cos_beta_sign)
        result: BoolArray = np.all(np.delete(squares, index, axis=-1) >= 0, axis=-1)
        return result

    lines = zero_lines(square, u, v)
    return clip(lines, reached) if clipped else lines
