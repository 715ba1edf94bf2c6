"""Lengths for the largest box of good conditioning, by closed-form gradients."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gradients.descent import minimise
from tpm_gym.kinematics.geometry import PAPER, Geometry, Lengths
from tpm_gym.kinematics.jacobian import factors_at
from tpm_gym.kinematics.workspace import Region, conditioning_at
from tpm_gym.mechanism.motor import TORQUE_MOTOR

THRESHOLD = 0.1
"""Least conditioning in the box."""
FOOTPRINT = PAPER.l1 + PAPER.l3
"""Half side of the square around the base in which all joints stay, m: that of the paper's arms."""
ELEVATION = 0.1
"""Least z_C1 - z_B1, m: at 0 (constraint singularity) the platform may begin to tilt."""
REACH = PAPER.l3 + PAPER.l4
"""Largest length of a stretched leg, m, as in the paper."""
LEAST = Lengths(
    # Nearer to the middle, the motors of arms 2, 5 and 12 would overlap.
    l1=TORQUE_MOTOR.reach + TORQUE_MOTOR.stator_radius,
    # These hold the platform level against a load, of which the conditioning knows nothing.
    l2=PAPER.l2,
    l5=PAPER.l5,
    l6=PAPER.l6,
    l3=0.0,
    l4=0.0,
    l7=0.0,
)
"""Least lengths; l6 is fixed."""

_NODES = (6, 5, 6)  # of the box, where the search looks; the tests look at 41 x 41 x 41
_WEIGHTS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
_FREE = torch.tensor([0, 1, 2, 3, 4, 6, *range(7, 13)])
_BOX = torch.arange(7, 13)


class Design(NamedTuple):
    """Lengths, and the largest box that was found for them (paper's frame)."""

    geometry: Geometry
    box: Region

    @property
    def volume(self) -> float:
        """Volume of the box, m^3."""
        return float(np.subtract(self.box.high, self.box.low).prod())


def nodes(counts: tuple[int, int, int]) -> Tensor:
    """Return a grid over the unit cube with its faces, (n, 3)."""
    axes = [torch.linspace(0.0, 1.0, count, dtype=torch.float64) for count in counts]
    return torch.cartesian_prod(*axes)


def room(design: Tensor) -> Tensor:
    """Compute the margins to all limits of a box: positive where it is allowed.

    Args:
        design: (13,) m: l1 to l7, the box's smallest x, y, z, and its largest.
    """
    lengths, low, high = Lengths(*design[:7]), design[7:10], design[10:]
    size = high - low
    points = low + nodes(_NODES) * size
    conditioning = conditioning_at(points, geometry=lengths)
    elevation = factors_at(points, geometry=lengths).elevation  # NaN where P cannot be
    # Link 3' reaches farthest to -x at the box's smallest x and y
    reach7 = torch.sqrt(torch.clip(lengths.l7**2 - low[1] ** 2, min=0.0))
    c2 = low[0] - lengths.l2 - reach7 - 2 * lengths.l5
    joints = torch.stack([FOOTPRINT + c2, FOOTPRINT - high[0] - lengths.l2, FOOTPRINT - high[1]])
    return torch.cat([conditioning - THRESHOLD, elevation - ELEVATION, joints, size])


def room_of_lengths(design: Tensor) -> Tensor:
    """Compute the margins to the limits of the lengths."""
    l1, _, l3, l4, *_ = design
    least = torch.tensor(LEAST, dtype=torch.float64)
    spare = (design[:7] - least)[_FREE[:6]]
    return torch.cat([spare, torch.stack([FOOTPRINT - l1 - l3, REACH - l3 - l4])])


def largest_box(geometry: Geometry, free: bool = False) -> Design:
    """Find the largest box for these lengths, or for any lengths, starting there, if ``free``.

    Raises:
        ValueError: If no small box is allowed to begin with.
    """
    start, index = _small_box(geometry), _FREE if free else _BOX

    def full(part: Tensor) -> Tensor:
        return start.index_put((index,), part)

    def aim(part: Tensor) -> Tensor:
        design = full(part)
        return -torch.log(design[10:] - design[7:10]).sum()

    def limits(part: Tensor) -> Tensor:
        design = full(part)
        return torch.cat([room(design), room_of_lengths(design)]) if free else room(design)

    found = full(minimise(aim, limits, start[index], _WEIGHTS)).tolist()
    return Design(Geometry(*found[:7]), Region(tuple(found[7:10]), tuple(found[10:])))


def _small_box(geometry: Geometry) -> Tensor:
    """Return a box of a fiftieth of l7 about the best-conditioned of many points that allow one."""
    rng, l7 = np.random.default_rng(0), geometry.l7
    points = rng.uniform((-FOOTPRINT, 0.0, 0.0), (FOOTPRINT, l7, REACH), (20_000, 3))
    lengths = [*vars(geometry).values()]
    for best in np.argsort(-conditioning_at(points, geometry=geometry))[:50]:
        low, high = points[best] - l7 / 100, points[best] + l7 / 100
        design = torch.tensor(np.array([*lengths, *low, *high]))
        if (room(design) > 0).all():
            return design
    raise ValueError(f"no box of good conditioning for {geometry}")


def random_lengths(rng: np.random.Generator) -> Geometry:
    """Sample lengths within the limits, from which a search can start."""
    while True:
        low, high = (0.18, 0.07, 0.1, 0.3, 0.1, 0.01, 0.05), (0.5, 0.15, 0.5, 1.0, 0.2, 0.01, 0.8)
        drawn = torch.tensor(rng.uniform(low, high))
        if (room_of_lengths(drawn) > 0).all():
            with suppress(ValueError):
                _small_box(geometry := Geometry(*drawn.tolist()))
                return geometry
