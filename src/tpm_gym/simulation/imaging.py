"""Pictures of a scene: cameras, images that an engine draws, goal markers, and tiles of images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, Vector, finite
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.settings import settings_of
from tpm_gym.simulation.stage import MARKER_COLOUR, TABLE

BACKGROUND, TABLETOP, ROBOT, CUP, OBJECTS = range(5)
"""Ids of a segmentation; object k has the id ``OBJECTS + k``. The floor is background."""

NEAR, FAR = 0.05, 40.0
"""Smallest and largest depth that is drawn, m."""

_SKY = 10.0  # m; what is farther away is background, such as MuJoCo's sky, a box about the camera

CAMERAS: Final = ("table", "overview", "cup")
"""Names of cameras: the task region, the whole robot, and a close view that follows the cup."""

_WIDEST = 4 / 3  # aspect ratio; narrower pictures get a larger vertical field of view
_SHADOW = 0.5  # darkness of a shadow below a body on the table
_PENUMBRA = 0.25  # growth of a shadow's radius with the height of the body
_FLAT = 0.0015  # m; points closer to the table's plane belong to the table
_HIDDEN = 0.5  # opacity, as a factor, in the middle of a marker that is behind or inside a body


@dataclass(frozen=True)
class Camera:
    """Pose and field of view of a camera; world frame.

    Attributes:
        target: Point in the middle of the picture, m; at most 10 m along each axis.
        distance: Distance from the target, m.
        yaw: Rotation about the vertical, degrees; at 0 the camera looks along +y.
        pitch: Angle above the horizon, degrees; negative to look down.
        opening: Vertical field of view, degrees, of a picture with an aspect ratio of 4:3 or more.
            Narrower pictures have the horizontal field of view of a picture of 4:3.
        follows: Whether ``target`` is relative to point P of the platform.

    Raises:
        ConfigurationError: If a value is out of range.
    """

    target: Vector
    distance: float
    yaw: float = -25.0
    pitch: float = -15.0
    opening: float = 26.0
    follows: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        target = finite("target", self.target, (3,), ConfigurationError)
        if abs(target).max() > _SKY:
            raise ConfigurationError("target", self.target, f"from {-_SKY} to {_SKY} m each")
        object.__setattr__(self, "target", tuple(target.tolist()))
        for name, low, high in (
            ("distance", NEAR, 0.7 * _SKY),
            ("yaw", -360.0, 360.0),
            ("pitch", -90.0, 90.0),
            ("opening", 1.0, 120.0),
        ):
            value = float(finite(name, getattr(self, name), (), ConfigurationError))
            if not low <= value <= high:
                raise ConfigurationError(name, value, f"from {low} to {high}")
        if not isinstance(self.follows, bool):
            raise ConfigurationError("follows", self.follows, "True or False")

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors (3, 3) to the right, up and forward."""
        yaw, pitch = math.radians(self.yaw), math.radians(self.pitch)
        right = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        level, vertical = np.array([-math.sin(yaw), math.cos(yaw), 0.0]), np.array([0.0, 0.0, 1.0])
        up = math.cos(pitch) * vertical - math.sin(pitch) * level
        forward = math.sin(pitch) * vertical + math.cos(pitch) * level
        return np.stack([right, up, forward])

    @property
    def eye(self) -> FloatArray:
        """Position (3,) m of the camera."""
        eye: FloatArray = self.target - self.distance * self.axes[2]
        return eye

    def following(self, point_p: FloatArray) -> Camera:
        """Return the camera with its target in the world frame.

        If the camera follows the robot, its target is relative to point P. ``point_p`` is P (3,) m,
        world frame.
        """
        if not self.follows:
            return self
        return replace(self, target=tuple((self.target + point_p).tolist()), follows=False)


