r"""Task of pushing the block, in which engines differ most, because the block nearly tips over.

The block has to slide to a goal on the table, without vacuum. The cup stays at least 12 mm above
the middle of the block, so that a push nearly tips it. Policies also drag the block by its upper
edge.

    cd benchmarks
    python -m tpm_gym.learning train --algo ppo --engine analytic --env shoving:TPMShoveDense-v0 \
        --recipe shoving.yml --seed 0 --run ../runs/transfer/shove-s0
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import tpm_gym
from tpm_gym.arrays import FloatArray
from tpm_gym.simulation.state import State
from tpm_gym.tasks import Entry, PickAndPlace, hanging, sampling
from tpm_gym.tasks.task import dense

FARTHEST = 0.100  # largest distance from start to goal, m
FAST = 0.15  # speed without a penalty, m/s


class Shove(PickAndPlace):
    """Slide the block to a goal on the table.

    Attributes:
        haste: Penalty per control step, for each m/s of the block's speed beyond FAST.
    """

    vacuum = False
    samplings = ("sampled",)
    haste = 3.0

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """Both on the table, APART to FARTHEST from each other."""
        table, machine = self.on_table(self.block), self.machine
        first, last = np.empty((2, len(rngs), 3))
        rows = np.arange(len(rngs))
        while len(rows):
            own = [rngs[row] for row in rows]
            ends = sampling.safe_points(own, machine, {"first": [table], "last": [table]}, {})
            first[rows], last[rows] = ends["first"], ends["last"]
            rows = np.flatnonzero(self.gap(first, last) > FARTHEST)
        offset, to_world = hanging(self.block), machine.mount.to_world
        drawn = {"object": to_world(first) - offset, "goal": to_world(last) - offset}
        return {**drawn, **chosen}

    def observed(self) -> tuple[Entry, ...]:
        """Return entries of the robot and the block, without whether the block is held."""
        return (*self.robot_entries(), *self.object_entries()[:-1])

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus the distance from lip to block, and the penalty on speed."""
        speed = np.linalg.norm(state.object_velocity[:, 0], axis=-1)
        away = self.gap(self.lip(state), state.object_position[:, 0])
        return {
            "approach": 0.25 * dense(away),
            "haste": -self.haste * np.maximum(speed - FAST, 0.0),
        }


class ShoveGently(Shove):
    """Variant with a stronger penalty on speed."""

    haste = 10.0


tpm_gym.register_task("Shove", Shove)
tpm_gym.register_task("ShoveGently", ShoveGently)
