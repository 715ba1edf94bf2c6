"""Solution branches of the kinematics, and arrays of solutions on all branches.

Branches are named by signs that change only at a singularity:

* an :class:`AssemblyMode` (forward kinematics, 4 of them) by the signs of the planar factor and of
  sin(beta), two of the three factors of the parallel Jacobian's determinant;
* a :class:`WorkingMode` (inverse kinematics, 16 of them) by the signs of the four factors of the
  serial Jacobian's determinant.
"""

from dataclasses import dataclass
from itertools import product

from tpm_gym.arrays import BoolArray, FloatArray, brief
from tpm_gym.errors import InputError
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.namespaces import namespace_of


class _Mode:
    """Branch that is named by its signs."""

    def __post_init__(self) -> None:
        """Reject anything but signs; store them as ints."""
        if any(sign not in (-1, 1) for sign in self.signs):
            raise InputError(type(self).__name__, self.signs, "made of signs, each +1 or -1")
        for name, sign in list(vars(self).items()):
            object.__setattr__(self, name, int(sign))

    @property
    def signs(self) -> tuple[int, ...]:
        """Signs, in the order of the attributes."""
        return tuple(vars(self).values())

    @property
    def index(self) -> int:
        """Slot of this branch in arrays of all solutions."""
        return sum((sign + 1) // 2 << shift for shift, sign in enumerate(self.signs[::-1]))


@dataclass(frozen=True)
class AssemblyMode(_Mode):
    """Branch of the forward kinematics, one of 4.

    Attributes:
        planar: Sign of the planar factor xC (zC - zB2) - (zC - zB1)(xC - 2 l5 - xB2) of Eq. (16).
            The two circles of Eq. (6) intersect at two points, one on each side of the line through
            the circles' centres. The sign selects the point that is C1.
        sin_beta: Sign of sin(beta), and so of y: the side of y = 0 on which the platform is.
    """

    planar: int
    sin_beta: int


@dataclass(frozen=True)
class WorkingMode(_Mode):
    """Branch of the inverse kinematics, one of 16.

    Attributes:
        cos_beta: Sign of cos(beta): the side of link 3' to which link 7 points.
        leg1: Sign of B1C1 . dB1/dtheta_1, a factor of Eq. (17): the way that elbow 1 is bent.
        leg2: Sign of B2C2 . dB2/dtheta_2.
        leg3: Sign of B3C3 . dB3/dtheta_3.
    """

    cos_beta: int
    leg1: int
    leg2: int
    leg3: int


@dataclass(frozen=True)
class RotatedMode(_Mode):
    """Branch of the forward kinematics in the second operation mode, one of 8.

    Attributes:
        planar: Sign of the planar factor of :func:`tpm_gym.kinematics.rotated.factors`. The
            sign gives the side on which rod 6 passes the point where rods 4a and 4b cross, as seen
            along y. Exception: if rods 4a and 4b, seen along y, are shorter than links 3 and 3',
            the planar factor can have the same sign in more than half of the assemblies of link 3'.
            In this case, these assemblies are sorted by the planar factor times |B1C1|^2 (B1C1 as
            seen along y): ``planar`` is -1 for the half of them with the smaller products, and 1
            for the other half.
        further: Sign that selects one of the two assemblies of link 3' with the same ``planar``: -1
            for the smaller tilt phi in [0, 2 pi), 1 for the larger tilt.
        sin_beta: Sign of sin(beta), and so of y.
    """

    planar: int
    further: int
    sin_beta: int


def require_mode(branch: object, kind: type[_Mode]) -> None:
    """Raise InputError if a branch is no mode of this kind."""
    if not isinstance(branch, kind):
        raise InputError("branch", brief(branch), f"a tpm_gym.kinematics.{kind.__name__}")


ASSEMBLY_MODES = tuple(AssemblyMode(*signs) for signs in product((-1, 1), repeat=2))
"""Branches of the forward kinematics, all 4, in the order of the slots of :func:`forward_all`."""

ROTATED_MODES = tuple(RotatedMode(*signs) for signs in product((-1, 1), repeat=3))
"""Branches of the forward kinematics with link 3' turned, all 8, in the order of the slots of
:func:`tpm_gym.kinematics.rotated.forward_rotated`."""

WORKING_MODES = tuple(WorkingMode(*signs) for signs in product((-1, 1), repeat=4))
"""Branches of the inverse kinematics, all 16, in the order of the slots of :func:`inverse_all`."""

DEFAULT_ASSEMBLY = AssemblyMode(planar=-1, sin_beta=1)
"""Assembly mode of the environments: the platform is at y > 0, on the side z > 0 of the base."""

ELBOWS_OUT = WorkingMode(cos_beta=1, leg1=1, leg2=-1, leg3=1)
"""Working mode of the environments: the elbows point away from the centre, as in a Delta."""


@dataclass(frozen=True)
class ForwardSolutions:
    """All solutions of the forward kinematics, one slot per :data:`ASSEMBLY_MODES` entry.

    Attributes:
        position: (..., 4, 3) m, point P in the paper's frame; NaN where the branch is not real.
            Where the mechanism closes for every beta (see ``free``), x and y are NaN, but z is not.
        beta: (..., 4) rad, passive angle of link 7 in (-pi, pi]; NaN where the branch is not real.
        valid: (..., 4) bool, whether the branch is real.
        geometry: Lengths of the mechanism.
    """

    position: FloatArray
    beta: FloatArray
    valid: BoolArray
    geometry: Geometry

    @property
    def free(self) -> BoolArray:
        """(..., 4) bool, whether the loops of a branch close for every beta.

        They do where a2 = b2 = 0 in Eq. (10). There, the platform can move along a circle with all
        motors locked, and the branch is not valid.
        """
        z = self.position[..., 2]
        found: BoolArray = (z == z) & ~self.valid
        return found

    @property
    def link3(self) -> FloatArray:
        """(..., 4, 2) m, (xC, zC) of point C1 of link 3'; NaN where the branch is not real."""
        g = self.geometry
        ns = namespace_of(self.beta)
        x_c = self.position[..., 0] - g.l2 - g.l7 * ns.cos(self.beta)
        found: FloatArray = ns.stack([x_c, self.position[..., 2] - 2 * g.l6])
        return found


@dataclass(frozen=True)
class InverseSolutions:
    """All solutions of the inverse kinematics, one slot per :data:`WORKING_MODES` entry.

    Attributes:
        theta: (..., 16, 3) rad; NaN where the branch is not real. theta_1 and theta_3 are in
            (-pi, pi], theta_2 is in [0, 2 pi). So an angle jumps by 2 pi where its arm lies in the
            plane of the base and points towards the centre of the base. No posture of practical use
            is near a jump.
        beta: (..., 16) rad, in (-pi, pi]; NaN where the branch is not real.
        valid: (..., 16) bool, whether the branch is real.
    """

    theta: FloatArray
    beta: FloatArray
    valid: BoolArray
