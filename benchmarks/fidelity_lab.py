"""Mechanisms in a physics client, motions, and measurements of their errors.

The mechanism is loaded and its loops are closed by the same class as in the environments
(:class:`tpm_gym.simulation.bullet.robot.Robot`). Only settings of the engine and motors vary.
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
from tpm_gym.mechanism.compiled import ASSEMBLY_LIMIT
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation.bullet.client import Client
from tpm_gym.simulation.bullet.physics import REGULARISATION, Physics
from tpm_gym.simulation.bullet.robot import Robot
from tpm_gym.simulation.bullet.silence import silence
from tpm_gym.simulation.engine import spline_weights
from tpm_gym.simulation.settings import count_steps
from tpm_gym.simulation.simulation import CLOSURE_LIMIT
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.tasks import Expert
from tpm_gym.tasks.control import CartesianControl

DEFAULT = Physics()
CONDITIONED = 0.05
"""1/cond(J) above which forward kinematics must meet its strict limit."""
HOME, REGION, MOUNT = np.array(PAPER_TPM.home), PAPER_TPM.region, PAPER_TPM.mount


# -- settings ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Config:
    """Settings of one row of the sweep; the defaults are those of the environments.

    Attributes:
        family: Group in the table, and colour in the plot.
        name: Difference from the default.
        variant: Name of a variant of :mod:`variants`.
        solver: ``"direct"`` (Dantzig), ``"iterative"`` (sequential impulses) or ``"lcp pgs"``.
        time_step: Time step, s.
        iterations: Iterations of the iterative solvers.
        erp: Share of a constraint's error that is removed in one step.
        cfm: Compliance added to the constraints.
        residual: Threshold at which the iterative solver stops early; None: the engine's default.
        motor: ``"servo"`` (a velocity constraint) or ``"torque"``.
        gains: Gains of torque control, N m/rad and N m s/rad.
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
        """Number of time steps in a control period."""
        return count_steps(CONTROL_PERIOD, self.time_step)

    @property
    def physics(self) -> Physics:
        """Settings that the environments offer."""
        solver = "direct" if self.solver == "direct" else "iterative"
        return Physics(self.time_step, solver, self.iterations, self.erp)

    @property
    def beyond(self) -> dict[str, float]:
        """Settings of the engine that the environments do not offer."""
        settings: dict[str, float] = {}
        if self.solver == "lcp pgs":
            settings["constraintSolverType"] = pybullet.CONSTRAINT_SOLVER_LCP_PGS
        if self.cfm != REGULARISATION:
            settings["globalCFM"] = self.cfm
        if self.residual is not None:
            settings["solverResidualThreshold"] = self.residual
        return settings


class Rig:
    """Mechanism alone in a client of its own.

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
        """Put the mechanism at rest at theta (3,) rad, with closed loops."""
        self.robot.place(self.variant.angles(theta))

    def drive(self, target: list[float]) -> None:
        """Command the motors for one time step.

        A servo is a velocity constraint. Torque control is a PD law about the reference plus the
        torques that balance gravity there, within the same limit.

        Args:
            target: Three angles, rad; for torque control also three rates and three torques.
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
        """Run one time step of the engine."""
        self.client.stepSimulation()

    def close(self) -> None:
        """Disconnect."""
        self.client.close()


# -- motions -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """Motion of point P: episodes that start at rest.

    Attributes:
        name: ``"random"``, ``"expert"`` or ``"fast"``.
        commands: Episodes as commands of 25 Hz, (n, 3) m, that are splined as in the simulation.
        sweeps: Episodes as frequencies (3,) Hz of sweeps of P over the whole region.
        seconds: Length of each sweep, s.
    """

    name: str
    commands: tuple[FloatArray, ...] = ()
    sweeps: tuple[tuple[float, float, float], ...] = ()
    seconds: float = 0.0

    def points(self, time_step: float) -> Iterator[FloatArray]:
        """Yield the references of P for each episode, (n + 1, 3) m; the first row is the start."""
        weights = spline_weights(count_steps(CONTROL_PERIOD, time_step))
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
    """Return a motion of uniform random Cartesian actions, without resets."""
    rng = np.random.default_rng(seed)
    return Motion("random", (_walk(rng.uniform(-1.0, 1.0, (periods, 3))),))


def fast_motion(periods: int, seed: int = 1) -> Motion:
    """Return a motion at full speed with sudden changes of direction, and sweeps of 1.5 Hz."""
    rng = np.random.default_rng(seed)
    turns = rng.choice((-1.0, 1.0), (periods // 16 + 1, 3))
    bangs = _walk(np.repeat(turns, 8, axis=0)[: periods // 2])
    seconds = periods * CONTROL_PERIOD / 4
    # First x sweeps alone, then all three axes at frequencies without a common period.
    return Motion("fast", (bangs,), SWEEPS, seconds)


SWEEPS = ((1.5, 0.0, 0.0), (1.5, 0.37, 1.13))
"""Hz along x, y, z; an axis that does not sweep stays at the upper end of the region."""


def expert_motion(episodes: int, seed: int = 0) -> Motion:
    """Return the recorded commands of the scripted expert in TPMPickAndPlace-v0."""
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
    """Return the commands (n + 1, 3) m of Cartesian actions (n, 3) that start at HOME."""
    control, commands = CartesianControl(PAPER_TPM), [HOME]
    for action in actions:
        commands.append(control.command(action[None], np.array([commands[-1]]))[0])
    return np.array(commands)


def references(motion: Motion, config: Config) -> list[FloatArray]:
    """Return targets of :meth:`Rig.drive`: an array for each episode, a row for each time step."""
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
    """Errors along one motion, a row for each time step.

    Attributes:
        gap: (n,) m, largest loop gap.
        apart: (n,) m, distance of the platform from the forward kinematics of the encoders.
        tilt: (n,) rad, tilt of the platform.
        conditioning: (n,) 1/cond(J) at the encoders.
        tracking: (n,) m, distance of the platform from its reference.
        lost: Time step at which the mechanism lost a loop, or None.
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
            rows.append((gap, tilt, *position, *rig.robot.motors()[0]))
            wanted.append(point)
            if not gap <= CLOSURE_LIMIT:  # also true for NaN
                return _evaluate(np.array(rows), np.array(wanted))
    return _evaluate(np.array(rows), np.array(wanted))


def _evaluate(rows: FloatArray, wanted: FloatArray) -> Errors:
    """Return the errors of rows (n, 8) of gap, tilt, platform (world) and encoders until a loss."""
    gap, tilt, position, theta = rows[:, 0], rows[:, 1], rows[:, 2:5], rows[:, 5:8]
    apart, conditioning = against_kinematics(theta, position)
    tracking = np.linalg.norm(MOUNT.to_paper(position) - wanted, axis=-1)
    bad = np.flatnonzero(~((gap <= CLOSURE_LIMIT) & (apart <= ASSEMBLY_LIMIT)))
    lost = int(bad[0]) + 1 if len(bad) else None
    keep = slice(None if lost is None else lost - 1)
    return Errors(gap[keep], apart[keep], tilt[keep], conditioning[keep], tracking[keep], lost)


def against_kinematics(theta: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compare P (n, 3) m, world, with the forward kinematics of the encoders theta (n, 3) rad.

    Returns:
        Distance (n,) m, and 1/cond(J) (n,). For encoders without an assembly the distance is
        infinite and 1/cond(J) is zero.
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
    """Measure the CPU time of a time step with its motor commands along one episode, s.

    Other work on the computer changes CPU time far less than wall-clock time. The result is NaN if
    a loop is lost.
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
