"""The tree of links, walked joint by joint: where everything is, from the joints alone."""

from collections.abc import Iterable, Mapping

import numpy as np
import pytest

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.bodies import Mechanism

Frame = tuple[FloatArray, FloatArray]


def turn(axis: tuple[float, ...], angle: float) -> FloatArray:
    """Rodrigues' rotation about a unit axis."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


def turned(rpy: Iterable[float]) -> FloatArray:
    """Turn about x, then y, then z, all fixed."""
    x, y, z = (turn(tuple(axis), a) for axis, a in zip(np.eye(3), rpy, strict=True))
    return z @ y @ x


def walk(mechanism: Mechanism, joints: Mapping[str, float]) -> dict[str, Frame]:
    """Position (m) and rotation of every link in the machine's frame, joints in rad or m."""
    frames = {mechanism.links[0].name: (np.zeros(3), np.eye(3))}
    for link in mechanism.links[1:]:
        joint = link.joint
        assert joint is not None
        assert np.linalg.norm(joint.axis) == pytest.approx(1)
        position, rotation = frames[joint.parent]
        value = joints[joint.name]
        slides = joint.kind == "prismatic"
        origin = position + rotation @ joint.origin
        rotation = rotation @ turned(joint.rpy)
        if slides:
            frames[link.name] = (origin + value * rotation @ joint.axis, rotation)
        else:
            frames[link.name] = (origin, rotation @ turn(joint.axis, value))
    return frames


def place(frames: Mapping[str, Frame], link: str, point: tuple[float, ...]) -> FloatArray:
    """A point of a link in the machine's frame, m."""
    position, rotation = frames[link]
    return np.asarray(position + rotation @ point)


def gaps(mechanism: Mechanism, joints: Mapping[str, float]) -> FloatArray:
    """From one side of each closure to the other, (closures, 3) m."""
    frames = walk(mechanism, joints)
    return np.array(
        [
            place(frames, c.link_a, c.point_a) - place(frames, c.link_b, c.point_b)
            for c in mechanism.closures
        ]
    )
