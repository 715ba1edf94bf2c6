"""Cycle: the pick-and-place cycle by which industry compares fast robots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.motor import TORQUE_MOTOR
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene, State
from tpm_gym.tasks import sampling
from tpm_gym.tasks.control import USABLE
from tpm_gym.tasks.motion import Motion, Move
from tpm_gym.tasks.task import Task, dense
from tpm_gym.tasks.timing import timed

STROKE: Final = 0.305
RISE: Final = 0.025
"""Height of P's path, m. P moves up by RISE, along x by STROKE, and down by RISE."""
BLEND: Final = 0.050
"""Length of a corner along x, m. A corner is a cubic Lame curve, |x / BLEND|^3 + |z / RISE|^3 = 1.

The curvature is zero at both ends of a corner, so that the acceleration does not jump.
"""
SPEED: Final = 5.0
"""Largest speed of the command along x and z, m/s. At this speed, motors turn at up to 20 rad/s."""
PAYLOAD: Final = 0.1
"""Payload if the machine has none, kg."""
CONTINUOUS: Final = 0.98 * TORQUE_MOTOR.continuous_torque / TORQUE_MOTOR.peak_torque
"""Largest RMS torque of a plan, as a share of the peak torque; 0.98 leaves a reserve for servos."""
SHARES: Final = (0.65, 0.1, 0.65)
"""Acceleration limits along x, y, z, as shares of P's largest acceleration along one axis only."""
BRAKING: Final = (0.8, 0.8, 0.25)
"""Deceleration limits along x, y, z before the region's ends: shares of the acceleration limits.

The motors must be able to brake along x and z at the same time. So the share along z is small:
there, the path ends far from the end of the region, and P has a long way to brake.
"""
NEAR: Final = 0.010
"""Distance to the goal, m; at this and larger distances, a dense reward's extra term is -1."""
UNIT: Final = 0.005
"""Unit of the reward term "gate", m: the term is -1 if P is tolerance + UNIT below the path."""
POINTS: Final = 120
SHOWN: Final = 12
"""Number of points of the path between two markers."""
_DRAWS: Final = 1000