def camera_of(value: Any, machine: Machine) -> Camera:
    """Return a camera from a name in :data:`CAMERAS`, a Camera, or a mapping of its attributes.

    Raises:
        ConfigurationError: If ``value`` is none of these.
    """
    if isinstance(value, str) and value in CAMERAS:
        return _named(value, machine)
    if value is None or isinstance(value, str):
        names = ", ".join(map(repr, CAMERAS))
        valid = f"{names}, a tpm_gym.simulation.Camera, or a mapping with its attributes"
        raise ConfigurationError("camera", value, valid)
    try:
        return settings_of(Camera, "camera", value)
    except TypeError as error:  # no target or no distance
        valid = f"a mapping with the attributes of tpm_gym.simulation.Camera ({error})"
        raise ConfigurationError("camera", value, valid) from error


def _named(name: str, machine: Machine) -> Camera:
    region = machine.region
    low, high = np.sort(machine.mount.to_world([region.low, region.high]), axis=0)
    low[2] = TABLE.top
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    x, y, z = middle.tolist()
    if name == "table":
        return Camera((x, y, z), 4.3 * radius)
    if name == "overview":
        height = machine.mount.height
        return Camera((0.0, 0.0, 0.49 * height), 4.3 * math.hypot(*machine.table, 0.56 * height))
    return Camera((0.0, 0.0, -0.03), 0.5, pitch=-18.0, follows=True)


class View(NamedTuple):
    """Request for a picture.

    Attributes:
        camera: Camera, in the world frame.
        width: Width, pixels.
        height: Height, pixels.
        segmented: Whether the picture includes the ids of bodies. If True, the depth and the id of
            a pixel belong to the same body. If False, the engine may smooth the depth at the edges
            of bodies.
    """

    camera: Camera
    width: int = 640
    height: int = 480
    segmented: bool = False

    @property
    def opening(self) -> float:
        """Vertical field of view, degrees."""
        half = math.tan(math.radians(self.camera.opening) / 2)
        return math.degrees(2 * math.atan(half * max(1.0, _WIDEST * self.height / self.width)))

    @property
    def focal_length(self) -> float:
        """Focal length, pixels."""
        return self.height / 2 / math.tan(math.radians(self.opening) / 2)


class Picture(NamedTuple):
    """Image of a robot and its scene.

    Attributes:
        colour: (height, width, 3) uint8, red, green and blue.
        depth: (height, width) float32, distance along the camera's axis, m; infinite where there is
            no body. None if the engine cannot draw it.
        segmentation: (height, width) int32, see :data:`BACKGROUND`. None if it was not wanted or
            the engine cannot draw it.
    """

    colour: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    segmentation: NDArray[np.int32] | None = None


def metres(share: NDArray[Any]) -> NDArray[np.float32]:
    """Convert a depth buffer, 1 at :data:`NEAR` and 0 at :data:`FAR`, to a depth in m."""
    depth = NEAR * FAR / (NEAR + share.astype(np.float64) * (FAR - NEAR))
    return np.where(depth < _SKY, depth, np.inf).astype(np.float32)


def paint_shadows(picture: Picture, view: View, casters: ArrayLike) -> None:
    """Paint soft shadows onto the table, straight below bodies.

    Args:
        picture: Picture; its colours are changed. Without a depth, nothing is painted.
        view: View of the picture.
        casters: (k, 4) m: x, y, z (world) and radius of each body.
    """
    if picture.depth is None:
        return
    right, up, forward = view.camera.axes
    for x, y, z, radius in np.reshape(casters, (-1, 4)).tolist():
        spread = 0.6 * (radius + _PENUMBRA * (z - TABLE.top))
        at = _area(view, np.array([x, y, TABLE.top]), 3 * spread)
        u, v = _rays(view, *at)
        rays = u[..., None] * right + v[..., None] * up + forward
        point = view.camera.eye + np.minimum(picture.depth[at], FAR)[..., None] * rays
        apart = (point[..., 0] - x) ** 2 + (point[..., 1] - y) ** 2
        strength = _SHADOW * (radius / (radius + _PENUMBRA * (z - TABLE.top))) ** 2
        dark = strength * np.exp(-apart / (2 * spread**2))
        dark[~(abs(point[..., 2] - TABLE.top) < _FLAT)] = 0.0
        area = picture.colour[at]
        area[:] = np.rint(area * (1 - dark[..., None]))


