"""A mechanism in a physics client, motions to follow, and what to measure on the way.

The production classes load the mechanism and close its loops
(:class:`tpm_gym.simulation.bullet.robot.Robot`); only the engine's settings and the motors vary
here.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
import variants

import tpm_gym  # noqa: F401  (registers the environments)
from tpm_gym import kinematics
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import jacobian
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.mechanism.tpm import ASSEMBLY_LIMIT
from tpm_gym.simulation.bullet.client import Client, silence
from tpm_gym.simulation.bullet.physics import REGULARISATION, Physics
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.simulation import CLOSURE_LIMIT, spline_weights
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.tasks import Expert
from tpm_gym.tasks.control import CartesianControl

DEFAULT = Physics()
CONDITIONED = 0.05
"""1/cond(J) above which forward kinematics is held to its strict limit."""
HOME, REGION, MOUNT = np.array(PAPER_TPM.home), PAPER_TPM.region, PAPER_TPM.mount


# -- settings ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Config:
    """One row of the sweep; whatever is not said is as in production.

    Attributes:
        family: What it is compared with, and its colour in the plot.
        name: What differs from the default.
        variant: Name of a variant of :mod:`variants`.
        solver: ``"direct"`` (Dantzig), ``"iterative"`` (sequential impulses) or ``"lcp pgs"``.
        time_step: s.
        iterations: Of the iterative solvers.
        erp: Share of a constraint's error taken out in one step.
        cfm: Compliance added to the constraints.
        residual: Threshold at which the iterative solver stops early; None leaves the engine's.
        motor: ``"servo"`` (a velocity constraint) or ``"torque"``.
        gains: Of torque control, N m/rad and N m s/rad.
    """

    family: str
    name: str
    variant: str = "three legs"
    solver: str = DEFAULT.solver
    time_step: float = DEFAULT.time_step
    iterations: int = DEFAULT.iterations
    erp: float = DEFAULT.erp
    cfm: float = REGULARISATION
    residual: float | None = None
    motor: str = "servo"
    gains: tuple[float, float] = (0.0, 0.0)

    @property
    def substeps(self) -> int:
        """Time steps in a control period."""
        return self.physics.substeps

    @property
    def physics(self) -> Physics:
        """The settings that production knows."""
        solver = "direct" if self.solver == "direct" else "iterative"
        return Physics(self.time_step, solver, self.iterations, self.erp)

    @property
    def beyond(self) -> dict[str, float]:
        """The engine's settings that production does not offer."""
        settings: dict[str, float] = {}
        if self.solver == "lcp pgs":
            settings["constraintSolverType"] = pybullet.CONSTRAINT_SOLVER_LCP_PGS
        if self.cfm != REGULARISATION:
            settings["globalCFM"] = self.cfm
        if self.residual is not None:
            settings["solverResidualThreshold"] = self.residual
        return settings


class Rig:
    """A mechanism in a client of its own, with nothing else in it.

    Args:
        config: Settings.
    """

    def __init__(self, config: Config) -> None:
        """Connect, load, close the loops."""
        self.config = config
        known = {variant.name: variant for variant in variants.all_variants()}
        self.variant = known[config.variant]
        self.client: Any = Client(config.physics)
        for setting, value in config.beyond.items():
            with silence():  # the engine prints the name of its solver
                self.client.setPhysicsEngineParameter(**{setting: value})
        self.robot = Robot(self.client, self.variant.mechanism, MOUNT)
        self.motors = [self.robot.joints[name] for name in self.variant.mechanism.actuated]
        if config.motor == "torque":
            for motor in self.motors:
                self.client.setJointMotorControl2(*motor, self.client.VELOCITY_CONTROL, force=0.0)

    def place(self, theta: FloatArray) -> None:
        """At rest, with closed loops."""
        self.robot.place(self.variant.angles(theta))

    def drive(self, target: list[float]) -> None:
        """Command the motors for one time step: three angles, and for torque what goes with them.

        The servo is a velocity constraint; torque control is a PD law about the reference plus the
        torques that carry the weight there, within the same limit.
        """
        if self.config.motor == "servo":
            self.robot.drive(target[:3])
            return
        angles, rates, _ = self.robot.motors()
        client, (stiffness, damping) = self.client, self.config.gains
        for i, motor in enumerate(self.motors):
            torque = (
                stiffness * (target[i] - angles[i])
                + damping * (target[3 + i] - rates[i])
                + target[6 + i]
            )
            client.setJointMotorControl2(
                *motor,
                client.TORQUE_CONTROL,
                force=min(TORQUE_MOTOR.peak_torque, max(-TORQUE_MOTOR.peak_torque, torque)),
            )

    def step(self) -> None:
        """One time step of the engine."""
        self.client.stepSimulation()

    def close(self) -> None:
        """Disconnect."""
        self.client.close()


