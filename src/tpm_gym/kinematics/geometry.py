"""Seven lengths that define the mechanism, with their checks."""

from dataclasses import dataclass
from typing import NamedTuple

from tpm_gym.arrays import is_number
from tpm_gym.errors import GeometryError, InputError
from tpm_gym.kinematics.namespaces import Numbers

_CLOSE = 1e-4
"""Limit for two numbers, as a fraction of l1. The first number is l1 - l3, the smallest y_B1, which
may be negative. The second number is the smaller of l5 and |l5 - l1|. :class:`Geometry` refuses
lengths for which both numbers are below the limit. With such lengths, the two circles of Eq. (6)
can nearly coincide, and their intersections would be inaccurate."""


class Lengths(NamedTuple):
    """Lengths l1 to l7, m. They may be numbers of any kind, such as tensors; nothing is checked."""

    l1: Numbers
    l2: Numbers
    l3: Numbers
    l4: Numbers
    l5: Numbers
    l6: Numbers
    l7: Numbers


@dataclass(frozen=True)
class Geometry:
    """Link lengths of the mechanism in metres, named as in the paper.

    Attributes:
        l1: Half side of the base: distance from O to each actuated pivot A_i.
        l2: Half side of the platform: F1 to P and P to D3.
        l3: Length of the actuated arms A_iB_i (links 2, 5 and 12).
        l4: Length of the rods B_iC_i (link 6 and the long links of both parallelograms).
        l5: Half the length of the short links of both parallelograms.
        l6: Vertical offsets C_1D_1, E_1F_1 and C_3D_3; may be zero.
        l7: Length of link 7, D_1E_1; the workspace extends from y = -l7 to l7.

    Raises:
        GeometryError: If a length is no finite positive number (l6 may be 0), if rods 4a and 4b
            cannot reach the plane of link 3', or if the circles of Eq. (6) can coincide.
    """

    l1: float
    l2: float
    l3: float
    l4: float
    l5: float
    l6: float
    l7: float

    def __post_init__(self) -> None:
        """Reject lengths that make no mechanism."""
        for name, value in vars(self).items():
            if not is_number(value) or value < 0 or (value == 0 and name != "l6"):
                least = "not negative" if name == "l6" else "positive"
                raise GeometryError(name, value, f"it must be a finite number, {least}")
            object.__setattr__(self, name, float(value))  # allowed in this loop: no new key
        l1, l5 = self.l1, self.l5
        close = _CLOSE * l1
        if self.l3 > l1 - close and min(l5, abs(l5 - l1)) < close:
            # Where a1 = b1 = 0 in Eq. (7), the two circles of Eq. (6) are concentric, and y_B1 is
            # 2 l5 or 2 (l1 - l5). If y_B1 is 0 too, the circles coincide, and link 3' can move
            # with motors 1 and 2 locked.
            raise GeometryError(
                "l5", l5, f"it must differ from 0 and from l1 = {l1} m by {close:.3g} m or more"
            )
        if self.l4 <= l1 - self.l3:
            least = f"it must exceed l1 - l3 = {l1 - self.l3} m, or rod 4 never reaches y = 0"
            raise GeometryError("l4", self.l4, least)

    @property
    def lengths(self) -> Lengths:
        """l1 to l7, m."""
        return Lengths(*vars(self).values())


AnyLengths = Geometry | Lengths


def require_geometry(geometry: object) -> None:
    """Raise InputError if the argument is no Geometry."""
    if not isinstance(geometry, Geometry):
        raise InputError("geometry", geometry, "a tpm_gym.Geometry")


PAPER = Geometry(l1=0.300, l2=0.070, l3=0.350, l4=0.800, l5=0.100, l6=0.010, l7=0.050)
"""Lengths of the paper's section "Case study", where they are in millimetres."""

WIDE = Geometry(l1=0.300, l2=0.070, l3=0.350, l4=0.800, l5=0.100, l6=0.010, l7=0.600)
"""The paper's lengths with a longer l7, for a workspace of practical depth in y.

Values of l7 from 0.1 to 0.9 m in steps of 0.1 m were compared by their largest axis-aligned box
with a conditioning of at least 0.1 and elbows out (:func:`tpm_gym.analysis.aspects.largest_box`).
The box is largest for 0.6 m: about 45 litres, 0.3 m deep in y. PAPER has 3 litres, 0.02 m deep.
"""
