"""URDF text of a Mechanism, and the file of loop closures beside it.

URDF describes trees only. The tree written here has a massless link at each end of each closure.
The second file pairs these links in the extended-URDF convention of Gepetto's
example-parallel-robots: ``closed_loop`` lists pairs of frames, ``type`` gives the kind of each
closure (``3d``: the origins coincide, as in a ball joint), and ``name_mot`` names the motors'
joints. With the two files alone, Pinocchio closes the loops:
``completeRobotLoader(folder, "tpm.urdf", "tpm.loops.yaml")``. The files do not contain gravity. The
base hangs upside down over a table, so objects fall along +z.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Final
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.bodies import LEVEL, Closure, Joint, Link, Mechanism, Solid

_CLOSING = """
  A tree, whose loops are to be closed: {0}.loops.yaml pairs frames whose origins shall coincide.
  At angles of 0 they do not. Angles where they do are in {0}.xml, for one posture (the key frame
  "home"), and in joint_positions(theta) of tpm_gym's machine, for any angles of the motors.

  PyBullet: a point-to-point constraint for each pair; erp=1, and 300 iterations of its own solver,
  or more. Its direct ones lose loops within one body (docs/loops.md), which this is.
  """

COLOURS = {
    "white": (0.72, 0.76, 0.82, 1.0),
    "light": (0.80, 0.83, 0.87, 1.0),
    "grey": (0.55, 0.57, 0.60, 1.0),
    "steel": (0.62, 0.65, 0.70, 1.0),
    "dark": (0.18, 0.20, 0.24, 1.0),
    "carbon": (0.25, 0.26, 0.30, 1.0),
    "orange": (0.95, 0.49, 0.09, 1.0),
    "blue": (0.12, 0.42, 0.78, 1.0),
    "yellow": (0.97, 0.77, 0.14, 1.0),
    "violet": (0.46, 0.25, 0.72, 1.0),
    "red": (0.83, 0.18, 0.33, 1.0),
}

_END: Final = 0.002
"""Length of each of the two end pieces of a cylinder, m; they are separate collision shapes.

PyBullet finds at most one new contact between two shapes in a time step. If an upright cylinder
hits a wall, this contact can be anywhere on the cylinder's height. So without end pieces, a cup
whose lip hits a block could get its contact far above the lip.
"""

_MOMENTS = {f"i{'xyz'[i]}{'xyz'[j]}": (i, j) for i in range(3) for j in range(i, 3)}


def urdf_text(mechanism: Mechanism, closure_frames: bool = False) -> str:
    """Write the spanning tree as URDF, in the machine's frame.

    If ``closure_frames`` is true, add two frames for each closure; :func:`loops_text` names them.
    """
    root = Element("robot", name=mechanism.name)
    root.append(Comment(" Generated from tpm_gym.mechanism; do not edit (make urdf). "))
    root.append(Comment(" z points down: where the robot hangs, gravity is along +z. "))
    if closure_frames:
        root.append(Comment(_CLOSING.format(mechanism.name)))
    for name, rgba in COLOURS.items():
        add(add(root, "material", name=name), "color", rgba=rgba)
    for link in mechanism.links:
        _add_link(root, link)
    for link in mechanism.links:
        if link.joint is not None:
            _add_joint(root, link.joint, link.name)
    if closure_frames:
        for closure in mechanism.closures:
            for side in _sides(closure):
                _add_frame(root, *side)
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n"


def add(parent: Element, tag: str, **values: str | float | Iterable[float]) -> Element:
    """Add an element; the values of its attributes are text, a number or several numbers."""
    return SubElement(parent, tag, {name: _text(value) for name, value in values.items()})


def _text(value: str | float | Iterable[float]) -> str:
    if isinstance(value, str):
        return value
    return numbers(value if isinstance(value, Iterable) else (value,))


def loops_text(mechanism: Mechanism) -> str:
    """Write loop closures and motors as YAML.

    The text belongs to the URDF that :func:`urdf_text` writes with ``closure_frames=True``.
    """
    pairs = [[name for name, *_ in _sides(closure)] for closure in mechanism.closures]
    lines = ["# Generated from tpm_gym.mechanism; do not edit (make urdf)."]
    lines += ["# Pairs of frames of the URDF whose origins coincide (3d).", "closed_loop:"]
    lines += [f"  - [{a}, {b}]" for a, b in pairs]
    lines.append(f"type: [{', '.join(['3d'] * len(mechanism.closures))}]")
    lines.append(f"name_mot: [{', '.join(mechanism.actuated)}]")
    return "\n".join(lines) + "\n"


def numbers(values: Iterable[float]) -> str:
    """Format numbers with nine significant digits (a nanometre in a metre), without ``-0``."""
    return " ".join(f"{float(v) + 0.0:.9g}" if abs(v) > 1e-15 else "0" for v in values)


def _sides(closure: Closure) -> tuple[tuple[str, str, Vector], tuple[str, str, Vector]]:
    """Return both frames of a closure: name, link, and place in the link's frame, m."""
    name = f"closedloop_{closure.name}"
    return (
        (f"{name}_A", closure.link_a, closure.point_a),
        (f"{name}_B", closure.link_b, closure.point_b),
    )