class Cycle(Task):
    """Carry a payload 25 mm up, 305 mm across and 25 mm down, as fast as the motors can.

    This path is one half of the cycle by which industry compares pick-and-place robots; the other
    half leads back. P starts at rest at one end and has to stop at the other end, within 2 mm. The
    direction and the y of the path are drawn for each episode. The path has the shape of a gate,
    with corners that are rounded over 50 mm. The reward has a term for every step in which P is
    more than 2 mm below this path.

    Actions come every 4 ms. The command moves at up to 5 m/s. A change of the command's velocity is
    reduced if, according to closed-form dynamics, the change needs more than 95% of the peak
    torque. A gripper holds the payload, 0.1 kg or the machine's ``payload``. The vacuum cup could
    not hold the payload: the cup holds 12 N, and 0.1 kg needs up to 15 N here.
    """

    scene = Scene(markers=POINTS // SHOWN + 1, marker_radius=0.004)
    tolerance = 0.002
    samplings = ("sampled", "tempting")
    control_period = 0.004
    max_episode_steps = 75

    def __init__(self, machine: Machine, *args: Any, **options: Any) -> None:
        """Check that the path fits into the machine's region; see the base class."""
        low, high = machine.region.low, machine.region.high
        self._ends = (low[0] + high[0]) / 2 + STROKE / 2 * np.array([-1.0, 1.0])
        self._level = machine.home[2]
        if high[0] - low[0] < STROKE or self._level - low[2] < RISE:
            valid = f"one whose region has {STROKE} m along x, and {RISE} m above its home"
            raise ConfigurationError("machine", machine.name, valid)
        across = SPEED * CONTROL_PERIOD
        quick = replace(
            machine,
            payload=machine.payload or PAYLOAD,
            step_limit=(across, machine.step_limit[1], across),
            joint_limit=TORQUE_MOTOR.corner_speed * CONTROL_PERIOD,
        )
        added = _moved(quick) - _moved(replace(quick, payload=0.0))
        if abs(added - quick.payload) > 1e-9:
            valid = "one whose mechanism contains its payload (tpm_gym.mechanism.parts.load)"
            raise ConfigurationError("machine", machine.name, valid)
        super().__init__(quick, *args, **options)
        self._peak = np.array([motor.effort for motor in quick.mechanism.motors])
        limits = self._strength()
        self.accelerations = tuple(limits.tolist()), tuple((limits * np.array(BRAKING)).tolist())

    def _strength(self) -> FloatArray:
        """Return the limits of acceleration along x, y, z, m/s^2."""
        y = (self.machine.goal_region.low[1] + self.machine.goal_region.high[1]) / 2
        path = self.gate(y)
        theta = self.machine.require_inverse(path)
        jacobian = self.machine.evaluate(theta).jacobian
        still = np.zeros_like(theta)
        rest = self.machine.torque(theta, still, still)
        most = []
        for axis in np.eye(3):
            turns = np.linalg.solve(jacobian, np.tile(axis[:, None], (len(path), 1, 1)))[..., 0]
            torque = np.abs(self.machine.torque(theta, still, turns) - rest)
            most.append(1 / float((torque / self._peak).max(axis=1).min()))
        limits: FloatArray = np.array(SHARES) * most
        return limits

    # -- the path -----------------------------------------------------------------------------

    def _height(self, way: FloatArray) -> FloatArray:
        """Return the height of the path, m, at distances ``way`` (...,) m along x from one end."""
        to_end = np.minimum(way, STROKE - way)
        share = np.clip(1 - to_end / BLEND, 0.0, 1.0)  # 1 beyond the ends, where the height is 0
        height: FloatArray = RISE * np.cbrt(1 - share**3)
        return height

    def gate(self, y: float, backwards: bool = False) -> FloatArray:
        """Return points (POINTS + 1, 3) m of the path at equal distances, machine's frame."""
        # Points of the corner at equal angles of the Lame curve, then the straight part.
        angle = np.linspace(0.0, np.pi / 2, 200)
        way, height = BLEND * (1 - np.cos(angle) ** (2 / 3)), RISE * np.sin(angle) ** (2 / 3)
        way, height = np.append(way, STROKE - way[::-1]), np.append(height, height[::-1])
        length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(way), np.diff(height)))])
        even = np.linspace(0.0, length[-1], POINTS + 1)
        x = self._ends[0] + np.interp(even, length, way)
        z = self._level - np.interp(even, length, height)
        points = np.stack([x, np.full_like(x, y), z], axis=1)
        return points[::-1] if backwards else points

    def markers(self, goal: FloatArray) -> FloatArray:
        """Return points (k, 3) m of the gate-shaped path, world."""
        y = float(self.machine.mount.to_paper(goal)[1])
        points: FloatArray = self.machine.mount.to_world(self.gate(y)[::SHOWN])
        return points

    # -- Task -----------------------------------------------------------------------------------

    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """See the base class."""
        goals = [] if "goal" in chosen else [self._draw(rng) for rng in rngs]
        return {"goal": np.array(goals), **chosen}

    def _draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw a goal (3,) m: one end of the path, with a y at which the whole path is safe."""
        low, high = self.machine.goal_region.low[1], self.machine.goal_region.high[1]

        def draw(rng: np.random.Generator) -> FloatArray:
            points = np.full((_DRAWS, 3), self._level)
            points[:, 0] = self._ends[rng.integers(2)]
            points[:, 1] = rng.uniform(low, high, _DRAWS)
            return points

        def ways(points: FloatArray) -> FloatArray:
            ends = np.stack([points, points], axis=1)
            ends[:, :, 0] = self._ends
            return ends

        point = sampling.safe_draw(rng, self.machine, self.goals, draw, ways)
        goal: FloatArray = self.machine.mount.to_world(point)
        return goal

    def goals_of(self, block: Block | None) -> list[tuple[FloatArray, FloatArray]]:
        """Return two goal boxes, one at each end of the path: low and high corner (3,) m, world."""
        depths = self.machine.goal_region.low[1], self.machine.goal_region.high[1]
        boxes = []
        for end in self._ends.tolist():
            corners = [self.machine.mount.to_world((end, y, self._level)) for y in depths]
            boxes.append((np.min(corners, axis=0), np.max(corners, axis=0)))
        return boxes

    def departures(self, goals: FloatArray) -> FloatArray:
        """Return the starts of P: the other end of each goal's path, (r, 3) m, machine's frame."""
        points: FloatArray = self.machine.mount.to_paper(goals).copy()
        points[:, 0] = self._ends.sum() - points[:, 0]
        return points

    def goal_term(self, gap: FloatArray) -> FloatArray:
        """Return -gap / 0.1 m - min(gap / 10 mm, 1); for a sparse reward, the base class's term."""
        term = super().goal_term(gap)
        return term if self.reward == "sparse" else term + dense(np.minimum(gap, NEAR), NEAR)

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return -(d - tolerance) / 5 mm, at most 0; d is the depth of P below the path."""
        points = self.machine.mount.to_paper(state.fk_position)
        height = self._height(points[:, 0] - self._ends[0])
        below = height - (self._level - points[:, 2]) - self.tolerance
        return {"gate": np.minimum(-below / UNIT, 0.0)}

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Follow the gate as fast as possible; repeating this must not overheat the motors."""
        start, goal = motion.command, self.machine.mount.to_paper(motion.goal)
        path = self.gate(start[1], backwards=bool(start[0] > goal[0]))
        times, _ = timed(self.machine, path, CONTINUOUS * self._peak, USABLE * self._peak)
        moments = np.arange(1, np.ceil(times[-1] / self.control_period)) * self.control_period
        for point in np.stack([np.interp(moments, times, axis) for axis in path.T], axis=1):
            yield Move(point, False)
        yield Move(goal, False)


def _moved(machine: Machine) -> float:
    """Return the mass of the moving links, kg."""
    return sum(link.mass for link in machine.mechanism.links[1:])
