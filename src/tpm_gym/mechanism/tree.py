"""The mechanism as data: links, joints, inertias and loop closures, from a Geometry.

A physics engine for trees needs the loops cut. The spanning tree here follows the paper's
numbering of links (Fig. 1):

    base 0 - arm 2  - two rods 4                                        (branch I, the 4S rods)
    base 0 - arm 5  - rod 6 - link 3' - link 7 - platform 1 - end link 10   (branch II and on)
    base 0 - arm 12 - end link 9 - two rods 11                          (branch III)

and four ball joints close it again: the far ends of rods 4 on link 3', the far ends of rods 11 on
end link 10. A rod with a ball at both ends would spin idly about itself; rods 4 have a universal
joint at the arm instead, which takes that idle freedom out. Rods 11 turn on the paper's revolutes
R_e and R_f; R_g and R_h are closed as balls (cutting them as revolutes would add redundant rows),
which leaves end link 10, a straight bar through both balls, free to roll about its own axis.

All frames are parallel to the paper frame when all joints are at zero: arms and rods then point
along +y (branch I) or +x (branches II, III). Units: metres, radians, kilograms.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.kinematics import DEFAULT_ASSEMBLY, AssemblyMode, passive_angles
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism.bodies import Closure, Link, Vector
from tpm_gym.mechanism.links import CUP_LENGTH, CUP_RADIUS, base, branch_1, branch_2, branch_3

__all__ = [
    "ACTUATED_JOINTS",
    "CUP_LENGTH",
    "CUP_RADIUS",
    "DEFAULT_MOUNT",
    "Mechanism",
    "Mount",
    "build",
    "joint_angles",
]

FloatArray = NDArray[np.float64]

ACTUATED_JOINTS = ("R11", "R21", "R31")
"""The motors, in the order of theta_1, theta_2, theta_3."""


@dataclass(frozen=True)
class Mount:
    """How the base hangs over the table: the one conversion between paper and world frame.

    The base is mounted upside down, a half turn about x: world = (x, -y, height - z).

    Attributes:
        height: Height of the base plane above the table top (world z = 0), m.
    """

    height: float

    def to_world(self, point: ArrayLike) -> FloatArray:
        """Convert points (..., 3) m from the paper frame to the world frame."""
        world: FloatArray = self.rotate(point) + np.array([0.0, 0.0, self.height])
        return world

    def to_paper(self, point: ArrayLike) -> FloatArray:
        """Convert points (..., 3) m from the world frame to the paper frame."""
        return self.rotate(np.asarray(point, dtype=np.float64) - np.array([0.0, 0.0, self.height]))

    def rotate(self, vector: ArrayLike) -> FloatArray:
        """Convert free vectors (..., 3), such as velocities; the half turn is its own inverse."""
        turned: FloatArray = np.multiply(vector, _HALF_TURN, dtype=np.float64)
        return turned

    def swap(self, point: Vector) -> Vector:
        """One point from either frame to the other, in plain floats: a half turn undoes itself."""
        x, y, z = point
        return x, -y, self.height - z

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Orientation of the paper frame in the world, (x, y, z, w)."""
        return (1.0, 0.0, 0.0, 0.0)


_HALF_TURN = np.array([1.0, -1.0, -1.0])

DEFAULT_MOUNT = Mount(height=0.97)
"""The cup touches the table at z = 0.93 m of the paper frame, well inside the reach."""


@dataclass(frozen=True)
class Mechanism:
    """Everything an engine needs to build the mechanism.

    Attributes:
        geometry: The lengths it was built from.
        links: Parents before children; the first is the base.
        closures: The ball joints that close the loops.
        platform: Name of the platform link.
        point_p: Point P in the platform's frame, m.
        tool: Name of the link that slides in the platform, with the vacuum cup.
        lip: Centre of the cup's lip in the tool's frame, m.
    """

    geometry: Geometry
    links: tuple[Link, ...]
    closures: tuple[Closure, ...]
    platform: str
    point_p: Vector
    tool: str
    lip: Vector
    _index: dict[str, int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Index the links by name."""
        object.__setattr__(self, "_index", {link.name: i for i, link in enumerate(self.links)})

    def link(self, name: str) -> Link:
        """The link of that name.

        Raises:
            KeyError: If there is none.
        """
        return self.links[self._index[name]]

    def legs(self) -> tuple[Mechanism, ...]:
        """The spanning tree taken apart at the base: one tree for each arm and what hangs on it."""
        arm: dict[str, str] = {}
        for link in self.links[1:]:
            joint = link.joint
            assert joint is not None
            arm[link.name] = arm.get(joint.parent, link.name)
        return tuple(
            replace(
                self, links=(self.links[0], *(k for k in self.links[1:] if arm[k.name] == name))
            )
            for name in dict.fromkeys(arm.values())
        )


def build(geometry: Geometry = PAPER) -> Mechanism:
    """Build the mechanism for the given lengths.

    Sections and materials do not scale with the lengths: they are those of a machine of the size
    of the paper's case study.
    """
    g = geometry
    links = (
        base(g),
        *branch_1(g),
        *branch_2(g),
        *branch_3(g),
    )
    closures = (
        Closure("Sc", "rod_4a", (0.0, g.l4, 0.0), "link_3p", (3 * g.l5, 0.0, 0.0)),
        Closure("Sd", "rod_4b", (0.0, g.l4, 0.0), "link_3p", (g.l5, 0.0, 0.0)),
        Closure("Rg", "rod_11a", (g.l4, 0.0, 0.0), "end_link_10", (0.0, g.l5, 0.0)),
        Closure("Rh", "rod_11b", (g.l4, 0.0, 0.0), "end_link_10", (0.0, -g.l5, 0.0)),
    )
    return Mechanism(
        geometry=g,
        links=links,
        closures=closures,
        platform="platform",
        point_p=(g.l2, 0.0, g.l6),
        tool="cup",
        lip=(0.0, 0.0, CUP_LENGTH),
    )


def joint_angles(
    theta: ArrayLike, branch: AssemblyMode = DEFAULT_ASSEMBLY, geometry: Geometry = PAPER
) -> dict[str, float]:
    """Angles of all joints of the spanning tree at which the loops close.

    Args:
        theta: (3,) rad, actuated angles.
        branch: The assembly mode.
        geometry: Link lengths.

    Returns:
        Joint name -> rad (m for the cup's slide), for every joint of :func:`build` that moves.

    Raises:
        InputError: If theta has the wrong shape or is not finite.
        UnreachableError: If the branch does not exist at theta.
    """
    passive = passive_angles(theta, branch, geometry)
    theta_1, theta_2, theta_3 = np.asarray(theta, dtype=np.float64)
    # Absolute directions become joint angles by subtracting the parent's direction.
    angles = {
        "R11": theta_1,
        "Sa_swing": passive.rod4_swing - theta_1,
        "Sa_tilt": passive.rod4_tilt,
        "Sb_swing": passive.rod4_swing - theta_1,
        "Sb_tilt": passive.rod4_tilt,
        "R21": theta_2,
        "R22": passive.rod6_swing - theta_2,
        "R23": -passive.rod6_swing,
        "R12": passive.beta,
        "R13": -passive.beta,
        "cup_slide": 0.0,
        "R33": passive.rod11_swing,  # end links 9 and 10 stay parallel
        "R31": theta_3,
        "R32": passive.rod11_swing - theta_3,
        "Re": passive.rod11_tilt,
        "Rf": passive.rod11_tilt,
    }
    return {name: float(angle) for name, angle in angles.items()}
