"""URDF text of a Mechanism, and the file of loop closures beside it.

URDF describes trees only. Ours has a massless link at either end of each closure. The file beside
it pairs these links in the extended-URDF convention of Gepetto's example-parallel-robots:
``closed_loop`` lists pairs of frames, ``type`` gives the kind of each closure (``3d``: the origins
coincide, as in a ball joint), and ``name_mot`` names the motors' joints. Pinocchio closes the loops
from the two files alone, by ``completeRobotLoader(folder, "tpm.urdf", "tpm.loops.yaml")``. The
files do not contain gravity. The base hangs upside down over a table, so objects fall along +z.

Run ``python -m tpm_gym.mechanism.urdf FOLDER`` to write both files.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from tpm_gym.arrays import Vector
from tpm_gym.mechanism.bodies import Link, Mechanism, Solid
from tpm_gym.mechanism.tree import build

__all__ = ["COLOURS", "LOOPS_FILE", "URDF_FILE", "loops_text", "numbers", "urdf_text", "write"]

URDF_FILE, LOOPS_FILE = "tpm.urdf", "tpm.loops.yaml"

_CLOSING = f"""
  A tree, whose loops are to be closed: {LOOPS_FILE} pairs the frames whose origins shall coincide.
  At angles of 0 they do not. Angles where they do are in tpm.xml, for one posture (the key frame
  "home"), and in tpm_gym.PAPER_TPM.joint_positions(theta), for any angles of the motors.

  PyBullet: a point-to-point constraint for each pair; erp=1, and 300 iterations of its own solver,
  or more. Its direct ones lose loops within one body (docs/fidelity.md), which this is.
  """

COLOURS = {
    "white": (0.72, 0.76, 0.82, 1.0),
    "light": (0.80, 0.83, 0.87, 1.0),
    "grey": (0.55, 0.57, 0.60, 1.0),
    "steel": (0.62, 0.65, 0.70, 1.0),
    "dark": (0.18, 0.20, 0.24, 1.0),
    "carbon": (0.12, 0.12, 0.14, 1.0),
    "orange": (0.95, 0.49, 0.09, 1.0),
    "blue": (0.12, 0.42, 0.78, 1.0),
    "yellow": (0.97, 0.77, 0.14, 1.0),
    "red": (0.80, 0.13, 0.18, 1.0),
}

# Roll, pitch, yaw that turn a URDF cylinder (along z) onto the named axis.
_AXIS_RPY = {
    "x": (0.0, 1.5707963267948966, 0.0),
    "y": (1.5707963267948966, 0.0, 0.0),
    "z": (0.0, 0.0, 0.0),
}

_MOMENTS = {
    "ixx": (0, 0),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyy": (1, 1),
    "iyz": (1, 2),
    "izz": (2, 2),
}


def urdf_text(mechanism: Mechanism, closure_frames: bool = False) -> str:
    """Write the spanning tree as URDF, in the paper frame.

    Args:
        closure_frames: Whether to add the frames that :func:`loops_text` pairs.
    """
    root = Element("robot", name="tpm")
    root.append(ElementTree.Comment(" Generated from tpm_gym.mechanism; do not edit (make urdf). "))
    root.append(ElementTree.Comment(" z points down: where the robot hangs, gravity is along +z. "))
    if closure_frames:
        root.append(ElementTree.Comment(_CLOSING))
    for name, rgba in COLOURS.items():
        material = ElementTree.SubElement(root, "material", name=name)
        ElementTree.SubElement(material, "color", rgba=numbers(rgba))
    for link in mechanism.links:
        root.append(_link_element(link))
    for link in mechanism.links:
        if link.joint is not None:
            root.append(_joint_element(link))
    if closure_frames:
        for name, parent, point in _closure_frames(mechanism):
            root.extend(_frame_elements(name, parent, point))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def loops_text(mechanism: Mechanism) -> str:
    """Write loop closures and motors as YAML, for the URDF with its closure frames."""
    names = [name for name, _, _ in _closure_frames(mechanism)]
    pairs = zip(names[::2], names[1::2], strict=True)
    lines = ["# Generated from tpm_gym.mechanism; do not edit (make urdf)."]
    lines += ["# Pairs of frames of the URDF whose origins coincide (3d).", "closed_loop:"]
    lines += [f"  - [{a}, {b}]" for a, b in pairs]
    lines.append(f"type: [{', '.join(['3d'] * len(mechanism.closures))}]")
    lines.append(f"name_mot: [{', '.join(mechanism.actuated)}]")
    return "\n".join(lines) + "\n"


def write(folder: Path, mechanism: Mechanism | None = None) -> tuple[Path, Path]:
    """Write both files into ``folder`` (created if missing); the default is the paper's robot.

    Returns:
        The paths of the URDF and of the closures file.
    """
    mechanism = mechanism or build()
    folder.mkdir(parents=True, exist_ok=True)
    urdf, loops = folder / URDF_FILE, folder / LOOPS_FILE
    urdf.write_text(urdf_text(mechanism, closure_frames=True), encoding="utf-8", newline="\n")
    loops.write_text(loops_text(mechanism), encoding="utf-8", newline="\n")
    return urdf, loops


def numbers(values: Iterable[float]) -> str:
    """Format numbers with nine significant digits (a nanometre in a metre), without ``-0``."""
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return f"{float(value) + 0.0:.9g}" if abs(value) > 1e-15 else "0"


def _closure_frames(mechanism: Mechanism) -> list[tuple[str, str, Vector]]:
    """List both sides of each closure in turn: name, link, and place in the link's frame, m."""
    return [
        (f"closedloop_{closure.name}_{side}", link, point)
        for closure in mechanism.closures
        for side, link, point in (
            ("A", closure.link_a, closure.point_a),
            ("B", closure.link_b, closure.point_b),
        )
    ]


