"""The files in urdf/ are what the mechanism's data give, number by number."""

from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism.export import write
from tpm_gym.mechanism.tree import Mechanism, build
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


def test_regenerating_gives_the_shipped_files_byte_for_byte(tmp_path):
    for path in write(tmp_path / "new"):
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


def test_solids_are_drawn_as_they_are_and_collide_where_they_should(mechanism):
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


def test_no_number_is_a_negative_zero(mechanism):
    assert "-0" not in urdf_text(mechanism, closure_frames=True).replace('"', " ").split()