def _add_frame(root: Element, name: str, parent: str, point: Vector) -> None:
    """Add a massless link at ``point`` (m) of the link ``parent``, with a fixed joint."""
    inertial = add(add(root, "link", name=name), "inertial")  # else some loaders assume 1 kg
    add(inertial, "mass", value=0)
    add(inertial, "inertia", **dict.fromkeys(_MOMENTS, 0))
    joint = add(root, "joint", name=f"{name}_frame", type="fixed")
    add(joint, "parent", link=parent)
    add(joint, "child", link=name)
    add(joint, "origin", xyz=point, rpy=LEVEL)


def _add_link(root: Element, link: Link) -> None:
    element = add(root, "link", name=link.name)
    inertial, moments = add(element, "inertial"), link.inertia
    add(inertial, "origin", xyz=link.centre_of_mass, rpy=LEVEL)
    add(inertial, "mass", value=link.mass)
    add(inertial, "inertia", **{name: moments[at] for name, at in _MOMENTS.items()})
    for solid in link.solids:
        add(_add_solid(element, "visual", solid), "material", name=solid.colour)
        if solid.collides:
            for shape in _collision_shapes(solid):
                _add_solid(element, "collision", shape)


def _collision_shapes(solid: Solid) -> list[Solid]:
    """Return a box as one shape, and a cylinder as three: its ends, and the part between them."""
    radius, length, _ = solid.size
    if solid.kind == "box" or length <= 2 * _END:
        return [solid]
    along, away = solid.rotation[:, 2], (length - _END) / 2
    parts = []
    for place, height in ((-away, _END), (0.0, length - 2 * _END), (away, _END)):
        x, y, z = (solid.centre + place * along).tolist()
        parts.append(replace(solid, size=(radius, height, 0.0), centre=(x, y, z)))
    return parts


def _add_solid(link: Element, tag: str, solid: Solid) -> Element:
    element = add(link, tag)
    add(element, "origin", xyz=solid.centre, rpy=_rpy(solid))
    shape = add(element, "geometry")
    if solid.kind == "box":
        add(shape, "box", size=solid.size)
    else:
        add(shape, "cylinder", radius=solid.size[0], length=solid.size[1])
    return element


def _rpy(solid: Solid) -> Vector:
    """Return roll, pitch and yaw (rad) of a solid in its link; cylinders in URDF are along z."""
    turn = solid.rotation
    pitch = math.asin(max(-1.0, min(1.0, -turn[2, 0])))
    if abs(turn[2, 0]) > 1 - 1e-12:  # roll and yaw turn about one axis: roll is set to 0
        return 0.0, pitch, math.atan2(-turn[0, 1], turn[1, 1])
    return math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0])


def _add_joint(root: Element, joint: Joint, link: str) -> None:
    element = add(root, "joint", name=joint.name, type=joint.kind)
    add(element, "parent", link=joint.parent)
    add(element, "child", link=link)
    add(element, "origin", xyz=joint.origin, rpy=joint.rpy)
    add(element, "axis", xyz=joint.axis)
    if joint.kind != "continuous":
        limits = {"lower": joint.lower, "upper": joint.upper}
        add(element, "limit", **limits, effort=joint.effort, velocity=joint.speed)
