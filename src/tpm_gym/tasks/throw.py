"""Throw: release a block in motion, so that it slides to rest at a goal outside the workspace."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.mount import GRAVITY
from tpm_gym.simulation.state import Block, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Task, dense

NEAREST: Final = 0.040
FARTHEST: Final = 0.150
"""Bounds (NEAREST, FARTHEST) of the distance of goals from the region's end along x, m."""
CLEARANCE: Final = 0.028
"""Height of the cup over the block before and after the expert picks it, m."""
DROP: Final = 0.003
"""Height over the table at which the block is let go, m; low, so that the block does not tumble."""
BRAKING: Final = 0.050
"""Distance from the place of release to the end of the region, m; P stops within this distance."""
RUN_UP: Final = (1 / 3, 2 / 3, 1.0, 1.0, 1.0)
"""Lengths of the command's steps in the run-up, as shares of the last step.

The last step switches the vacuum off. The path in a control period depends on two steps. So three
equal steps keep the speed constant in the last two control periods, until the cup lets go.
"""
VENTED: Final = CUP.venting_time * math.log(CUP.vacuum / CUP.least_vacuum) / Task.control_period
"""Number of control periods from switching the vacuum off until the block is free."""
AHEAD: Final = 1.5 - VENTED
"""Distance from the place of release to the last command of the run-up, in units of the last step.

The spline lags the commands by half a period.
"""
_RUN_UP_WAY: Final = sum(RUN_UP) - AHEAD  # from the start to the release, in units of the last step
_BRAKING_WAY: Final = AHEAD + sum(RUN_UP[:2])  # from the release to the stop
_DRAWS: Final = 256


