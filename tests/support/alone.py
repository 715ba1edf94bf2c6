"""One robot in a simulation, as tests of its physics see it: states without a leading axis."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation import Plant, Scene, Simulation, State
from tpm_gym.simulation.randomisation import NOMINAL
from tpm_gym.simulation.simulation import Snapshot

ROW = np.array([0])
PLACE = np.array([-0.04, 0.028])  # m, x and y of point P, machine's frame
SPRUNG = CUP.preload + PAPER_TPM.mechanism.link("cup").mass * GRAVITY
"""Force of the cup on what it rests on, N."""


def level(height: float, way: ArrayLike = (0.0, 0.0)) -> FloatArray:
    """Point P (machine's frame) with the lip at ``height`` above the table."""
    return np.array([*(PLACE + way), PAPER_TPM.mount.height - height - CUP.length])


class Alone:
    """A :class:`Simulation` of one robot; the attributes are those of the simulation."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        self.simulation = Simulation(scene or Scene(), **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.simulation, name)

    def reset(
        self,
        theta: ArrayLike,
        objects: Mapping[str, ArrayLike] | None = None,
        plant: Plant = NOMINAL,
        noise: ArrayLike | None = None,
    ) -> State:
        """Place the robot at theta (3,) rad, and objects at (3,) m."""
        places = {name: [place] for name, place in (objects or {}).items()}
        self.simulation.reset(ROW, theta, places, [plant], _row(noise))
        return self.read()

    def move(
        self, command: ArrayLike, vacuum: bool = False, noise: ArrayLike | None = None
    ) -> State:
        """Command point P (3,) m, machine's frame, and run a control period."""
        self.simulation.move(np.array([command], dtype=float), np.array([vacuum]), _row(noise))
        return self.read()

    def read(self) -> State:
        return self.simulation.state().take(0)

    def restore(self, snapshot: Snapshot) -> State:
        self.simulation.restore(snapshot)
        return self.read()


def _row(values: ArrayLike | None) -> Any:
    return None if values is None else np.array([values], dtype=float)


class Motors(NamedTuple):
    """Joint positions (rad), velocities (rad/s) and torques (N m) in the last time step."""

    theta: FloatArray
    theta_dot: FloatArray
    torque: FloatArray


def motors(simulation: Any) -> Motors:
    """Read the motors of one robot, in the midst of a control period too."""
    engine = simulation.engine
    theta, rates, torque = map(np.array, engine.robot.motors())
    return Motors(
        theta, rates, torque if engine._drives is None else engine._drives.memory[0, 0].copy()
    )


def jumping(theta: ArrayLike, steps: int = 1) -> Any:
    """A path on which ideal motors go to theta (3,) rad at once."""
    joints = np.tile(np.array(theta, dtype=float), (1, steps, 1))
    return SimpleNamespace(joints=lambda: joints)
