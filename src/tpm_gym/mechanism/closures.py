"""Loop closures of any mechanism: their derivatives, and checks of a new mechanism.

Vectors are in the base's frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, get_args, get_type_hints

import numpy as np

from tpm_gym.arrays import FloatArray, Vector
from tpm_gym.errors import ConfigurationError, SingularityError
from tpm_gym.mechanism.bodies import Joint, Mechanism, Place, Solid

CLOSED: Final = 1e-6
"""Gap below which a loop counts as closed, m: the distance between the two points of a closure."""

_SOLIDS, _AXES, _JOINTS = (
    get_args(get_type_hints(kind)[name])
    for kind, name in ((Solid, "kind"), (Solid, "axis"), (Joint, "kind"))
)

# Fractions of the largest singular value: zero up to the first, not zero from the second, and
# uncertain in between. Rounding makes zeros of about 1e-16.
_ZERO, _NOT_ZERO = 1e-11, 1e-7


def closure_jacobian(mechanism: Mechanism, angles: Mapping[str, float]) -> FloatArray:
    """Differentiate the gaps of all closures by the joint positions of the spanning tree.

    Returns:
        (3 * number of closures, number of joints), m/rad (m/m for a slide). Rows are x, y, z of
        ``point_a - point_b`` in the order of ``mechanism.closures``. Columns are in the order of
        :func:`moving_joints`.
    """
    places = mechanism.places(angles)
    rows = [
        rates(mechanism, places, closure.link_a, closure.point_a)[0]
        - rates(mechanism, places, closure.link_b, closure.point_b)[0]
        for closure in mechanism.closures
    ]
    return np.concatenate([np.empty((0, len(moving_joints(mechanism)))), *rows])


def moving_joints(mechanism: Mechanism) -> list[str]:
    """Return the names of the joints, in the order of the links.

    The slide of the cup (joint of the link ``mechanism.tool``) is left out.
    """
    joints = (link.joint for link in mechanism.links if link.name != mechanism.tool)
    return [joint.name for joint in joints if joint]


def rates(
    mechanism: Mechanism, places: Mapping[str, Place], name: str, offset: Vector
) -> tuple[FloatArray, FloatArray]:
    """Differentiate position and orientation of a link by each joint position.

    Args:
        mechanism: Links and joints.
        places: Positions and orientations of the links.
        name: Name of the link.
        offset: Point of the link, in the link's frame, m.

    Returns:
        Velocity of the point, m/rad (m/m for a slide), and angular velocity of the link, rad/rad,
        for unit velocities of the joints. Both are (3, number of joints), with columns in the order
        of :func:`moving_joints`.
    """
    joints, point = moving_joints(mechanism), places[name].point(offset)
    linear, angular = np.zeros((3, len(joints))), np.zeros((3, len(joints)))
    while (joint := mechanism.link(name).joint) is not None:
        if name != mechanism.tool:
            column, axis = joints.index(joint.name), places[name].rotation @ joint.axis
            if joint.kind == "prismatic":
                linear[:, column] = axis
            else:
                angular[:, column] = axis
                linear[:, column] = np.cross(axis, point - places[name].origin)
        name = joint.parent
    return linear, angular


def rank_of(values: FloatArray) -> int:
    """Return the rank of a matrix from its singular values, which are in descending order.

    Raises:
        SingularityError: If the rank is uncertain.
    """
    if not len(values):
        return 0
    rank = int((values > _ZERO * values[0]).sum())
    if values[rank - 1] < _NOT_ZERO * values[0]:
        raise SingularityError("a singular value of the loop closures", values[rank - 1])
    return rank


def require_sound(mechanism: Mechanism, joints: Mapping[str, float]) -> None:
    """Refuse a mechanism unless its three motors move the platform in pure translation.

    Redundant closure equations are allowed; the TPM has one. ``joints`` has the position of each
    joint by name, rad or m.

    Raises:
        ConfigurationError: If a name is missing or not unique; if a joint has no position; if the
            first link has a joint, or another link has none; if a link has no mass, or comes before
            its parent; if a joint or a solid is of an unknown kind; if an axis does not have length
            1; if a solid has no positive size; if a loop is open at these joint positions; if the
            platform turns; if there are not exactly three independent motors; or if the platform
            can move while the motors stand still.
        SingularityError: If the rank of the closures' Jacobian is uncertain at these positions.
    """
    _require_parts(mechanism)
    _require_tree(mechanism, joints)
    places = mechanism.places(joints)
    for closure in mechanism.closures:
        ends = (closure.link_a, closure.point_a), (closure.link_b, closure.point_b)
        one, other = (places[link].point(point) for link, point in ends)
        gap = float(np.linalg.norm(one - other))
        if not gap < CLOSED:
            valid = f"closed within {CLOSED:g} m at home; its points are {gap:.3g} m apart"
            raise ConfigurationError("mechanism", closure.name, valid)
    jacobian = closure_jacobian(mechanism, joints)
    _, values, right = np.linalg.svd(jacobian)
    rank = rank_of(values)
    linear, angular = rates(mechanism, places, mechanism.platform, mechanism.point_p)
    free = right[rank:].T  # columns: joint velocities that keep the loops closed
    names = moving_joints(mechanism)
    motors = np.eye(len(names))[[names.index(name) for name in mechanism.actuated]]
    for what, rows in (("all", np.concatenate([linear, angular, motors])), ("motors", motors)):
        freedoms = int((np.linalg.svd(rows @ free, compute_uv=False) > _NOT_ZERO).sum())
        if freedoms != 3:
            valid = f"a mechanism with 3 degrees of freedom; {freedoms} of platform and motors"
            raise ConfigurationError("mechanism", what, valid)
    if np.abs(angular @ free).max() > _NOT_ZERO:
        raise ConfigurationError("mechanism", mechanism.platform, "a platform that does not turn")


def _require_parts(mechanism: Mechanism) -> None:
    """Refuse joints and solids that engines would read in different ways, or not at all."""
    for link in mechanism.links:
        for solid in link.solids:
            known = solid.kind in _SOLIDS and solid.axis in _AXES
            if not known or not (solid.half_extent > 0).all() or not (solid.moments >= 0).all():
                valid = "boxes and cylinders along x, y or z, of positive size, with a smaller bore"
                raise ConfigurationError("mechanism", (link.name, solid), valid)
        joint = link.joint
        if joint and (joint.kind not in _JOINTS or not abs(np.linalg.norm(joint.axis) - 1) < 1e-9):
            valid = f"{', '.join(_JOINTS)} joints with an axis of length 1"
            raise ConfigurationError("mechanism", joint, valid)


def _require_tree(mechanism: Mechanism, joints: Mapping[str, float]) -> None:
    """Refuse links that form no tree or have no mass, and names that are missing or repeated.

    :func:`require_sound` lists all conditions.
    """
    links, names = [link.name for link in mechanism.links], moving_joints(mechanism)
    held = [link.joint for link in mechanism.links[1:]]
    if mechanism.links[0].joint or None in held:
        raise ConfigurationError("mechanism", links, "links of which the first alone has no joint")
    for index, joint in enumerate(held, 1):
        assert isinstance(joint, Joint)
        if joint.parent not in links[:index]:
            raise ConfigurationError("mechanism", joint.parent, f"a link before {links[index]}")
    for link in mechanism.links:
        if not link.mass > 0:
            raise ConfigurationError("mechanism", link.name, "links with a mass, the base too")
    closures = [c.name for c in mechanism.closures]
    for kind, given in (("links", links), ("joints", names), ("closures", closures)):
        if len(set(given)) < len(given):
            raise ConfigurationError("mechanism", given, f"{kind} with a name each")
    ends = [end for c in mechanism.closures for end in (c.link_a, c.link_b)]
    needed = (
        ("a link", links, [*ends, mechanism.platform, mechanism.tool]),
        ("a joint", names, list(mechanism.actuated)),
        ("a joint with a position", list(joints), names),
    )
    for what, known, given in needed:
        for name in given:
            if name not in known:
                raise ConfigurationError("mechanism", name, f"the name of {what}: {known}")
