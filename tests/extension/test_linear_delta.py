"""A linear Delta, with three upright slides instead of arms, in one file outside the package.

Slide i is q_i m below the base plane, at the radius R and the angle 0, 120 or 240 degrees. Its
rods, of length L, keep P on a sphere about the slide moved inwards by TIP.
"""

from dataclasses import dataclass
from functools import cached_property

import gymnasium as gym
import numpy as np
import pytest
from episodes import expert_episode, random_episode

from tpm_gym import Machine, register_machine
from tpm_gym.analysis.poc import Chain, analyse, parallelogram_4s, prismatic
from tpm_gym.analysis.topology import mobility_at
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import Mount, parts
from tpm_gym.mechanism.bodies import ALUMINIUM, STEEL, Closure, Joint, Link, Mechanism, Solid
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Reading

R, TIP, L, HALF = 0.35, 0.06, 0.70, 0.05  # m; HALF is half the distance between two rods
TURNS = 2 * np.pi / 3 * np.arange(3)
OUT = np.stack([np.cos(TURNS), np.sin(TURNS), np.zeros(3)], axis=-1)
HINGE = np.stack([-np.sin(TURNS), np.cos(TURNS), np.zeros(3)], axis=-1)
DOWN, ORIGIN = np.array([0.0, 0.0, 1.0]), (0.0, 0.0, 0.0)


def rods_at(position, q):
    """From slide to platform, (..., 3, 3) m."""
    return np.asarray(position)[..., None, :] - (R - TIP) * OUT - np.asarray(q)[..., None] * DOWN


@dataclass(frozen=True, kw_only=True)
class LinearDelta(Machine):
    """Slides above the platform."""

    def inverse(self, position, built=None):
        """Each slide is above P by the height of its rod."""
        flat = rods_at(position, np.zeros(3))
        with np.errstate(invalid="ignore"):
            return flat[..., 2] - np.sqrt(L**2 - (flat[..., :2] ** 2).sum(axis=-1))

    def evaluate(self, theta, built=None):
        """Intersect three spheres; P is the lower point."""
        centres = -rods_at(np.zeros(3), np.asarray(theta, float))
        first, a, b = (centres[..., i, :] for i in range(3))
        a, b = a - first, b - first
        normal = np.cross(a, b)
        size = (normal**2).sum(axis=-1, keepdims=True)
        a2, b2 = ((v**2).sum(axis=-1, keepdims=True) for v in (a, b))
        with np.errstate(invalid="ignore"):
            foot = (a2 * np.cross(b, normal) + b2 * np.cross(normal, a)) / (2 * size)
            height = np.sqrt((L**2 - (foot**2).sum(axis=-1, keepdims=True)) / size)
        position = first + foot + height * normal
        rods = rods_at(position, theta)
        lost = np.isnan(position[..., :1, None])
        inverse = np.linalg.inv(np.where(lost, np.eye(3), rods))
        jacobian = np.where(lost, np.nan, inverse * rods[..., None, :, 2])
        values = np.linalg.svd(np.where(lost, 0.0, jacobian), compute_uv=False)
        with np.errstate(invalid="ignore"):
            quality = values[..., 2] / values[..., 0]
        return Reading(position, jacobian, quality, (rods[..., 2] > 0).all(axis=-1))

    def joint_positions(self, theta):
        """Swing and tilt of the rods' universal joints."""
        position = self.evaluate(theta).position
        joints = dict.fromkeys(parts.TURNS, 0.0) | {"cup_slide": 0.0}
        joints |= dict(zip(parts.SLIDES, position.tolist(), strict=True))
        for i, rod in enumerate(rods_at(position, theta)):
            joints[f"slide_{i}"] = float(theta[i])
            for side in "ab":
                joints[f"swing_{i}{side}"] = float(np.arctan2(rod[2], rod @ OUT[i]))
                joints[f"tilt_{i}{side}"] = float(np.arcsin(rod @ HINGE[i] / L))
        return joints

    @cached_property
    def mechanism(self):
        """Three slides with two rods each, and a platform that the loops hold."""
        links, closures = (
            [Link("base", (Solid("cylinder", (R, 0.02, 0.0), ORIGIN, ALUMINIUM),))],
            [],
        )
        for i, turn in enumerate(TURNS):
            origin, axis = tuple((R * OUT[i]).tolist()), (0.0, 0.0, 1.0)
            slide = Joint(
                f"slide_{i}", "prismatic", "base", origin, axis, -0.1, 0.9,
                effort=500.0, speed=3.0, corner=2.0, rpy=(0.0, 0.0, float(turn)),
            )  # fmt: skip
            carriage = Solid("box", (0.05, 2 * HALF, 0.05), ORIGIN, ALUMINIUM, colour="orange")
            links.append(Link(f"carriage_{i}", (carriage,), slide))
            for side, y in (("a", HALF), ("b", -HALF)):
                cross, name = f"cross_{i}{side}", f"{i}{side}"
                swing = Joint(
                    f"swing_{name}", "continuous", f"carriage_{i}", (0.0, y, 0.0), (0, -1, 0)
                )
                tilt = Joint(f"tilt_{name}", "continuous", cross, ORIGIN, axis)
                links.append(Link(cross, (parts.bar("z", 0.01, 0.009, density=STEEL),), swing))
                links.append(Link(f"rod_{name}", parts.rod("x", L), tilt))
                end = tuple((TIP * OUT[i] + y * HINGE[i]).tolist())
                closures.append(Closure(name, f"rod_{name}", (L, 0.0, 0.0), "platform", end))
        plate = Solid("cylinder", (TIP, 0.01, 0.0), ORIGIN, ALUMINIUM, colour="yellow")
        links += parts.free_platform((plate, CUP.stem(ORIGIN)), 2.0)
        links.append(CUP.link("platform", ORIGIN))
        return Mechanism(
            tuple(links), tuple(closures), platform="platform", point_p=ORIGIN, tool="cup",
            lip=CUP.lip, actuated=("slide_0", "slide_1", "slide_2"),
        )  # fmt: skip