# -- motions -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """What point P is asked to do: episodes that each start at rest.

    Attributes:
        name: ``"random"``, ``"expert"`` or ``"fast"``.
        commands: Episodes as commands of 25 Hz, (n, 3) m, to be splined as the simulation does.
        sweeps: Episodes as frequencies (3,) Hz with which P sweeps the whole region, for a second
            or more of them.
        seconds: Length of each sweep.
    """

    name: str
    commands: tuple[FloatArray, ...] = ()
    sweeps: tuple[tuple[float, float, float], ...] = ()
    seconds: float = 0.0

    def points(self, time_step: float) -> Iterator[FloatArray]:
        """References of point P, one (n + 1, 3) m an episode; the first row is the start."""
        weights = spline_weights(round(CONTROL_PERIOD / time_step))
        for commands in self.commands:
            padded = np.vstack([commands[:1], commands[:1], commands[1:]])
            splines = [weights @ padded[k : k + 3] for k in range(len(padded) - 2)]
            yield np.vstack([commands[:1], *splines])
        low, high = np.asarray(REGION.low), np.asarray(REGION.high)
        for frequencies in self.sweeps:
            t = np.arange(round(self.seconds / time_step) + 1)[:, None] * time_step
            swing = np.cos(2 * np.pi * t * np.asarray(frequencies))  # at rest at t = 0
            yield (low + high) / 2 + (high - low) / 2 * swing


def random_motion(periods: int, seed: int = 0) -> Motion:
    """Uniform random Cartesian actions, on and on, without the resets of the environment."""
    rng = np.random.default_rng(seed)
    return Motion("random", (_walk(rng.uniform(-1.0, 1.0, (periods, 3))),))


def fast_motion(periods: int, seed: int = 1) -> Motion:
    """Sweeps of 1.5 Hz over the whole region, and full speed with sudden changes of direction."""
    rng = np.random.default_rng(seed)
    turns = rng.choice((-1.0, 1.0), (periods // 16 + 1, 3))
    bangs = _walk(np.repeat(turns, 8, axis=0)[: periods // 2])
    seconds = periods * CONTROL_PERIOD / 4
    # x with y and z held, then all three at frequencies that do not repeat
    return Motion("fast", (bangs,), SWEEPS, seconds)


SWEEPS = ((1.5, 0.0, 0.0), (1.5, 0.37, 1.13))
"""Hz along x, y, z; an axis that does not sweep stays at the upper end of the region."""


def expert_motion(episodes: int, seed: int = 0) -> Motion:
    """The commands of the scripted expert in TPMPickAndPlace-v0, recorded from the environment."""
    env = gym.make("TPMPickAndPlace-v0")
    inside: Any = env.unwrapped
    expert, recorded = Expert(env), []
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        expert.reset(observation)
        commands, done = [MOUNT.to_paper(inside.state.command)], False
        while not done:
            observation, _, terminated, truncated, _ = env.step(expert.act(observation))
            commands.append(MOUNT.to_paper(inside.state.command))
            done = terminated or truncated
        recorded.append(np.array(commands))
    env.close()
    return Motion("expert", tuple(recorded))


def _walk(actions: FloatArray) -> FloatArray:
    """Commands that Cartesian actions (n, 3) lead to from HOME, (n + 1, 3) m."""
    control, commands = CartesianControl(PAPER_TPM), [HOME]
    for action in actions:
        commands.append(control.command(action, commands[-1]))
    return np.array(commands)


def references(motion: Motion, config: Config) -> list[FloatArray]:
    """What :meth:`Rig.drive` takes, a row a time step after the start, an array an episode."""
    episodes = []
    for points in motion.points(config.time_step):
        theta = kinematics.inverse(points)
        if config.motor == "torque":
            rates = np.gradient(theta, config.time_step, axis=0)
            theta = np.hstack([theta, rates, PAPER_TPM.dynamics.gravity(theta)])
        episodes.append(theta)
    return episodes


# -- measuring ---------------------------------------------------------------------------------


@dataclass
class Errors:
    """What was measured along one motion; one row for each time step.

    Attributes:
        gap: (n,) m, the largest loop gap.
        apart: (n,) m, platform against forward kinematics of the encoders.
        tilt: (n,) rad.
        conditioning: (n,) 1/cond(J) at the encoders.
        tracking: (n,) m, platform against its reference.
        lost: Time step at which the mechanism came apart, or None.
    """

    gap: FloatArray
    apart: FloatArray
    tilt: FloatArray
    conditioning: FloatArray
    tracking: FloatArray
    lost: int | None


def measure(rig: Rig, motion: Motion) -> Errors:
    """Follow a motion and measure at every time step, until its end or until a loop is lost."""
    points = list(motion.points(rig.config.time_step))
    rows: list[tuple[float, ...]] = []
    wanted: list[FloatArray] = []
    for reference, path in zip(references(motion, rig.config), points, strict=True):
        rig.place(reference[0, :3])
        for target, point in zip(reference[1:].tolist(), path[1:], strict=True):
            rig.drive(target)
            rig.step()
            gap, position, tilt = rig.robot.truth()
            rows.append((gap, tilt, *position, *rig.robot.motors().theta))
            wanted.append(point)
            if not gap <= CLOSURE_LIMIT:  # a NaN ends it too
                return _evaluate(np.array(rows), np.array(wanted))
    return _evaluate(np.array(rows), np.array(wanted))


def _evaluate(rows: FloatArray, wanted: FloatArray) -> Errors:
    """Errors of (n, 8) rows of gap, tilt, platform (world) and encoders, up to where it is lost."""
    gap, tilt, position, theta = rows[:, 0], rows[:, 1], rows[:, 2:5], rows[:, 5:8]
    apart, conditioning = against_kinematics(theta, position)
    tracking = np.linalg.norm(MOUNT.to_paper(position) - wanted, axis=-1)
    bad = np.flatnonzero(~((gap <= CLOSURE_LIMIT) & (apart <= ASSEMBLY_LIMIT)))
    lost = int(bad[0]) + 1 if len(bad) else None
    keep = slice(None if lost is None else lost - 1)
    return Errors(gap[keep], apart[keep], tilt[keep], conditioning[keep], tracking[keep], lost)


def against_kinematics(theta: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance of P (n, 3) m, world, to where the encoders (n, 3) rad put it, and 1/cond(J) there.

    Where no assembly explains the encoders, the distance is infinite and 1/cond(J) zero.
    """
    apart, conditioning = np.full(len(theta), np.inf), np.zeros(len(theta))
    finite = np.isfinite(theta).all(axis=-1) & np.isfinite(position).all(axis=-1)
    solutions = kinematics.forward_all(np.where(finite[:, None], theta, 0.0))
    slot = kinematics.DEFAULT_ASSEMBLY.index
    valid = finite & solutions.valid[:, slot]
    expected = MOUNT.to_world(solutions.position[valid, slot])
    apart[valid] = np.linalg.norm(position[valid] - expected, axis=-1)
    conditioning[valid] = jacobian.conditioning(theta[valid])
    return apart, conditioning


def seconds_per_step(rig: Rig, reference: FloatArray) -> float:
    """CPU time of a time step with its motor commands along one episode, s.

    CPU time, because other work on the machine stretches the clock but hardly this. NaN where
    the mechanism does not hold together.
    """
    rig.place(reference[0, :3])
    targets = reference[1:].tolist()
    start = time.process_time()
    for target in targets:
        rig.drive(target)
        rig.step()
    taken = time.process_time() - start
    gap = rig.robot.truth()[0]
    return taken / len(targets) if gap <= CLOSURE_LIMIT else math.nan
