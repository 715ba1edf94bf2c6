"""MuJoCo model of robot, table, floor and objects, with the pairs of geoms that can collide."""

from __future__ import annotations

from itertools import combinations
from xml.etree.ElementTree import Element, tostring

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpm_gym.arrays import Vector
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mjcf import SOLID, STIFF, robot
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.mechanism.urdf import add
from tpm_gym.simulation.imaging import BACKGROUND, FAR, NEAR, OBJECTS, ROBOT, TABLETOP
from tpm_gym.simulation.imaging import CUP as CUP_ID
from tpm_gym.simulation.mujoco.physics import Physics
from tpm_gym.simulation.stage import (
    BELT,
    FLOOR,
    FLOOR_EDGE,
    LIGHT,
    PATCH_HEIGHT,
    TABLE,
    Colour,
    boards,
    painted,
)
from tpm_gym.simulation.state import Block, Scene

_RECOVERY = 0.1
"""Fraction of a penetration that a contact removes per time step; 0.1 causes the least bouncing."""
_MARGIN = 1e-6  # m; gives an object placed exactly on the table a contact in the first time step


def compile_model(machine: Machine, scene: Scene, physics: Physics) -> mujoco.MjModel:
    """Compile the model. Its equality constraints are the closures, then one weld per object."""
    root = robot(machine.mechanism, machine.mount, physics.time_step)
    option = add(
        root,
        "option",
        timestep=repr(physics.time_step),
        gravity=(0.0, 0.0, -GRAVITY),
        integrator="Euler",
        solver="Newton",
        cone="elliptic",
        iterations=physics.iterations,
        tolerance=repr(physics.tolerance),
    )
    # MuJoCo would reset an unstable simulation. The caller must see the open loop instead.
    add(option, "flag", autoreset="disable")
    world, equality = root.find("worldbody"), root.find("equality")
    assert world is not None
    assert equality is not None
    _light(root, world)
    _surroundings(world, machine, scene)
    for index, block in enumerate(scene.objects):
        _object(world, index, block)
        tool, held = machine.mechanism.tool, object_name(index)
        add(equality, "weld", name=grip_name(index), body1=tool, body2=held, active="false")
    root.append(_contacts(root, scene, physics))
    if scene.belt is not None and not hasattr(mujoco.MjModel, "geom_surfacevel"):
        valid = "3.11 or later, for a scene with a belt"
        raise ConfigurationError("mujoco", mujoco.__version__, valid)
    return mujoco.MjModel.from_xml_string(tostring(root, encoding="unicode"))


def segmentation_ids(model: mujoco.MjModel, tool: str, scene: Scene) -> NDArray[np.int32]:
    """Return the id of each geom in a segmentation; ``tool`` is the body with the cup."""
    bodies = np.full(model.nbody, ROBOT, dtype=np.int32)
    bodies[model.body(tool).id] = CUP_ID
    for index in range(len(scene.objects)):
        bodies[model.body(object_name(index)).id] = OBJECTS + index
    ids: NDArray[np.int32] = bodies[model.geom_bodyid]
    ids[model.geom_bodyid == 0] = TABLETOP
    ids[model.geom("floor").id] = BACKGROUND
    return ids


def object_name(index: int) -> str:
    """Return the name that an object's body, joint and geom share."""
    return f"object {index}"


def grip_name(index: int) -> str:
    """Return the name of the weld between an object and the cup."""
    return f"grip {index}"


def _light(root: Element, world: Element) -> None:
    """Add a white sky, lights that cast no shadows, and the limits of the depth, as in PyBullet."""
    add(root, "statistic", extent=1)  # then the numbers of "map" are metres
    visual = add(root, "visual")
    add(visual, "map", znear=NEAR, zfar=FAR)
    add(visual, "headlight", ambient=".45 .45 .45", diffuse=".2 .2 .2", specular="0 0 0")
    light = add(world, "light", pos=LIGHT, dir=[-part for part in LIGHT])
    light.attrib |= {"diffuse": ".5 .5 .5", "specular": ".1 .1 .1"}
    light.attrib |= {"directional": "true", "castshadow": "false"}
    asset = root.find("asset")
    assert asset is not None
    add(asset, "texture", type="skybox", builtin="flat", rgb1="1 1 1", width=16, height=96)


def _surroundings(world: Element, machine: Machine, scene: Scene) -> None:
    """Add table, belt, painted rectangles and floor."""
    for slab, low, high in boards(machine.table, scene.belt):
        size = (high - low) / 2, machine.table[1], slab.half_height
        pos = (low + high) / 2, 0.0, slab.top - slab.half_height
        # Without a velocity in the XML, the compiled model would ignore the belt's speed.
        names = {"name": "table"} if slab is TABLE else {"name": "belt", "surfacevel": "1 0 0"}
        _geom(world, "box", size, slab.colour, pos=pos, **names)
    for patch in painted(scene):
        (x, y), (u, v) = patch.low, patch.high
        size, pos = ((u - x) / 2, (v - y) / 2, PATCH_HEIGHT), ((x + u) / 2, (y + v) / 2, 0.0)
        _geom(world, "box", size, patch.colour, pos=pos)
    size, pos = (FLOOR_EDGE, FLOOR_EDGE, 1.0), (0.0, 0.0, FLOOR.top)
    _geom(world, "plane", size, FLOOR.colour, name="floor", pos=pos)


def _geom(parent: Element, kind: str, size: Vector, colour: Colour, **values: str | Vector) -> None:
    """Add a geom. It can collide only with the geoms that :func:`_contacts` pairs with it."""
    add(parent, "geom", type=kind, size=size, rgba=colour, contype=0, conaffinity=0, **values)


def _object(world: Element, index: int, block: Block) -> None:
    name = object_name(index)
    body = add(world, "body", name=name)
    add(body, "freejoint", name=name)
    add(body, "inertial", pos="0 0 0", mass=block.mass, diaginertia=block.inertia)
    _geom(body, "box", block.half, block.colour, name=name)


def _contacts(root: Element, scene: Scene, physics: Physics) -> Element:
    """Return the pairs of geoms that can collide.

    An object can collide with table, belt, floor, cup and other objects. The cup can also collide
    with table and belt.
    """
    lips = [geom.attrib["name"] for geom in root.iter("geom") if geom.get("class") == SOLID]
    objects = [(object_name(index), block.friction) for index, block in enumerate(scene.objects)]
    tops = [("table", TABLE.friction)]
    tops += [] if scene.belt is None else [("belt", BELT.friction)]
    floor = ("floor", FLOOR.friction)
    cups = [(name, CUP.friction) for name in lips]
    pairs = [
        *((one, other) for one in objects for other in (*tops, floor, *cups)),
        *combinations(objects, 2),
        *((cup, top) for cup in cups for top in tops),
    ]
    contacts = Element("contact")
    for (name, friction), (other, rough) in pairs:
        add(
            contacts,
            "pair",
            geom1=name,
            geom2=other,
            condim="3",
            friction=(*[friction * rough] * 2, 0.0, 0.0, 0.0),
            solref=(-_RECOVERY / physics.time_step**2, -1 / physics.time_step),
            solimp=STIFF,
            margin=_MARGIN,
        )
    return contacts
