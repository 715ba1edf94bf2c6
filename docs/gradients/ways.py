"""Motion of a block that takes the least torque, by gradients of closed-form dynamics."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gradients.descent import minimise
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import inverse
from tpm_gym.kinematics.workspace import conditioning_at
from tpm_gym.mechanism import TPM
from tpm_gym.mechanism.tpm.dynamics import Dynamics
from tpm_gym.simulation import Block, Scene, Simulation
from tpm_gym.simulation.engine import Path, spline_weights
from tpm_gym.simulation.state import CONTROL_PERIOD
from tpm_gym.tasks import sampling
from tpm_gym.tasks.control import CartesianControl
from tpm_gym.tasks.motion import SEALING, Motion, hanging
from tpm_gym.tasks.pick_and_place import CLEARANCE, PickAndPlace

WELL = 0.005
"""Approximate distance to the ends within which a motion may be below the clearance, m."""
BLOCK = Block()
_SUBSTEPS = 10  # the engines' time steps in a control period
_WEIGHTS = (1e-3, 1e-4, 1e-5)
_RISE = 0.001  # over the expert's way, whose clearance is exact, m


@dataclass(frozen=True)
class Carry:
    """Task of carrying a block from place to place on the table, from rest to rest.

    A way is a row of commands for P (n, 3) m at the control's 25 Hz, as :meth:`Simulation.move`
    takes them: P follows their spline, and so is where it begins and ends.

    Attributes:
        machine: Which carries it.
        first: Point P where the block was taken, machine's frame, m.
        last: Where it is put.
    """

    machine: TPM
    first: FloatArray
    last: FloatArray

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the machine with the block."""
        return replace(self.machine.dynamics, payload=BLOCK.mass)

    def expert(self) -> Tensor:
        """Return the scripted expert's motion: straight up, over, down at trapezoidal speed."""
        machine, up = self.machine, np.array([0.0, 0.0, -CLEARANCE])
        motion, commands = Motion(machine, CartesianControl(machine)), [self.first, self.first]
        motion.seen = {"position": machine.mount.to_world(self.first), "command": np.zeros(3)}
        for move in motion.go([self.first + up, self.last + up, self.last], vacuum=True):
            motion.seen["position"] = machine.mount.to_world(move.point)
            commands.append(move.point)
        return torch.tensor(np.array([*commands, self.last]))

    def joints(self, commands: Tensor) -> Tensor:
        """Compute joint angles at the time steps of the engines, with both ends, (n, 3) rad."""
        return inverse(points(commands), self.machine.working_mode, self.machine.geometry)

    def torque(self, commands: Tensor) -> Tensor:
        """Compute the motors' torques (n - 2, 3) N m, at the time steps between."""
        theta, period = self.joints(commands), CONTROL_PERIOD / _SUBSTEPS
        rate = (theta[2:] - theta[:-2]) / (2 * period)
        change = (theta[2:] - 2 * theta[1:-1] + theta[:-2]) / period**2
        return self.dynamics.torque(theta[1:-1], rate, change)

    def room(self, commands: Tensor) -> Tensor:
        """Compute the margins to all limits, each in its own unit: positive where allowed.

        The machine's region and step limit, its safe conditioning, and the expert's clearance over
        the table, but for a well around either end.
        """
        machine, on_way = self.machine, points(commands)[1:-1]
        low, high, limit = map(
            torch.tensor, (machine.region.low, machine.region.high, machine.step_limit)
        )
        free, steps = commands[2:-2], commands[1:-1].diff(dim=0) / limit
        modes = machine.working_mode, machine.assembly_mode, machine.geometry
        conditioning = conditioning_at(on_way, *modes)
        wells = [
            torch.exp(-((on_way[:, :2] - end[:2]) ** 2).sum(-1) / WELL**2)
            for end in (commands[0], commands[-1])
        ]
        height = (commands[0, 2] - on_way[:, 2]) / CLEARANCE  # the paper's z points down
        return torch.cat(
            [
                ((free - low) / (high - low)).flatten(),
                ((high - free) / (high - low)).flatten(),
                (1 - steps).flatten(),
                (1 + steps).flatten(),
                conditioning / machine.safe_conditioning - 1,
                height - (1 - wells[0]) * (1 - wells[1]),
            ]
        )

    def least_torque(self) -> Tensor:
        """Find the motion with the least RMS torque and as many commands as the expert's."""
        start = self.expert()
        start[3:-3, 2] -= _RISE
        step = torch.tensor(self.machine.step_limit)

        def full(part: Tensor) -> Tensor:
            return torch.cat([start[:2], part.reshape(-1, 3) * step, start[-2:]])

        found = minimise(
            lambda part: torch.log(rms(self.torque(full(part)))),
            lambda part: self.room(full(part)),
            (start[2:-2] / step).flatten(),
            _WEIGHTS,
        )
        return full(found)

    def simulated(self, commands: Tensor) -> Tensor:
        """Measure the motors' torques (m - 3, 3) N m in PyBullet, with the block in the cup.

        All time steps but the last two, in which it lands.

        Raises:
            RuntimeError: If the cup does not hold the block at the end.
        """
        centre = self.machine.mount.to_world(self.first) - hanging(BLOCK)
        with closing(Simulation(Scene(objects=(BLOCK,)), machine=self.machine)) as simulation:
            theta, on = self.joints(commands).numpy(), np.array([True])
            simulation.reset(np.array([0]), theta[0], {BLOCK.name: centre[None]})
            for _ in range(round(2 * SEALING / CONTROL_PERIOD)):
                simulation.move(np.array([self.first]), on)
            torques = []
            for joints in theta[1:-2]:
                simulation.engine.advance(_TimeStep(joints), on)
                torques.append(simulation.engine.read().torque[0])
            if simulation.engine.read().held[0] != 0:
                raise RuntimeError("the block was lost")
        return torch.tensor(np.array(torques))


class _TimeStep(Path):
    """Path of one time step, by its joint positions (3,) rad."""

    def __init__(self, theta: FloatArray) -> None:
        """Store them."""
        self._theta = theta

    def joints(self, last: int = 0) -> FloatArray:
        """Return them, (1, 1, 3)."""
        return self._theta[None, None]


def points(commands: Tensor) -> Tensor:
    """Return P at the start and after each time step, (10 (n - 2) + 1, 3) m."""
    weights = torch.tensor(spline_weights(_SUBSTEPS))
    inner = torch.einsum("sw,kcw->ksc", weights, commands.unfold(0, 3, 1)).reshape(-1, 3)
    return torch.cat([commands[:1], inner])


def rms(torque: Tensor) -> Tensor:
    """Compute the RMS over time and motors."""
    return (torque**2).mean().sqrt()


def draw(machine: TPM, count: int, seed: int = 0) -> list[Carry]:
    """Sample places as the task does: safe ones on the table, not too near to each other."""
    rng, table = np.random.default_rng(seed), PickAndPlace(machine).on_table(BLOCK)
    low, high = np.array(table.low), np.array(table.high)

    def place() -> FloatArray:
        while True:
            point = low + (high - low) * rng.random(3)
            if machine.conditioning_at(point) >= machine.safe_conditioning:
                return point

    carries = []
    for _ in range(count):
        first, last = place(), place()
        while np.linalg.norm(last - first) < sampling.APART:
            last = place()
        carries.append(Carry(machine, first, last))
    return carries