def _frame_elements(name: str, parent: str, point: Vector) -> tuple[Element, Element]:
    """Build a massless link at ``point`` (m) of another, and the joint that fixes it there."""
    link = Element("link", name=name)
    inertial = ElementTree.SubElement(link, "inertial")  # without it, some loaders assume 1 kg
    ElementTree.SubElement(inertial, "mass", value="0")
    ElementTree.SubElement(inertial, "inertia", dict.fromkeys(_MOMENTS, "0"))
    joint = Element("joint", name=f"{name}_frame", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=name)
    ElementTree.SubElement(joint, "origin", xyz=numbers(point), rpy="0 0 0")
    return link, joint


def _link_element(link: Link) -> Element:
    element = Element("link", name=link.name)
    inertial = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=numbers(link.centre_of_mass), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_number(link.mass))
    moments = link.inertia
    ElementTree.SubElement(
        inertial, "inertia", {name: _number(moments[at]) for name, at in _MOMENTS.items()}
    )
    for solid in link.solids:
        element.append(_solid_element("visual", solid))
        if solid.collides:
            element.append(_solid_element("collision", solid))
    return element


def _solid_element(tag: str, solid: Solid) -> Element:
    element = Element(tag)
    rpy = _AXIS_RPY[solid.axis] if solid.kind == "cylinder" else (0.0, 0.0, 0.0)
    ElementTree.SubElement(element, "origin", xyz=numbers(solid.centre), rpy=numbers(rpy))
    shape = ElementTree.SubElement(element, "geometry")
    if solid.kind == "box":
        ElementTree.SubElement(shape, "box", size=numbers(solid.size))
    else:
        radius, length, _ = solid.size
        ElementTree.SubElement(shape, "cylinder", radius=_number(radius), length=_number(length))
    if tag == "visual":
        ElementTree.SubElement(element, "material", name=solid.colour)
    return element


def _joint_element(link: Link) -> Element:
    joint = link.joint
    if joint is None:
        raise TypeError(f"the base {link.name!r} has no joint")
    element = Element("joint", name=joint.name, type=joint.kind)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=link.name)
    ElementTree.SubElement(element, "origin", xyz=numbers(joint.origin), rpy="0 0 0")
    ElementTree.SubElement(element, "axis", xyz=numbers(joint.axis))
    if joint.kind != "continuous":
        ElementTree.SubElement(
            element,
            "limit",
            lower=_number(joint.lower),
            upper=_number(joint.upper),
            effort=_number(joint.effort),
            velocity=_number(joint.speed),
        )
    return element


def main() -> None:
    """Write both files for the paper's robot."""
    parser = argparse.ArgumentParser(description="Write the URDF and its loop closures.")
    parser.add_argument("folder", type=Path)
    for path in write(parser.parse_args().folder):
        print(path)


if __name__ == "__main__":
    main()