def paint_markers(picture: Picture, view: View, centres: ArrayLike, radius: float) -> None:
    """Paint goal markers: translucent spheres that stay visible, but fainter, behind bodies.

    Args:
        picture: Picture, with or without a depth; its colours are changed.
        view: View of the picture.
        centres: (k, 3) m, world.
        radius: Radius of the spheres, m.
    """
    camera = view.camera
    for centre in np.reshape(centres, (-1, 3)):
        at = _area(view, centre, radius)
        depth = None if picture.depth is None else picture.depth[at]
        place = camera.axes @ (centre - camera.eye)
        _paint_sphere(picture.colour[at], depth, _rays(view, *at), place, radius, view.focal_length)


def _paint_sphere(
    area: NDArray[np.uint8],
    depth: NDArray[np.float32] | None,
    rays: tuple[NDArray[Any], NDArray[Any]],
    place: FloatArray,
    radius: float,
    focal: float,
) -> None:
    """Blend a sphere at ``place`` (camera's axes, m) into the pixels of ``area``.

    ``rays`` are the coordinates of these pixels, from :func:`_rays`.
    """
    u, v = rays
    square, along = u * u + v * v + 1, u * place[0] + v * place[1] + place[2]
    apart = np.sqrt(np.maximum(place @ place - along**2 / square, 0.0))  # of ray and centre, m
    chord = np.sqrt(np.maximum(radius**2 - apart**2, 0.0))
    edge = np.clip((radius - apart) * focal / place[2] + 0.5, 0.0, 1.0)  # share of the pixel
    opacity = MARKER_COLOUR[3] * edge
    if depth is not None:
        front = (along - chord * np.sqrt(square)) / square
        seen_through = _HIDDEN + (1 - _HIDDEN) * (1 - chord / radius)  # mostly its outline
        opacity = np.where(depth < front, seen_through * opacity, opacity)
    shade = 0.7 + 0.3 * chord / radius
    colour = 255 * np.array(MARKER_COLOUR[:3]) * shade[..., None]
    area[:] = np.rint(area + opacity[..., None] * (colour - area))


def _area(view: View, point: FloatArray, radius: float) -> tuple[slice, slice]:
    """Return rows and columns of the pixels around a sphere at ``point`` (m, world)."""
    camera, focal = view.camera, view.focal_length
    x, y, z = (camera.axes @ (point - camera.eye)).tolist()
    if z < NEAR + 2 * radius:  # at or behind the camera
        return slice(0), slice(0)
    column, row = view.width / 2 + focal * x / z, view.height / 2 - focal * y / z
    reach = 1.2 * focal * radius / (z - radius) + 1

    def around(middle: float) -> slice:
        return slice(max(0, int(middle - reach)), max(0, math.ceil(middle + reach)))

    return around(row), around(column)


def _rays(view: View, rows: slice, columns: slice) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the coordinates (m) of an area's pixels in the picture's plane at a depth of 1 m.

    Returns:
        Coordinates to the right, (1, number of columns), and upwards, (number of rows, 1).
    """
    u = (np.arange(view.width)[columns] + 0.5 - view.width / 2) / view.focal_length
    v = (view.height / 2 - np.arange(view.height)[rows] - 0.5) / view.focal_length
    return u[None, :], v[:, None]


def tile(frames: Sequence[NDArray[Any]], columns: int | None = None) -> NDArray[Any]:
    """Put k images of equal shape (height, width, ...) into one image, row by row.

    ``columns`` is the number of images in a row; None for about as many columns as rows. Empty
    places are filled with 0.
    """
    columns = columns or math.ceil(math.sqrt(len(frames)))
    rows = -(-len(frames) // columns)
    first = frames[0]
    blank = [np.zeros_like(first)] * (rows * columns - len(frames))
    table = np.stack([*frames, *blank]).reshape(rows, columns, *first.shape)
    height, width, *rest = first.shape
    whole: NDArray[Any] = table.swapaxes(1, 2).reshape(rows * height, columns * width, *rest)
    return whole
