"""Other spanning trees of the same mechanism, for comparison with the default.

All variants have the same links. Only the spanning tree and the joints at the ends of the rods
differ. Each variant has closed-form angles at which its loops close. Solids come from
:func:`tpm_gym.mechanism.tpm.bodies.build`, so that lengths, masses and inertias are defined once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.mechanism.bodies import Closure, Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.tpm.bodies import build, joint_angles

Angles = dict[str, float]

X, MINUS_Y, Z, MINUS_Z = (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
ORIGIN = (0.0, 0.0, 0.0)
SIDES = (("a", 1), ("b", -1))


@dataclass(frozen=True)
class Variant:
    """Mechanism with other cuts of its loops.

    Attributes:
        name: Name in tables.
        mechanism: Links and closures.
        angles: Function of theta (3,) rad that returns the angle of each joint, rad.
        about: Difference from the default.
    """

    name: str
    mechanism: Mechanism
    angles: Callable[[ArrayLike], Angles]
    about: str


@dataclass(frozen=True)
class OneBody(Mechanism):
    """Mechanism whose spanning tree is loaded as one multibody."""

    def legs(self) -> tuple[Mechanism, ...]:
        """Return the whole tree."""
        return (self,)


def one_body(mechanism: Mechanism) -> OneBody:
    """Return the same mechanism, loaded as one multibody."""
    return OneBody(**{f.name: getattr(mechanism, f.name) for f in fields(mechanism) if f.init})


def all_variants() -> tuple[Variant, ...]:
    """Return all variants, the default first."""
    return (
        Variant("three legs", build(), joint_angles, "the default: one multibody a leg"),
        Variant("one body", one_body(build()), joint_angles, "the tree as one multibody"),
        spherical_rods(),
        rods_4_cut_at_arm(),
        spherical_parallelogram(),
        rods_11_cut_at_arm(),
    )


def spherical_rods() -> Variant:
    """Return a variant with balls at both ends of rods 4, which can then spin about themselves."""
    mechanism = build()
    links: list[Link] = []
    for link in mechanism.links:
        joint = link.joint
        if joint is None or not link.name.startswith("rod_4"):
            links.append(link)
            continue
        suffix = link.name[-1]
        # The roll needs a link of its own: the centre of the ball, like the cross that it replaces.
        ball = replace(mechanism.link(f"cross_4{suffix}"), name=f"ball_4{suffix}", joint=joint)
        roll = Joint(f"S{suffix}_roll", "continuous", ball.name, ORIGIN, (0.0, 1.0, 0.0))
        links += [ball, replace(link, joint=roll)]
    return Variant(
        "rods 4 spherical",
        replace(mechanism, links=tuple(links)),
        lambda theta: {**joint_angles(theta), "Sa_roll": 0.0, "Sb_roll": 0.0},
        "balls at both ends of rods 4, which then spin idly",
    )


def rods_4_cut_at_arm() -> Variant:
    """Return a variant whose rods 4 hang on link 3' by universal joints, with balls at the arm."""
    mechanism = build()
    g = PAPER
    links, closures = _without(mechanism, "cross_4", "rod_4"), list(mechanism.closures[2:])
    for suffix, side in SIDES:
        at = ((2 + side) * g.l5, 0.0, 0.0)
        cross = mechanism.link(f"cross_4{suffix}")
        swing = Joint(f"S{suffix}_swing", "continuous", "link_3p", at, X)
        rod = _backwards(mechanism.link(f"rod_4{suffix}"), (0.0, g.l4, 0.0))
        links += [replace(cross, joint=swing), rod]
        foot = (side * g.l5, g.l3, 0.0)
        closures.append(Closure(f"S{suffix}", rod.name, (0.0, -g.l4, 0.0), "arm_2", foot))

    def angles(theta: ArrayLike) -> Angles:
        # Link 3' stays level, so the rods' directions are their joint angles.
        found, theta_1 = joint_angles(theta), float(np.asarray(theta)[0])
        return found | {name: found[name] + theta_1 for name in ("Sa_swing", "Sb_swing")}

    return Variant(
        "rods 4 cut at arm",
        _with(mechanism, links, closures),
        angles,
        "rods 4 hang on link 3', closed by balls at arm 2",
    )


