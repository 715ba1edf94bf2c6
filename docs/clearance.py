"""Distances between the links, as a limit for :mod:`tpm_gym.analysis.aspects`.

The cross sections of bodies do not scale with the lengths.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from tpm_gym.arrays import BoolArray, FloatArray
from tpm_gym.kinematics import ASSEMBLY_MODES, inverse
from tpm_gym.kinematics.geometry import Geometry
from tpm_gym.kinematics.modes import WorkingMode
from tpm_gym.kinematics.workspace import assembly_of
from tpm_gym.mechanism.bodies import Link, Mechanism
from tpm_gym.mechanism.tpm import bodies

_SLENDER = 2.0  # least ratio of length to width of a solid that counts


class Capsule(NamedTuple):
    """Points within ``radius`` of a line segment, m, in the frame of a link."""

    link: str
    start: FloatArray
    end: FloatArray
    radius: float


def clear_of_links(points: FloatArray, branch: WorkingMode, geometry: Geometry) -> BoolArray:
    """Return whether the links are clear of each other, (n,); see :func:`clearance`."""
    return clearance(points, branch, geometry) > 0


def clearance(points: FloatArray, branch: WorkingMode, geometry: Geometry) -> FloatArray:
    """Compute the smallest distance between two links, (n,) m; negative where links overlap.

    Links with a common joint and compact solids (hubs, motors, base) do not count.
    """
    mechanism = bodies.build(geometry)
    parts = [part for link in mechanism.links for part in capsules(link)]
    apart = _unjoined(mechanism)
    pairs = [(i, j) for i, j in combinations(range(len(parts)), 2)
             if frozenset((parts[i].link, parts[j].link)) in apart]  # fmt: skip
    result = np.full(len(points), np.inf)
    slots = assembly_of(points, branch, geometry)
    theta = inverse(points, branch, geometry)
    for mode in ASSEMBLY_MODES:
        rows = np.flatnonzero(slots == mode.index)
        places = mechanism.places(bodies.joint_arrays(theta[rows], mode, geometry))
        ends = [tuple(map(places[part.link].point, part[1:3])) for part in parts]
        for i, j in pairs:
            gap = _between(*ends[i], *ends[j]) - parts[i].radius - parts[j].radius
            result[rows] = np.minimum(result[rows], gap)
    return result


def capsules(link: Link) -> Iterator[Capsule]:
    """Yield the slender solids of a link: a bar as one capsule, a flat box as several in a row."""
    for solid in link.solids:
        size = 2 * solid.half_extent
        narrow, wide, long = np.argsort(size, kind="stable")
        if solid.kind == "cylinder":
            long = "xyz".index(solid.axis)
            narrow = wide = (long + 1) % 3
        if size[long] < _SLENDER * size[wide]:
            continue
        radius = size[narrow] / 2
        along, across = np.zeros(3), np.zeros(3)
        along[long], across[wide] = size[long] / 2 - radius, size[wide] / 2 - radius
        count = int(np.ceil(size[wide] / size[narrow] - 1e-9))
        for share in np.linspace(-1, 1, count) if count > 1 else (0.0,):
            middle = np.asarray(solid.centre) + share * across
            yield Capsule(link.name, middle - along, middle + along, float(radius))


def _unjoined(mechanism: Mechanism) -> set[frozenset[str]]:
    """Return the pairs of links without a common joint; a universal joint's cross is its rod."""
    whole = {link.name: link.name for link in mechanism.links}
    joined = [(closure.link_a, closure.link_b) for closure in mechanism.closures]
    for link in mechanism.links:
        if (joint := link.joint) is not None:
            joined.append((link.name, joint.parent))
            if joint.kind != "prismatic" and not any(joint.origin):
                whole[joint.parent] = link.name
    near = {frozenset((whole[one], whole[other])) for one, other in joined}
    every = {frozenset(pair) for pair in product(whole.values(), repeat=2)}
    return {pair for pair in every - near if len(pair) == 2}


def _between(p1: FloatArray, q1: FloatArray, p2: FloatArray, q2: FloatArray) -> FloatArray:
    """Compute the distance of the segments p1 q1 and p2 q2, (n,)."""
    one, other, start = q1 - p1, q2 - p2, p1 - p2
    a, b, e = (np.einsum("ni,ni->n", *pair) for pair in ((one, one), (one, other), (other, other)))
    c, f = (np.einsum("ni,ni->n", line, start) for line in (one, other))
    square = a * e - b * b
    s = np.where(square > 1e-12 * a * e, (b * f - c * e) / np.where(square > 0, square, 1.0), 0.0)
    t = np.clip((b * np.clip(s, 0.0, 1.0) + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    gap = start + s[:, None] * one - t[:, None] * other
    distance: FloatArray = np.sqrt(np.einsum("ni,ni->n", gap, gap))
    return distance