MACHINE = LinearDelta(
    name="linear delta",
    mount=Mount(height=1.0),
    region=Region(low=(-0.15, -0.15, 0.72), high=(0.15, 0.15, 0.933)),
    goal_region=Region(low=(-0.12, -0.12, 0.74), high=(0.12, 0.12, 0.93)),
    home=(0.0, 0.0, 0.82),
    joint_limit=0.03,
)
register_machine("linear delta", MACHINE)


def sampled(count):
    rng = np.random.default_rng(0)
    return rng.uniform(MACHINE.region.low, MACHINE.region.high, (count, 3))


def test_its_kinematics_are_consistent():
    points, step = sampled(50), 1e-6
    q = MACHINE.inverse(points)
    reading = MACHINE.evaluate(q)
    np.testing.assert_allclose(reading.position, points, atol=1e-12)
    for motor, unit in enumerate(step * np.eye(3)):
        ends = (MACHINE.evaluate(q + s * unit).position for s in (1, -1))
        slope = np.subtract(*ends) / (2 * step)
        np.testing.assert_allclose(reading.jacobian[..., motor], slope, atol=1e-8)


def test_its_analysis_counts():
    position, q = np.array(MACHINE.home), MACHINE.inverse(MACHINE.home)
    chains = []
    for i, rod in enumerate(rods_at(position, q)):
        slide = prismatic("slide", DOWN, R * OUT[i], actuated=True)
        rods = parallelogram_4s("Pa(4S)", HINGE[i], rod, position + TIP * OUT[i])
        chains.append(Chain(f"leg {i}", (slide, rods)))
    found = analyse(chains, position)
    assert (str(found.platform), found.dof(), found.coupling) == ("t^3 r^0", 3, (2,))
    loops = mobility_at(MACHINE.mechanism, MACHINE.joint_positions(tuple(q.tolist())))
    assert (loops.dof, loops.idle, loops.redundant) == (3, 0, 0)
    assert str(loops.platform) == "t^3 r^0"


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
@pytest.mark.parametrize("env_id", ["TPMReach-v0", "TPMPickAndPlace-v0"])
def test_its_expert_succeeds(env_id, engine):
    env = gym.make(env_id, machine="linear delta", engine=engine)
    for seed in range(3):
        for _, _, info in expert_episode(env, seed):
            assert info["closure_error"] < 0.06e-3
        assert info["is_success"]
    for _, _, info in random_episode(env, 0, 20):
        assert info["closure_error"] < 0.06e-3