def spherical_parallelogram() -> Variant:
    """Return a variant whose rods 11 have universal joints and balls, as in a Delta robot.

    The end links become parts of arm 12 and of the platform. On the platform the bar moves to the
    middle. At its own place it would give the platform a product of inertia, and the engine would
    turn the frame of the closures' pivots.
    """
    mechanism = build()
    g = PAPER
    links = _without(mechanism, "end_link", "rod_11")
    bars = {
        "arm_12": ("end_link_9", (g.l3, 0.0, 0.0)),
        "platform": ("end_link_10", mechanism.point_p),
    }
    links = [_welded(link, mechanism, bars.get(link.name)) for link in links]
    closures = list(mechanism.closures[:2])
    for suffix, side in SIDES:
        rod = mechanism.link(f"rod_11{suffix}")
        at, across = (g.l3, side * g.l5, 0.0), (2 * g.l2, side * g.l5, 0.0)
        swing = Joint(f"R32{suffix}", "continuous", "arm_12", at, MINUS_Y)
        cross = replace(mechanism.link(f"cross_4{suffix}"), name=f"cross_11{suffix}", joint=swing)
        links += [cross, _hung(rod, cross.name, ORIGIN)]
        closures.append(Closure(f"S11{suffix}", rod.name, (g.l4, 0.0, 0.0), "platform", across))

    def angles(theta: ArrayLike) -> Angles:
        found = joint_angles(theta)
        swing = found.pop("R32")
        del found["R33"]
        return found | {"R32a": swing, "R32b": swing}

    return Variant(
        "rods 11 spherical",
        _with(mechanism, links, closures),
        angles,
        "second parallelogram of spherical joints, as in a Delta robot",
    )


def rods_11_cut_at_arm() -> Variant:
    """Return a variant whose rods 11 hang on end link 10 by revolutes, with balls at end link 9."""
    mechanism = build()
    g = PAPER
    links, closures = _without(mechanism, "rod_11"), list(mechanism.closures[:2])
    for suffix, side in SIDES:
        rod = _backwards(mechanism.link(f"rod_11{suffix}"), (g.l4, 0.0, 0.0))
        at = (0.0, side * g.l5, 0.0)
        links.append(_hung(rod, "end_link_10", at))
        closures.append(Closure(f"S11{suffix}", rod.name, (-g.l4, 0.0, 0.0), "end_link_9", at))
    return Variant(
        "rods 11 cut at arm",
        _with(mechanism, links, closures),
        joint_angles,  # both end links are parallel to the rods' plane, so nothing changes
        "rods 11 hang on end link 10, closed by balls at end link 9",
    )


# -- bricks -----------------------------------------------------------------------------------


def _without(mechanism: Mechanism, *prefixes: str) -> list[Link]:
    return [link for link in mechanism.links if not link.name.startswith(prefixes)]


def _with(mechanism: Mechanism, links: Sequence[Link], closures: Sequence[Closure]) -> Mechanism:
    return replace(mechanism, links=tuple(links), closures=tuple(closures))


def _moved(solid: Solid, by: Vector) -> Solid:
    x, y, z = (a + b for a, b in zip(solid.centre, by, strict=True))
    return replace(solid, centre=(x, y, z))


def _backwards(rod: Link, length: Vector) -> Link:
    """Return a rod with its origin at the other end, so that it points backwards from its joint."""
    x, y, z = length
    return replace(rod, solids=tuple(_moved(solid, (-x, -y, -z)) for solid in rod.solids))


def _hung(link: Link, parent: str, origin: Vector) -> Link:
    """Return a link with its joint elsewhere."""
    assert link.joint is not None
    return replace(link, joint=replace(link.joint, parent=parent, origin=origin))


def _welded(link: Link, mechanism: Mechanism, bar: tuple[str, Vector] | None) -> Link:
    """Return a link with the solids of another link fixed to it."""
    if bar is None:
        return link
    name, at = bar
    return replace(
        link, solids=(*link.solids, *(_moved(solid, at) for solid in mechanism.link(name).solids))
    )


def gaps(mechanism: Mechanism, angles: Mapping[str, ArrayLike]) -> FloatArray:
    """Return the gap of each closure, (closures, ...) m."""
    places = mechanism.places(angles)
    return np.stack(
        [
            np.linalg.norm(
                places[c.link_a].point(c.point_a) - places[c.link_b].point(c.point_b), axis=-1
            )
            for c in mechanism.closures
        ]
    )
