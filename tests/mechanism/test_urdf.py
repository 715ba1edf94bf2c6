"""The files in urdf/ are what the mechanism's data give, number by number."""

from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from walk import turned

from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism.bodies import Joint, Link, Solid
from tpm_gym.mechanism.export import SHIPPED, write
from tpm_gym.mechanism.tpm.bodies import Mechanism, build
from tpm_gym.mechanism.urdf import COLOURS, urdf_text
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
def mechanism(request):
    return build(request.param)


TURNS = [(0.3, -0.7, 2.0), (0.0, 0.0, 2 * np.pi / 3), (0.0, np.pi / 2, 0.4), (1.0, -np.pi / 2, 0.0)]


@pytest.mark.parametrize("rpy", TURNS)
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_turned_solids_and_joints_are_written_as_they_are(rpy, axis):
    rod = Solid("cylinder", (0.01, 0.3, 0.0), (0.1, 0.0, 0.2), 1000.0, axis=axis, rpy=rpy)
    box = Solid("box", (0.1, 0.2, 0.3), (0.0, 0.1, 0.0), 500.0, rpy=rpy)
    joint = Joint("slide", "prismatic", "base", (1.0, 2.0, 3.0), rpy=rpy)
    links = Link("base", (box,)), Link("rod", (rod, box), joint)
    root = parsed(replace(build(), links=links))
    for element, link in zip(root.findall("link"), links, strict=True):
        for visual, solid in zip(element.findall("visual"), link.solids, strict=True):
            assert_same_solid(visual, solid)
    assert numbers(child(root, "joint/origin").get("rpy")) == pytest.approx(rpy, **DIGITS)


@pytest.mark.parametrize("machine", SHIPPED, ids=lambda machine: machine.name)
def test_regenerating_gives_the_shipped_files_byte_for_byte(machine, tmp_path):
    for path in write(tmp_path / "new", machine):
        assert path.read_bytes() == (FOLDER / path.name).read_bytes()


def test_joints_have_the_limits_of_the_tree(mechanism):
    """All else of the joints and links is tested by what Pinocchio makes of the file."""
    elements = {e.get("name"): e for e in parsed(mechanism).findall("joint")}
    for joint in (link.joint for link in mechanism.links if link.joint):
        limit = elements[joint.name].find("limit")
        assert (limit is not None) == (joint.kind in ("revolute", "prismatic"))
        if limit is not None:
            found = [numbers(limit.get(name)) for name in ("lower", "upper", "effort", "velocity")]
            expected = (joint.lower, joint.upper, joint.effort, joint.speed)
            assert np.ravel(found) == pytest.approx(expected, **DIGITS)


def assert_same_solid(element: ElementTree.Element, solid: Any) -> None:
    origin = child(element, "origin")
    assert numbers(origin.get("xyz")) == pytest.approx(solid.centre, **DIGITS)
    rpy = numbers(origin.get("rpy"))
    if solid.kind == "box":
        np.testing.assert_allclose(turned(rpy), turned(solid.rpy), atol=1e-8)
        size = numbers(child(element, "geometry/box").get("size"))
        assert size == pytest.approx(solid.size, **DIGITS)
    else:
        along, axis = turned(rpy)[:, 2], turned(solid.rpy)[:, "xyz".index(solid.axis)]
        assert abs(along @ axis) == pytest.approx(1.0, abs=1e-8)
        shape = child(element, "geometry/cylinder")
        found = numbers(shape.get("radius")) + numbers(shape.get("length"))
        assert found == pytest.approx(solid.size[:2], **DIGITS)


def length_of(cylinder: ElementTree.Element) -> float:
    return float(child(cylinder, "geometry/cylinder").get("length"))


def assert_filled(shapes: list[ElementTree.Element], solid: Any) -> None:
    """The shapes are the cylinder cut across: two thin ends, and the flank between."""
    along = turned(solid.rpy)[:, "xyz".index(solid.axis)]
    place = -solid.size[1] / 2
    for shape in shapes:
        radius, length = float(child(shape, "geometry/cylinder").get("radius")), length_of(shape)
        centre = np.array(solid.centre) + (place + length / 2) * along
        assert_same_solid(shape, replace(solid, size=(radius, length, 0.0), centre=tuple(centre)))
        assert radius == solid.size[0]
        place += length
    assert place == pytest.approx(solid.size[1] / 2)
    assert max(length_of(shapes[0]), length_of(shapes[2])) < 0.2 * solid.size[1]


def test_solids_are_drawn_as_they_are_and_collide_where_they_should(mechanism):
    root, used = parsed(mechanism), set()
    for element, link in zip(root.findall("link"), mechanism.links, strict=True):
        for visual, solid in zip(element.findall("visual"), link.solids, strict=True):
            assert_same_solid(visual, solid)
            material = child(visual, "material").get("name")
            assert material == solid.colour
            used.add(material)
        colliding = [solid for solid in link.solids if solid.collides]
        shapes = iter(element.findall("collision"))
        for solid in colliding:
            if solid.kind == "box":
                assert_same_solid(next(shapes), solid)
            else:
                assert_filled([next(shapes) for _ in range(3)], solid)
        assert not list(shapes)
    assert used <= set(COLOURS)
    found = {
        material.get("name"): tuple(numbers(child(material, "color").get("rgba")))
        for material in root.findall("material")
    }
    assert found == COLOURS


def test_no_number_is_a_negative_zero(mechanism):
    assert "-0" not in urdf_text(mechanism, closure_frames=True).replace('"', " ").split()
