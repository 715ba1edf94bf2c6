"""MJCF (the format of MuJoCo): elements of a Mechanism, and a file of the paper's robot.

MuJoCo closes loops itself. Each ball joint of a loop is an equality constraint between two sites.
Run ``python -m tpm_gym.mechanism.mjcf FOLDER`` to write the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

from tpm_gym.mechanism.bodies import Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mount import Mount
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.mechanism.urdf import COLOURS, numbers

__all__ = ["MJCF_FILE", "SOLID", "STIFF", "mjcf_text", "robot", "site_names", "write"]

MJCF_FILE = "tpm.xml"

SOLID = "solid"
"""Class of geoms that collide; geoms of the other class are only drawn."""

STIFF = "0.9999 0.9999 0.001 0.5 2"
"""Impedance (solimp) of rigid constraints: the largest that MuJoCo takes, for any gap."""

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

    Bodies, joints and colours have the names of the mechanism's links, joints and colours. Closures
    have the names of their joints, and geoms that collide the name of their link.

    Args:
        mechanism: Robot.
        mount: Mount of the robot.
        time_step: Time step, s; the loops close within one.
    """
    root = Element("mujoco", model="tpm")
    SubElement(root, "compiler", angle="radian", autolimits="true")
    defaults = SubElement(root, "default")
    # Within two time steps, critically damped: the shortest that MuJoCo allows.
    SubElement(defaults, "joint", solreflimit=numbers((2 * time_step, 1.0)), solimplimit=STIFF)
    SubElement(
        defaults,
        "equality",
        solref=numbers((-1 / time_step**2, -1 / time_step)),
        solimp=STIFF,
    )
    drawn = SubElement(defaults, "default", {"class": "drawn"})
    SubElement(drawn, "geom", contype="0", conaffinity="0", group="1")
    SubElement(SubElement(defaults, "default", {"class": SOLID}), "geom", group="1")
    asset = SubElement(root, "asset")
    for name, rgba in COLOURS.items():
        SubElement(asset, "material", name=name, rgba=numbers(rgba))
    world = SubElement(root, "worldbody")
    bodies: dict[str, Element] = {}
    for link in mechanism.links:
        bodies[link.name] = _body(world, bodies, link, mount)
    equality = SubElement(root, "equality")
    for closure in mechanism.closures:
        site_a, site_b = site_names(closure.name)
        SubElement(bodies[closure.link_a], "site", name=site_a, pos=numbers(closure.point_a))
        SubElement(bodies[closure.link_b], "site", name=site_b, pos=numbers(closure.point_b))
        SubElement(equality, "connect", name=closure.name, site1=site_a, site2=site_b)
    return root


def site_names(closure: str) -> tuple[str, str]:
    """Return the names of the two sites that a closure connects."""
    return f"{closure}_a", f"{closure}_b"


def mjcf_text(machine: Machine) -> str:
    """Write the robot over a table, with servos as motors, for use in MuJoCo alone."""
    mechanism = machine.mechanism
    root = robot(mechanism, machine.mount, _TIME_STEP)
    root.insert(0, Comment(_NOTES))
    SubElement(
        root,
        "option",
        timestep=numbers([_TIME_STEP]),
        integrator="Euler",
        solver="Newton",
        cone="elliptic",
        tolerance="1e-15",
    )
    world = root.find("worldbody")
    assert world is not None
    SubElement(world, "light", directional="true", pos="0 0 3", dir="-1 1.2 -2.5")
    size = numbers((*machine.table, 0.1))
    SubElement(world, "geom", name="table", type="plane", size=size, material="grey")
    tool = mechanism.link(mechanism.tool).joint
    for joint in world.iter("joint"):
        if tool is not None and joint.get("name") == tool.name:
            joint.set("range", numbers((tool.lower, 0.0)))  # the spring keeps it on this stop
            joint.set("stiffness", numbers([_SPRING]))
            joint.set("springref", numbers([CUP.preload / _SPRING]))
    root.append(_actuators(mechanism))
    root.append(_home(machine, [joint.attrib["name"] for joint in world.iter("joint")]))
    indent(root)
    return '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n"


