"""MJCF (the format of MuJoCo): elements of a Mechanism, and a file of a robot.

MuJoCo closes loops itself. Each ball joint of a loop is an equality constraint between two sites.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import Comment, Element, indent, tostring

from tpm_gym.mechanism.bodies import LEVEL, Link, Mechanism, Solid, rotation_of
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mount import Mount
from tpm_gym.mechanism.urdf import COLOURS, add, numbers

SOLID = "solid"
"""Class of geoms that collide; geoms of the class ``drawn`` do not collide."""

STIFF = "0.9999 0.9999 0.001 0.5 2"
"""Impedance (solimp) of rigid constraints: the largest that MuJoCo accepts. It does not depend on
how far a constraint is violated."""

# The file's time step (s), and its servos: N m/rad and N m s/rad.
_TIME_STEP, _STIFFNESS, _DAMPING = 0.0005, 20000.0, 130.0
_SPRING = 75.0  # N/m; soft, so that the force hardly changes over the cup's stroke

_NOTES = """
  The robot of tpm_gym over its table. Generated from tpm_gym.mechanism; do not edit (make urdf).

  World frame: z up, table top at z = 0, base upside down. data.ctrl holds the angles of the three
  motors, theta_1 to theta_3 (rad); the key frame "home" has them and all joints where loops close.

  What tpm_gym adds and this file leaves out: motors that follow exactly within their torque, or
  servos with feed-forward and a torque-speed line (here: stiffness, damping, a limit of torque);
  references along a spline at 25 Hz and their limits (follow them smoothly); errors of the
  encoders; friction of joints; the vacuum of the cup; objects, goals, rewards.

  The loops hold within micrometres because of three choices. solref of the closures is -1/h^2 and
  -1/h, with h the time step: change both together. The solver is Newton with a small tolerance.
  The integrator is Euler: with the implicit ones, damped actuators pull the loops open.
  """


def robot(mechanism: Mechanism, mount: Mount, time_step: float) -> Element:
    """Build a root element with links, joints and closures, without motors or surroundings.

    Bodies, joints and colours have the names of the mechanism's links, joints and colours. The
    equality constraint of a closure has the name of the closure. Geoms that collide have the name
    of their link. The simulation's ``time_step`` (s) sets the stiffness of closures and stops.
    """
    root = Element("mujoco", model=mechanism.name)
    add(root, "compiler", angle="radian", autolimits="true")
    defaults = add(root, "default")
    # Stops act within two time steps, critically damped: the shortest time that MuJoCo allows.
    add(defaults, "joint", solreflimit=(2 * time_step, 1.0), solimplimit=STIFF)
    add(defaults, "equality", solref=(-1 / time_step**2, -1 / time_step), solimp=STIFF)
    drawn = add(defaults, "default", **{"class": "drawn"})
    add(drawn, "geom", contype="0", conaffinity="0", group="1")
    add(add(defaults, "default", **{"class": SOLID}), "geom", group="1")
    asset = add(root, "asset")
    for name, rgba in COLOURS.items():
        add(asset, "material", name=name, rgba=rgba)
    world = add(root, "worldbody")
    bodies: dict[str, Element] = {}
    for link in mechanism.links:
        bodies[link.name] = _add_body(world, bodies, link, mount)
    equality = add(root, "equality")
    for closure in mechanism.closures:
        site_a, site_b = site_names(closure.name)
        add(bodies[closure.link_a], "site", name=site_a, pos=closure.point_a)
        add(bodies[closure.link_b], "site", name=site_b, pos=closure.point_b)
        add(equality, "connect", name=closure.name, site1=site_a, site2=site_b)
    return root


def site_names(closure: str) -> tuple[str, str]:
    """Return the names of the two sites that a closure connects."""
    return f"{closure}_a", f"{closure}_b"


def mjcf_text(machine: Machine) -> str:
    """Return the MJCF text of the robot over a table, with servos as motors.

    MuJoCo can load this text without tpm_gym.
    """
    mechanism = machine.mechanism
    root = robot(mechanism, machine.mount, _TIME_STEP)
    root.insert(0, Comment(_NOTES))
    solver = {"integrator": "Euler", "solver": "Newton", "cone": "elliptic", "tolerance": "1e-15"}
    add(root, "option", timestep=_TIME_STEP, **solver)
    world = root.find("worldbody")
    assert world is not None
    add(world, "light", directional="true", pos="0 0 3", dir="-1 1.2 -2.5")
    add(world, "geom", name="table", type="plane", size=(*machine.table, 0.1), material="grey")
    joints = {joint.attrib["name"]: joint for joint in world.iter("joint")}
    tool = mechanism.link(mechanism.tool).joint
    if tool is not None:
        joint = joints[tool.name]
        joint.set("range", numbers((tool.lower, 0.0)))  # the spring keeps it on this stop
        joint.set("stiffness", numbers([_SPRING]))
        joint.set("springref", numbers([CUP.preload / _SPRING]))
    _add_servos(root, mechanism)
    _add_home(root, machine, joints)
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n"


def _add_body(world: Element, bodies: dict[str, Element], link: Link, mount: Mount) -> Element:
    """Add a link to its parent, or the base to the world."""
    joint = link.joint
    if joint is None:
        x, y, z, w = mount.quaternion
        origin = mount.to_world((0.0, 0.0, 0.0))
        body = add(world, "body", name=link.name, pos=origin, quat=(w, x, y, z))
    else:
        body = add(bodies[joint.parent], "body", name=link.name, pos=joint.origin)
        if joint.rpy != LEVEL:
            body.set("xyaxes", numbers(rotation_of(joint.rpy).T[:2].ravel()))
        moments = [link.inertia[at] for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        centre = link.centre_of_mass
        add(body, "inertial", pos=centre, mass=link.mass, fullinertia=moments)
        kind = "slide" if joint.kind == "prismatic" else "hinge"
        element = add(body, "joint", name=joint.name, type=kind, axis=joint.axis)
        if joint.kind != "continuous":
            element.set("range", numbers((joint.lower, joint.upper)))
    for solid in link.solids:
        _add_geom(body, solid, link.name)
    return body


# Quaternions (w, x, y, z) that turn a cylinder along z onto the named axis.
_TURN = {"x": (0.5**0.5, 0.0, 0.5**0.5, 0.0), "y": (0.5**0.5, 0.5**0.5, 0.0, 0.0)}


def _add_geom(body: Element, solid: Solid, link: str) -> None:
    kind = SOLID if solid.collides else "drawn"
    element = add(body, "geom", **{"class": kind}, type=solid.kind)
    if solid.collides:
        element.set("name", link)
    x, y, z = solid.size
    if solid.kind == "box":
        element.set("size", numbers((x / 2, y / 2, z / 2)))
    else:
        element.set("size", numbers((x, y / 2)))
    if solid.rpy != LEVEL:
        element.set("xyaxes", numbers(solid.rotation.T[:2].ravel()))
    elif solid.kind == "cylinder" and solid.axis != "z":
        element.set("quat", numbers(_TURN[solid.axis]))
    element.set("pos", numbers(solid.centre))
    element.set("material", solid.colour)


def _add_servos(root: Element, mechanism: Mechanism) -> None:
    """Add a servo for each motor: torque = stiffness (ctrl - theta) - damping theta_dot."""
    actuators = add(root, "actuator")
    for motor in mechanism.motors:
        add(
            actuators,
            "general",
            name=motor.name,
            joint=motor.name,
            biastype="affine",
            gainprm=_STIFFNESS,
            biasprm=(0.0, -_STIFFNESS, -_DAMPING),
            ctrlrange=(motor.lower, motor.upper),
            forcerange=(-motor.effort, motor.effort),
        )


def _add_home(root: Element, machine: Machine, joints: Iterable[str]) -> None:
    """Add the key frame ``home``: positions of all ``joints`` and targets of the motors there."""
    a, b, c = theta = machine.require_inverse(machine.home).tolist()
    at = machine.joint_positions((a, b, c))
    frames = add(root, "keyframe")
    add(frames, "key", name="home", qpos=[at[name] for name in joints], ctrl=theta)
