"""Conveyor: pick up a block from a belt that runs, and bring it to the tray."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain, repeat
from typing import Any, Final

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.state import Belt, Block, Patch, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.motion import Motion, Move, hanging
from tpm_gym.tasks.task import Entry, Task, dense

SPEEDS: Final = (0.05, 0.20)
"""Lowest and highest speed of the belt, m/s."""
LATEST: Final = 1.0
"""Longest time until the block comes within reach, s."""
SHARE: Final = 0.55
"""Share of the machine's region along x that is over the belt."""
EDGE: Final = 0.030
"""Smallest distance of goals from the end of the belt, m."""
CLEARANCE: Final = 0.028
"""Height over start and goal, m: the cup comes down from this height, and goes up to it again."""
UP: Final = np.array([0.0, 0.0, -CLEARANCE])  # paper z points down
SEALING: Final = 4
"""Largest number of control steps for which the cup follows the block until the cup seals."""
GAP: Final = 0.010
"""Distance of the tray from the end of the belt, m."""
TRAY_COLOUR: Final = (0.45, 0.62, 0.80, 1.0)
_DRAWS: Final = 256


class Conveyor(Task):
    """Pick up a block from a running belt with the vacuum cup, and bring it to the tray.

    The belt runs along x. Its speed, 0.05 to 0.20 m/s, is drawn for each episode. The block comes
    within reach in the first second. The camera shows the block 3 control steps late, in the
    observation and in the achieved goal. The goal lies in the tray, on the table beyond the belt.
    With ``goals="tempting"``, the block and the goal each lie on a line parallel to x. On both
    lines, the robot's lowest conditioning is just above the safe threshold.
    """

    block = Block()
    scene = Scene(objects=(block,))
    vacuum = True
    camera_delay = 3
    samplings = ("sampled", "tempting")
    max_episode_steps = 80
    upstream = 0.25
    """Length of the belt before the region, m."""

    def __init__(self, machine: Machine, *args: Any, **options: Any) -> None:
        """Place belt and tray for the machine; see the base class."""
        ends = machine.mount.to_world(np.array([machine.region.low, machine.region.high]))
        low, high, half = ends.min(axis=0), ends.max(axis=0), self.block.width / 2
        start = float(min(low[0] - self.upstream, -machine.table[0]))
        self.belt = Belt(start, float(low[0] + SHARE * (high[0] - low[0])))
        tray = Patch(
            (self.belt.end + GAP, low[1] - half), (high[0] + half, high[1] + half), TRAY_COLOUR
        )
        self.scene = replace(type(self).scene, belt=self.belt, patches=(tray,))
        super().__init__(machine, *args, **options)

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        starts, (low, high) = dict(chosen), self._floor
        if "belt_speed" not in starts:
            starts["belt_speed"] = np.array([rng.uniform(*SPEEDS, 1) for rng in rngs])
        if "object" not in starts:
            early = np.array([rng.uniform(0.0, LATEST, 1) for rng in rngs]) * starts["belt_speed"]
            lanes = np.array([self._draw(low[0], self.belt.end, rng) for rng in rngs])
            lanes[:, 0] = np.maximum(low[0] - early[:, 0], self.starts_of(self.block)[0][0])
            starts["object"] = lanes
        if "goal" not in starts:
            first = self.belt.end + EDGE
            starts["goal"] = np.array([self._draw(first, high[0], rng) for rng in rngs])
        return starts

    @cached_property
    def _floor(self) -> tuple[FloatArray, FloatArray]:
        """Low and high corner (3,) m, world, of the area where a block's centre is within reach."""
        table, hung = self.on_table(self.block), hanging(self.block)
        ends = self.machine.mount.to_world(np.array([table.low, table.high])) - hung
        return ends.min(axis=0), ends.max(axis=0)

    def _draw(self, first: float, last: float, rng: np.random.Generator) -> FloatArray:
        """Draw a place (3,) m on a safe line along x that extends from ``first`` to ``last``."""
        low, high = self._floor

        def draw(rng: np.random.Generator) -> FloatArray:
            return rng.uniform((first, *low[1:]), (last, *high[1:]), (_DRAWS, 3))

        def ways(places: FloatArray) -> FloatArray:
            ends = np.stack([places, places], axis=1)
            ends[:, :, 0] = first, last
            points: FloatArray = self.machine.mount.to_paper(ends + hanging(self.block))
            return points

        return sampling.safe_draw(rng, self.machine, self.goals, draw, ways)

    def starts_of(self, block: Block | None) -> tuple[FloatArray, FloatArray]:
        """Return the corners of the part of the belt that is within the robot's reach in y."""
        low, high = self.reach_of(block)
        low[0], high[0] = self.belt.start + self.block.width, self.belt.end
        high[2] = low[2]
        return low, high

    def goals_of(self, block: Block | None) -> list[tuple[FloatArray, FloatArray]]:
        """Return the corners of the part of the tray that the robot can reach."""
        low, high = self.reach_of(block)
        low[0], high[2] = self.belt.end + EDGE, low[2]
        return [(low, high)]

    def observed(self) -> tuple[Entry, ...]:
        """Return the entries of the observation vector: of the robot, each block, and the belt."""
        middle, half = sum(SPEEDS) / 2, (SPEEDS[1] - SPEEDS[0]) / 2
        meaning = "speed of the belt, by its encoder"
        speed = Entry("belt_speed", "m/s", meaning, (middle,), (half,), _belt_speed)
        return (*super().observed(), speed)

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return minus half the distance from cup to block / 0.1 m, for a dense reward only."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * dense(self.gap(self.lip(state), self.top(state)))}

    # -- the expert -------------------------------------------------------------------------------

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Bring one block after the other from the belt to its place in the tray."""
        leave: list[FloatArray] = []
        for block, goal in zip(self.scene.objects, motion.goal.reshape(-1, 3), strict=True):
            camera = _Camera(self, motion, block)
            yield from camera.watch(self._deliver(camera, goal, leave))
            leave = [motion.command + UP]
        yield from motion.go(leave, vacuum=False)

    def _deliver(
        self, camera: _Camera, goal: FloatArray, leave: list[FloatArray]
    ) -> Iterator[Move]:
        """Follow a block on the belt with the cup, pick the block up, and put it into the tray."""
        motion, name = camera.motion, camera.block.name
        while True:
            yield from self._pick(camera, leave)
            leave = []
            if not motion.holding(name):
                continue
            yield from motion.go([motion.command + UP], True, name)
            place = self.machine.mount.to_paper(goal + camera.grip())
            yield from motion.go([place + UP, place], True, name, rounded=True)
            if motion.holding(name):
                break
        yield from [Move(place, True), Move(place, True), Move(place, False)]  # the platform lags

    def _pick(self, camera: _Camera, leave: list[FloatArray]) -> Iterator[Move]:
        """Wait until the block is within reach or stands still, follow it, and seal the cup."""
        motion, first = camera.motion, self._floor[0][0]
        gate = camera.above(CLEARANCE)
        gate[0] = self.machine.mount.to_paper(np.array([first, 0.0, 0.0]))[0]
        lifting = len(motion.trapezoid(motion.command, *leave)) if leave else 0
        way = motion.go([*leave, gate], vacuum=False, rounded=True)
        for step, move in enumerate(chain(way, repeat(Move(gate, False)))):
            if step >= lifting and (camera.place()[0] >= first or abs(camera.step()).max() < 1e-6):
                break
            yield move
        yield from motion.meet(partial(camera.above, 0.0), camera.step(), UP)
        for _ in range(SEALING):
            if motion.holding(camera.block.name):
                return
            yield Move(camera.above(0.0), True)


class _Camera:
    """Estimate of a block's present position from delayed pictures."""

    def __init__(self, task: Conveyor, motion: Motion, block: Block) -> None:
        self.motion, self.block, self._task = motion, block, task
        self._trail = deque([motion.seen["position"]], maxlen=task.camera_delay + 1)

    def watch(self, moves: Iterator[Move]) -> Iterator[Move]:
        """Yield moves, and record the position of P after each."""
        for move in moves:
            yield move
            self._trail.append(self.motion.seen["position"])

    def step(self) -> FloatArray:
        """Return the block's displacement (3,) m by the belt in a control step, machine's frame."""
        speed = float(self.motion.seen["belt_speed"][0])
        riding = self._seen("position")[0] < self._task.belt.end
        way = np.array([riding * speed * self.motion.period, 0.0, 0.0])
        return self.motion.machine.mount.rotate(way)

    def place(self) -> FloatArray:
        """Return the block's present centre (3,) m, world, from the last picture and belt speed."""
        steps = len(self._trail) - 1
        if self._seen("velocity")[0] > self.motion.seen["belt_speed"][0] / 2:
            steps = self._task.camera_delay
        way: FloatArray = self.motion.machine.mount.rotate(self.step())
        return self._seen("position") + steps * way

    def above(self, height: float) -> FloatArray:
        """Return the command (3,) m that brings the lip to a ``height`` (m) above the block.

        The lip is there when the control step ends. P lags the command by half a control period.
        """
        point = self.place() + hanging(self.block) + (0.0, 0.0, height)
        command: FloatArray = self.motion.machine.mount.to_paper(point) + 1.5 * self.step()
        return command

    def grip(self) -> FloatArray:
        """Return the vector (3,) m from the held block to P."""
        grip: FloatArray = self._trail[0] - self._seen("position")
        return grip

    def _seen(self, entry: str) -> FloatArray:
        return self.motion.seen[f"{self.block.name}_{entry}"]


def _belt_speed(state: State) -> FloatArray:
    return state.belt_speed[:, None]
