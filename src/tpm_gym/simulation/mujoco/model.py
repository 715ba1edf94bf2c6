"""MuJoCo model of robot, table, floor and objects, with the pairs of geoms that can collide."""

from __future__ import annotations

from itertools import combinations
from xml.etree.ElementTree import Element, SubElement, tostring

import mujoco
import numpy as np
from numpy.typing import NDArray

from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mjcf import SOLID, STIFF, robot
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.mechanism.urdf import numbers
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
    boards,
    painted,
)
from tpm_gym.simulation.state import Block, Scene

_RECOVERY = 0.1
"""Fraction of a penetration that a contact removes per time step; 0.1 causes the least bouncing."""
_MARGIN = 1e-6  # m; so an object placed exactly on the table has contact in the first time step

_NO_CONTACT = {"contype": "0", "conaffinity": "0"}  # only the listed pairs collide


def compile_model(machine: Machine, scene: Scene, physics: Physics) -> mujoco.MjModel:
    """Compile the model. Its equality constraints are the closures, then one weld per object."""
    root = robot(machine.mechanism, machine.mount, physics.time_step)
    option = SubElement(
        root,
        "option",
        timestep=repr(physics.time_step),
        gravity=numbers((0.0, 0.0, -GRAVITY)),
        integrator="Euler",
        solver="Newton",
        cone="elliptic",
        iterations=str(physics.iterations),
        tolerance=repr(physics.tolerance),
    )
    # MuJoCo would reset an unstable simulation. The caller must see the open loop instead.
    SubElement(option, "flag", autoreset="disable")
    world, equality = root.find("worldbody"), root.find("equality")
    assert world is not None
    assert equality is not None
    _light(root, world)
    _surroundings(world, machine, scene)
    for index, block in enumerate(scene.objects):
        _object(world, index, block)
        ends = {"body1": machine.mechanism.tool, "body2": object_name(index)}
        SubElement(equality, "weld", ends, name=grip_name(index), active="false")
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
    """Return the common name of an object's body, joint and geom."""
    return f"object {index}"


def grip_name(index: int) -> str:
    """Return the name of the weld between an object and the cup."""
    return f"grip {index}"


def _light(root: Element, world: Element) -> None:
    """Add the range of depth, light without shadows, and a white sky, as in PyBullet."""
    SubElement(root, "statistic", extent="1")  # then the numbers of "map" are metres
    visual = SubElement(root, "visual")
    SubElement(visual, "map", znear=repr(NEAR), zfar=repr(FAR))
    SubElement(visual, "headlight", ambient=".45 .45 .45", diffuse=".2 .2 .2", specular="0 0 0")
    rays = {"pos": numbers(LIGHT), "dir": numbers(-part for part in LIGHT)}
    colours = {"diffuse": ".5 .5 .5", "specular": ".1 .1 .1"}
    SubElement(world, "light", rays | colours, directional="true", castshadow="false")
    asset = root.find("asset")
    assert asset is not None
    SubElement(
        asset, "texture", type="skybox", builtin="flat", rgb1="1 1 1", width="16", height="96"
    )


def _surroundings(world: Element, machine: Machine, scene: Scene) -> None:
    """Add table, belt, paint and floor."""
    for slab, low, high in boards(machine.table, scene.belt):
        size = (high - low) / 2, machine.table[1], slab.half_height
        pos = (low + high) / 2, 0.0, slab.top - slab.half_height
        board = {"size": numbers(size), "pos": numbers(pos), "rgba": numbers(slab.colour)}
        # Without a velocity in the file, MuJoCo would leave out the computation for good.
        moves = {} if slab is TABLE else {"surfacevel": "1 0 0"}
        name = "table" if slab is TABLE else "belt"
        SubElement(world, "geom", _NO_CONTACT | board | moves, name=name, type="box")
    for patch in painted(scene):
        (x, y), (u, v) = patch.low, patch.high
        size, pos = ((u - x) / 2, (v - y) / 2, PATCH_HEIGHT), ((x + u) / 2, (y + v) / 2, 0.0)
        paint = {"size": numbers(size), "pos": numbers(pos), "rgba": numbers(patch.colour)}
        SubElement(world, "geom", _NO_CONTACT | paint, type="box")
    size, pos = (FLOOR_EDGE, FLOOR_EDGE, 1.0), (0.0, 0.0, FLOOR.top)
    floor = {"size": numbers(size), "pos": numbers(pos), "rgba": numbers(FLOOR.colour)}
    SubElement(world, "geom", _NO_CONTACT | floor, name="floor", type="plane")


def _object(world: Element, index: int, block: Block) -> None:
    name = object_name(index)
    body = SubElement(world, "body", name=name)
    SubElement(body, "freejoint", name=name)
    mass, moments = numbers([block.mass]), numbers(block.inertia)
    SubElement(body, "inertial", pos="0 0 0", mass=mass, diaginertia=moments)
    size, rgba = numbers(block.half), numbers(block.colour)
    SubElement(body, "geom", _NO_CONTACT, name=name, type="box", size=size, rgba=rgba)


def _contacts(root: Element, scene: Scene, physics: Physics) -> Element:
    """Return the pairs that can collide: objects with everything, and the cup with the table."""
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
        SubElement(
            contacts,
            "pair",
            geom1=name,
            geom2=other,
            condim="3",
            friction=numbers((*[friction * rough] * 2, 0.0, 0.0, 0.0)),
            solref=numbers((-_RECOVERY / physics.time_step**2, -1 / physics.time_step)),
            solimp=STIFF,
            margin=numbers([_MARGIN]),
        )
    return contacts