class Throw(Task):
    """Pick up a block and release it in motion, so that it slides to the goal and stops there.

    The goals lie on the table outside the workspace, 40 to 150 mm beyond either end of the
    machine's region along x, as far as the table and the speed of the machine allow. The block is
    slippery: at a speed v it slides by v^2 / (2 mu g), with mu = 0.1 against the table. The goal is
    achieved if the block's centre is within 20 mm of it. With ``goals="tempting"``, the lowest
    conditioning while P accelerates for the throw and brakes is just above the safe threshold.
    """

    block = Block(friction=0.1)
    scene = Scene(objects=(block,), marker_radius=0.020)
    vacuum = True
    tolerance = 0.020
    samplings = ("sampled", "tempting")
    max_episode_steps = 60

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        starts = dict(chosen)
        if "object" not in starts:
            table = {"object": [self.on_table(self.block)]}
            points = sampling.safe_points(rngs, self.machine, table, {})["object"]
            starts["object"] = self.machine.mount.to_world(points) - hanging(self.block)
        if "goal" not in starts:
            starts["goal"] = np.array([self._draw_goal(rng) for rng in rngs])
        return starts

    def _draw_goal(self, rng: np.random.Generator) -> FloatArray:
        """Draw a goal (3,) m for which P is safe while it accelerates for the throw and brakes."""
        boxes, table = self.goals_of(self.block), self.on_table(self.block)
        ends = np.stack([self.machine.mount.to_world(end) for end in (table.low, table.high)])

        def draw(rng: np.random.Generator) -> FloatArray:
            goals = rng.uniform(*boxes[rng.integers(len(boxes))], (_DRAWS, 3))
            goals[:, 1] = rng.uniform(ends[:, 1].min(), ends[:, 1].max(), _DRAWS)
            return goals

        return sampling.safe_draw(rng, self.machine, self.goals, draw, self._lane)

    def goals_of(self, block: Block | None) -> list[tuple[FloatArray, FloatArray]]:
        """Return lower and upper corners (m) of the goals' boxes, beyond both ends of the region.

        Raises:
            ConfigurationError: If there is no such box.
        """
        low, high = self.reach_of(block)
        longest = min(self.machine.step_limit[0], (high[0] - low[0] - BRAKING) / _RUN_UP_WAY)
        fastest = max(longest, 0.0) / self.control_period
        slides = fastest**2 / (2 * self.block.friction * GRAVITY)
        edge = self.machine.table[0] - self.block.width / 2 - self.tolerance
        boxes = []
        for side, end in ((-1.0, low[0]), (1.0, high[0])):
            farthest = min(FARTHEST, slides - BRAKING, edge - side * end)
            if farthest > NEAREST:
                box = np.array([low, high])
                box[:, 0] = np.sort(end + side * np.array([NEAREST, farthest]))
                box[:, 2] = self.block.height / 2
                boxes.append((box[0], box[1]))
        if not boxes:
            beyond = NEAREST + self.block.width / 2 + self.tolerance
            valid = (
                f"one whose table goes on for more than {beyond:.3g} m beyond its region along x"
            )
            fast = math.sqrt(2 * self.block.friction * GRAVITY * (BRAKING + NEAREST))
            valid += f", and that runs up to more than {fast:.2g} m/s within the region"
            raise ConfigurationError("machine", self.machine.name, valid)
        return boxes

    def _release(self, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the place (..., 3) m of the release, and the run-up's last step along x (...,) m.

        When the block hits the table after a fall by h, friction (coefficient mu) reduces its speed
        v by mu sqrt(2 g h). The fall and the slide together cover v^2 / (2 mu g) + mu h along x.
        """
        low, high = self.reach_of(self.block)
        side = np.where(goal[..., 0] > (low[0] + high[0]) / 2, 1.0, -1.0)
        place = goal.copy()
        place[..., 0] = np.where(side > 0, high[0], low[0]) - side * BRAKING
        place[..., 2] += DROP
        way, friction = np.abs(goal - place)[..., 0], self.block.friction
        speed = np.sqrt(2 * friction * GRAVITY * np.maximum(way - friction * DROP, 0.0))
        return place, side * speed * self.control_period

    def _lane(self, goal: FloatArray) -> FloatArray:
        """Return start of run-up and end of braking of P, (..., 2, 3) m, machine's frame."""
        place, step = self._release(goal)
        lane = np.stack([place, place], axis=-2)
        lane[..., 0, 0] -= _RUN_UP_WAY * step
        lane[..., 1, 0] += _BRAKING_WAY * step
        paper: FloatArray = self.machine.mount.to_paper(lane + hanging(self.block))
        return paper

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus half the distance from cup to block / 0.1 m, for a dense reward only.

        It is 0 if the block is out of reach, because the block has then been thrown.
        """
        if self.reward == "sparse":
            return {}
        place, (low, high) = state.object_position[:, 0, 0], self.reach_of(self.block)
        within = (place >= low[0]) & (place <= high[0])
        return {"approach": 0.5 * within * dense(self.gap(self.lip(state), self.top(state)))}

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Pick up the block, carry it to the start of the run-up, throw it, and brake."""
        name, up = self.block.name, np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
        goal, step = motion.goal, float(self._release(motion.goal)[1])
        while True:
            yield from motion.pick(self.block, CLEARANCE)
            if not motion.holding(name):
                continue
            # The cup sits where it took the block, not on the block's middle.
            shift = motion.seen["position"] - motion.seen["object_position"] - hanging(self.block)
            begin = self._lane(goal)[0] + self.machine.mount.rotate(shift * (1.0, 1.0, 0.0))
            stops = [motion.command + up, begin + up, begin]
            yield from motion.go(stops, vacuum=True, while_holding=name)
            if motion.holding(name):
                break
        yield from self._throw(begin, step)

    def _throw(self, point: FloatArray, step: float) -> Iterator[Move]:
        """Run up from ``point``, switch the vacuum off in the last step, brake and leave."""
        for index, share in enumerate(RUN_UP, start=1):
            point = point + (share * step, 0.0, 0.0)
            yield Move(point, index < len(RUN_UP))
        for share in reversed(RUN_UP[:2]):
            point = point + (share * step, 0.0, -CLEARANCE / 2)
            yield Move(point, False)
