"""The files in urdf/ are what the mechanism's data give, number by number."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism.tree import ACTUATED_JOINTS, Mechanism, build
from tpm_gym.mechanism.urdf import COLOURS, LOOPS_FILE, URDF_FILE, loops_text, urdf_text, write
from tpm_gym.resources import URDF as FOLDER

OTHER = Geometry(l1=0.31, l2=0.06, l3=0.4, l4=0.9, l5=0.12, l6=0.0, l7=0.08)
DIGITS = {"rel": 1e-8, "abs": 1e-14}


def numbers(text: str | None) -> list[float]:
    assert text is not None
    return [float(word) for word in text.split()]


def child(element: ElementTree.Element, path: str) -> ElementTree.Element:
    found = element.find(path)
    assert found is not None, path
    return found


def parsed(mechanism: Mechanism) -> ElementTree.Element:
    return ElementTree.fromstring(urdf_text(mechanism))


@pytest.fixture(params=[PAPER, OTHER], ids=["paper", "other"])
def mechanism(request: pytest.FixtureRequest) -> Mechanism:
    return build(request.param)


def test_regenerating_gives_the_shipped_files_byte_for_byte(tmp_path: Path) -> None:
    for path in write(tmp_path / "new"):
        assert path.read_bytes() == (FOLDER / path.name).read_bytes()
    assert {path.name for path in FOLDER.iterdir()} >= {URDF_FILE, LOOPS_FILE}
    texts = [path.read_text() for path in write(tmp_path, build(OTHER))]
    assert texts == [urdf_text(build(OTHER), closure_frames=True), loops_text(build(OTHER))]


def test_joints_are_those_of_the_tree(mechanism: Mechanism) -> None:
    elements = {e.get("name"): e for e in parsed(mechanism).findall("joint")}
    held = [link for link in mechanism.links if link.joint]
    assert len(elements) == len(held)
    for link in held:
        joint = link.joint
        assert joint is not None
        element = elements[joint.name]
        assert element.get("type") == joint.kind
        assert child(element, "parent").get("link") == joint.parent
        assert child(element, "child").get("link") == link.name
        assert numbers(child(element, "origin").get("xyz")) == pytest.approx(joint.origin, **DIGITS)
        assert numbers(child(element, "origin").get("rpy")) == [0, 0, 0]
        assert numbers(child(element, "axis").get("xyz")) == list(joint.axis)
        limit = element.find("limit")
        assert (limit is not None) == (joint.kind in ("revolute", "prismatic"))
        if limit is not None:
            names = {"lower": "lower", "upper": "upper", "effort": "effort", "velocity": "speed"}
            for attribute, field in names.items():
                expected = [getattr(joint, field)]
                assert numbers(limit.get(attribute)) == pytest.approx(expected, **DIGITS)


def cylinder_axis(rpy: Sequence[float]) -> np.ndarray:
    """Where roll, pitch, yaw turn the z axis."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])


def assert_same_solid(element: ElementTree.Element, solid: Any) -> None:
    origin = child(element, "origin")
    assert numbers(origin.get("xyz")) == pytest.approx(solid.centre, **DIGITS)
    rpy = numbers(origin.get("rpy"))
    if solid.kind == "box":
        assert rpy == [0, 0, 0]
        size = numbers(child(element, "geometry/box").get("size"))
        assert size == pytest.approx(solid.size, **DIGITS)
    else:
        along = np.abs(cylinder_axis(rpy))
        np.testing.assert_allclose(along, np.eye(3)["xyz".index(solid.axis)], atol=1e-8)
        shape = child(element, "geometry/cylinder")
        found = numbers(shape.get("radius")) + numbers(shape.get("length"))
        assert found == pytest.approx(solid.size[:2], **DIGITS)


def test_solids_are_drawn_as_they_are_and_collide_where_they_should(mechanism: Mechanism) -> None:
    root, used = parsed(mechanism), set()
    for element, link in zip(root.findall("link"), mechanism.links, strict=True):
        for visual, solid in zip(element.findall("visual"), link.solids, strict=True):
            assert_same_solid(visual, solid)
            material = child(visual, "material").get("name")
            assert material == solid.colour
            used.add(material)
        colliding = [solid for solid in link.solids if solid.collides]
        for collision, solid in zip(element.findall("collision"), colliding, strict=True):
            assert_same_solid(collision, solid)
    assert used <= set(COLOURS)
    found = {
        material.get("name"): tuple(numbers(child(material, "color").get("rgba")))
        for material in root.findall("material")
    }
    assert found == COLOURS


def test_loops_file_names_the_motors_and_pairs_massless_frames_at_the_closures(
    mechanism: Mechanism,
) -> None:
    content = yaml.safe_load(loops_text(mechanism))
    assert set(content) == {"closed_loop", "type", "name_mot"}
    assert content["name_mot"] == list(ACTUATED_JOINTS)
    assert content["type"] == ["3d"] * len(mechanism.closures)
    root = ElementTree.fromstring(urdf_text(mechanism, closure_frames=True))
    links = {element.get("name"): element for element in root.findall("link")}
    held = {child(element, "child").get("link"): element for element in root.findall("joint")}
    for pair, closure in zip(content["closed_loop"], mechanism.closures, strict=True):
        sides = ((closure.link_a, closure.point_a), (closure.link_b, closure.point_b))
        for name, (link, point) in zip(pair, sides, strict=True):
            joint, inertial = held[name], child(links.pop(name), "inertial")
            assert joint.get("type") == "fixed"
            assert child(joint, "parent").get("link") == link
            origin = child(joint, "origin")
            assert numbers(origin.get("xyz")) == pytest.approx(point, **DIGITS)
            assert numbers(origin.get("rpy")) == [0, 0, 0]
            assert child(inertial, "mass").get("value") == "0"
            assert set(child(inertial, "inertia").attrib.values()) == {"0"}
    # Nothing else is added, and nothing is for the engine, which closes the loops by itself.
    assert list(links) == [link.name for link in mechanism.links]
    assert set(held) - {name for pair in content["closed_loop"] for name in pair} == {
        element.get("link") for element in parsed(mechanism).findall("joint/child")
    }


def test_no_number_is_a_negative_zero(mechanism: Mechanism) -> None:
    assert "-0" not in urdf_text(mechanism, closure_frames=True).replace('"', " ").split()
