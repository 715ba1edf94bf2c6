"""URDF text of a Mechanism, and the file of loop closures beside it.

URDF knows trees only. The closures are written in the manner of the extended-URDF convention
(a list ``closed_loop`` of frame pairs, ``type: 3d`` for ball joints, and ``name_mot`` for the
motors), so that other tools can close the loops too.

Run ``python -m tpm_gym.mechanism.urdf FOLDER`` to write both files.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

from tpm_gym.mechanism.bodies import Link, Mechanism, Solid
from tpm_gym.mechanism.tree import build

__all__ = ["COLOURS", "LOOPS_FILE", "URDF_FILE", "loops_text", "urdf_text", "write"]

URDF_FILE, LOOPS_FILE = "tpm.urdf", "tpm.loops.yaml"

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


def urdf_text(mechanism: Mechanism) -> str:
    """The spanning tree as URDF, in the paper frame."""
    root = ElementTree.Element("robot", name="tpm")
    root.append(ElementTree.Comment(" Generated from tpm_gym.mechanism; do not edit (make urdf). "))
    for name, rgba in COLOURS.items():
        material = ElementTree.SubElement(root, "material", name=name)
        ElementTree.SubElement(material, "color", rgba=_numbers(rgba))
    for link in mechanism.links:
        root.append(_link_element(link))
    for link in mechanism.links:
        if link.joint is not None:
            root.append(_joint_element(link))
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def loops_text(mechanism: Mechanism) -> str:
    """The loop closures and the motors as YAML."""
    lines = ["# Generated from tpm_gym.mechanism; do not edit (make urdf).", "name_mot:"]
    lines += [f"  - {name}" for name in mechanism.actuated]
    lines.append("closed_loop:")
    for closure in mechanism.closures:
        lines += [
            f"  - name: {closure.name}",
            "    type: 3d",
            f"    links: [{closure.link_a}, {closure.link_b}]",
            "    points:  # m, in the frames of the two links",
            f"      - [{_numbers(closure.point_a, ', ')}]",
            f"      - [{_numbers(closure.point_b, ', ')}]",
        ]
    return "\n".join(lines) + "\n"


def write(folder: Path, mechanism: Mechanism | None = None) -> tuple[Path, Path]:
    """Write both files into ``folder`` (created if missing); the default is the paper's robot.

    Returns:
        The paths of the URDF and of the closures file.
    """
    mechanism = mechanism or build()
    folder.mkdir(parents=True, exist_ok=True)
    urdf, loops = folder / URDF_FILE, folder / LOOPS_FILE
    urdf.write_text(urdf_text(mechanism), encoding="utf-8", newline="\n")
    loops.write_text(loops_text(mechanism), encoding="utf-8", newline="\n")
    return urdf, loops


def _link_element(link: Link) -> ElementTree.Element:
    element = ElementTree.Element("link", name=link.name)
    inertial = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers(link.centre_of_mass), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=_number(link.mass))
    moments = link.inertia
    names = {
        "ixx": (0, 0),
        "ixy": (0, 1),
        "ixz": (0, 2),
        "iyy": (1, 1),
        "iyz": (1, 2),
        "izz": (2, 2),
    }
    ElementTree.SubElement(
        inertial, "inertia", {name: _number(moments[at]) for name, at in names.items()}
    )
    for solid in link.solids:
        element.append(_solid_element("visual", solid))
        if solid.collides:
            element.append(_solid_element("collision", solid))
    return element


def _solid_element(tag: str, solid: Solid) -> ElementTree.Element:
    element = ElementTree.Element(tag)
    rpy = _AXIS_RPY[solid.axis] if solid.kind == "cylinder" else (0.0, 0.0, 0.0)
    ElementTree.SubElement(element, "origin", xyz=_numbers(solid.centre), rpy=_numbers(rpy))
    shape = ElementTree.SubElement(element, "geometry")
    if solid.kind == "box":
        ElementTree.SubElement(shape, "box", size=_numbers(solid.size))
    else:
        radius, length, _ = solid.size
        ElementTree.SubElement(shape, "cylinder", radius=_number(radius), length=_number(length))
    if tag == "visual":
        ElementTree.SubElement(element, "material", name=solid.colour)
    return element


def _joint_element(link: Link) -> ElementTree.Element:
    joint = link.joint
    if joint is None:
        raise TypeError(f"the base {link.name!r} has no joint")
    element = ElementTree.Element("joint", name=joint.name, type=joint.kind)
    ElementTree.SubElement(element, "parent", link=joint.parent)
    ElementTree.SubElement(element, "child", link=link.name)
    ElementTree.SubElement(element, "origin", xyz=_numbers(joint.origin), rpy="0 0 0")
    ElementTree.SubElement(element, "axis", xyz=_numbers(joint.axis))
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


def _number(value: float) -> str:
    """Nine significant digits: a nanometre in a metre; never ``-0``."""
    return f"{float(value) + 0.0:.9g}" if abs(value) > 1e-15 else "0"


def _numbers(values: Iterable[float], separator: str = " ") -> str:
    return separator.join(_number(value) for value in values)


def main() -> None:
    """Write both files for the paper's robot."""
    parser = argparse.ArgumentParser(description="Write the URDF and its loop closures.")
    parser.add_argument("folder", type=Path)
    for path in write(parser.parse_args().folder):
        print(path)


if __name__ == "__main__":
    main()
