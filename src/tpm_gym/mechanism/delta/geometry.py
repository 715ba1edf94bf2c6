"""Five lengths that define a Delta, with their checks, and the modes of a Delta."""

from dataclasses import dataclass
from typing import Final, NamedTuple

from tpm_gym.arrays import is_number, vector
from tpm_gym.errors import GeometryError, InputError
from tpm_gym.kinematics.equations import Triple
from tpm_gym.kinematics.namespaces import Numbers


class DeltaLengths(NamedTuple):
    """Lengths l1 to l5, m, as any kind of numbers, such as tensors, without checks."""

    l1: Numbers
    l2: Numbers
    l3: Numbers
    l4: Numbers
    l5: Numbers


@dataclass(frozen=True)
class DeltaGeometry:
    """Lengths of a Delta, m, with the names of the corresponding lengths of the paper's mechanism.

    Attributes:
        l1: Radius of the base: distance from O to each actuated pivot A_i.
        l2: Radius of the platform: distance from P to C_i; may be zero.
        l3: Length of the actuated arms A_iB_i.
        l4: Length of the rods B_iC_i.
        l5: Half the distance between the two rods of a leg. It does not change the kinematics.

    Raises:
        GeometryError: If a length is no finite positive number (l2 may be 0), or if the rods are
            too short for any assembly.
    """

    l1: float
    l2: float
    l3: float
    l4: float
    l5: float

    def __post_init__(self) -> None:
        """Reject lengths that make no mechanism."""
        for name, value in vars(self).items():
            if not is_number(value) or value < 0 or (value == 0 and name != "l2"):
                least = "not negative" if name == "l2" else "positive"
                raise GeometryError(name, value, f"it must be a finite number, {least}")
            object.__setattr__(self, name, float(value))  # no key is added
        shortest = abs(self.l1 - self.l2) - self.l3
        if self.l4 <= shortest:
            raise GeometryError("l4", self.l4, f"it must exceed |l1 - l2| - l3 = {shortest} m")

    @property
    def lengths(self) -> DeltaLengths:
        """l1 to l5, m."""
        return DeltaLengths(*vars(self).values())


AnyDelta = DeltaGeometry | DeltaLengths

WORKING_MODES: Final[tuple[Triple, ...]] = tuple(
    (one, two, three) for one in (-1.0, 1.0) for two in (-1.0, 1.0) for three in (-1.0, 1.0)
)
"""Eight working modes: for each leg, the sign of B_iC_i . dB_i/dtheta_i; 1 if the elbow is out."""
ELBOWS_OUT: Final[Triple] = (1.0, 1.0, 1.0)
ASSEMBLY_MODES: Final = (-1.0, 1.0)
"""Two assembly modes: the sign of det A, where A has the rows B_iC_i. The sign is 1 if P is below
the elbows."""


def require_delta(geometry: object) -> None:
    """Raise InputError if the argument does not hold the lengths of a Delta."""
    if not isinstance(geometry, AnyDelta):
        raise InputError("geometry", geometry, "a DeltaGeometry")


def require_bends(bends: object) -> Triple:
    """Return three signs as a member of WORKING_MODES.

    Raises:
        InputError: If ``bends`` is not three numbers that are 1 or -1.
    """
    one, two, three = vector("bends", bends)  # type: ignore[arg-type]
    if (one, two, three) not in WORKING_MODES:
        raise InputError("bends", bends, "three signs, each 1 or -1")
    return one, two, three


def require_side(side: object) -> None:
    """Raise InputError if the argument is no member of ASSEMBLY_MODES."""
    if not is_number(side) or side not in ASSEMBLY_MODES:
        raise InputError("side", side, "1 or -1, the sign of det A")


IRB_360 = DeltaGeometry(l1=0.164, l2=0.044, l3=0.524, l4=1.244, l5=0.050)
"""ABB's FlexPicker IRB 360-1/1600, with the lengths that R. L. Williams II gives in "The Delta
Parallel Robot: Kinematics Solutions" (Ohio University, 2016). The base is a triangle with sides of
0.567 m, whose inscribed circle has the radius l1. The platform is a triangle with sides of 0.076 m,
whose circumscribed circle has the radius l2. Arms are 0.524 m long, and rods 1.244 m. Programs that
others wrote after his paper have the same numbers, for example
giridharanponnuvel/Delta-Robot-Inverse-Kinematics on GitHub. We chose l5 ourselves. In his paper,
half the distance between the two rods of a leg is 65.5 mm; with this value, the ball joints of our
rods would touch on the platform."""