def write(folder: Path, machine: Machine = PAPER_TPM) -> Path:
    """Write the file into ``folder`` (created if missing), and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / MJCF_FILE
    path.write_text(mjcf_text(machine), encoding="utf-8", newline="\n")
    return path


def _body(world: Element, bodies: dict[str, Element], link: Link, mount: Mount) -> Element:
    """Build a link on its parent, or the base in the world."""
    joint = link.joint
    if joint is None:
        x, y, z, w = mount.quaternion
        origin = numbers(mount.to_world((0.0, 0.0, 0.0)))
        turn = numbers((w, x, y, z))
        body = SubElement(world, "body", name=link.name, pos=origin, quat=turn)
    else:
        body = SubElement(bodies[joint.parent], "body", name=link.name, pos=numbers(joint.origin))
        inertia = link.inertia
        moments = [inertia[at] for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        SubElement(
            body,
            "inertial",
            pos=numbers(link.centre_of_mass),
            mass=numbers([link.mass]),
            fullinertia=numbers(moments),
        )
        body.append(_joint(joint))
    for solid in link.solids:
        body.append(_geom(solid, link.name))
    return body


def _joint(joint: Joint) -> Element:
    kind = "slide" if joint.kind == "prismatic" else "hinge"
    element = Element("joint", name=joint.name, type=kind, axis=numbers(joint.axis))
    if joint.kind != "continuous":
        element.set("range", numbers((joint.lower, joint.upper)))
    return element


# Quaternions (w, x, y, z) that turn a cylinder along z onto the named axis.
_TURN = {
    "x": (0.5**0.5, 0.0, 0.5**0.5, 0.0),
    "y": (0.5**0.5, 0.5**0.5, 0.0, 0.0),
    "z": (1.0, 0.0, 0.0, 0.0),
}


def _geom(solid: Solid, link: str) -> Element:
    element = Element("geom", {"class": SOLID if solid.collides else "drawn"}, type=solid.kind)
    if solid.collides:
        element.set("name", link)
    x, y, z = solid.size
    if solid.kind == "box":
        element.set("size", numbers((x / 2, y / 2, z / 2)))
    else:
        element.set("size", numbers((x, y / 2)))
        if solid.axis != "z":
            element.set("quat", numbers(_TURN[solid.axis]))
    element.set("pos", numbers(solid.centre))
    element.set("material", solid.colour)
    return element


def _actuators(mechanism: Mechanism) -> Element:
    """Build a servo for each motor: torque = stiffness (ctrl - theta) - damping theta_dot."""
    actuators = Element("actuator")
    for motor in mechanism.motors:
        SubElement(
            actuators,
            "general",
            name=motor.name,
            joint=motor.name,
            biastype="affine",
            gainprm=numbers([_STIFFNESS]),
            biasprm=numbers((0.0, -_STIFFNESS, -_DAMPING)),
            ctrlrange=numbers((motor.lower, motor.upper)),
            forcerange=numbers((-motor.effort, motor.effort)),
        )
    return actuators


def _home(machine: Machine, joints: Iterable[str]) -> Element:
    """Build a key frame with P at home, all ``joints`` at rest and the motors' targets there."""
    a, b, c = theta = machine.require_inverse(machine.home).tolist()
    at = machine.joint_positions((a, b, c))
    frames = Element("keyframe")
    qpos = numbers(at[name] for name in joints)
    SubElement(frames, "key", name="home", qpos=qpos, ctrl=numbers(theta))
    return frames


def main() -> None:
    """Write the file of the paper's robot."""
    parser = argparse.ArgumentParser(description="Write the robot as MJCF.")
    parser.add_argument("folder", type=Path)
    print(write(parser.parse_args().folder))


if __name__ == "__main__":
    main()
