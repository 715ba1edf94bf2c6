"""Tasks: what is sampled, observed, rewarded and called a success.

A task sees only :class:`~tpm_gym.simulation.state.State`; every function of a state accepts any leading batch
shape. Goals, positions and velocities are in the world frame, in metres and seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tpm_gym.errors import ConfigurationError, ResetOptionError, UnreachableError
from tpm_gym.kinematics import workspace
from tpm_gym.kinematics.workspace import TASK_REGION, Region
from tpm_gym.mechanism.tree import CUP_LENGTH, DEFAULT_MOUNT
from tpm_gym.simulation.physics import CONTROL_PERIOD
from tpm_gym.simulation.state import Puck, Scene, State
from tpm_gym.tasks import rewards
from tpm_gym.tasks.control import STEP_LIMIT

__all__ = ["HOME", "TOLERANCE", "Entry", "PickAndPlace", "Reach", "Task", "make"]

FloatArray = NDArray[np.float64]
Vector = tuple[float, ...]

TOLERANCE = 0.010
"""Success is a distance below this, m."""
HOME = (-0.04, 0.028, 0.80)
"""Where point P is at the start of an episode, paper frame, m."""
GOAL_REGION = Region(low=(-0.20, 0.016, 0.70), high=(0.10, 0.042, 0.90))
"""Where point P has to go to reach a goal, paper frame; cut by the conditioning when sampled."""
MIN_SEPARATION = 0.030
"""A goal is at least this far from where its episode starts, m: no success for free."""

_MOUNT = DEFAULT_MOUNT
_CENTRE = tuple(_MOUNT.to_world((np.array(TASK_REGION.low) + TASK_REGION.high) / 2).tolist())
_EXTENT = tuple(((np.array(TASK_REGION.high) - TASK_REGION.low) / 2).tolist())
_SPEED = tuple((STEP_LIMIT / CONTROL_PERIOD).tolist())
_STEP = tuple(STEP_LIMIT.tolist())
_ZERO = (0.0, 0.0, 0.0)
_CUP = np.array([0.0, 0.0, CUP_LENGTH])


@dataclass(frozen=True)
class Entry:
    """One quantity in the observation vector, stored as (value - centre) / scale.

    Attributes:
        name: Its name.
        unit: Unit of the value before scaling.
        meaning: What it is and where it comes from.
        centre: Subtracted.
        scale: Divided by.
        source: How it is read from a state.
    """

    name: str
    unit: str
    meaning: str
    centre: Vector
    scale: Vector
    source: Callable[[State], ArrayLike]


_ROBOT_ENTRIES = (
    Entry("position", "m", "P by forward kinematics of the encoders", _CENTRE, _EXTENT,
          lambda s: s.fk_position),
    Entry("velocity", "m/s", "J(theta) theta_dot, from the encoders", _ZERO, _SPEED,
          lambda s: s.fk_velocity),
    Entry("command", "m", "commanded P minus position", _ZERO, _STEP,
          lambda s: s.command - s.fk_position),
)  # fmt: skip


class Task:
    """Base of all tasks: the robot's own observation, rewards and success by distance.

    Args:
        reward: ``"sparse"`` (-1 until success, then 0) or ``"dense"`` (minus the distance).

    Attributes:
        scene: What the simulation must hold.
        entries: What the observation vector consists of, in order.
        tolerance: Distance below which a goal is achieved, m.
    """

    scene: Scene = Scene()
    entries: tuple[Entry, ...] = _ROBOT_ENTRIES
    tolerance: float = TOLERANCE
    action_size: int = 3
    home: tuple[float, float, float] = HOME

    def __init__(self, reward: str = "sparse") -> None:
        """Choose the reward."""
        if reward not in ("sparse", "dense"):
            raise ConfigurationError("reward", reward, "'sparse' or 'dense'")
        self.reward = reward
        self._centre = np.concatenate([entry.centre for entry in self.entries])
        self._scale = np.concatenate([entry.scale for entry in self.entries])

    # -- sampling ---------------------------------------------------------------------------

    def sample_object(self, rng: np.random.Generator) -> FloatArray | None:
        """Where the object starts, (3,) m; None without an object."""
        del rng
        return None

    def sample_goal(self, rng: np.random.Generator, start: ArrayLike | None) -> FloatArray:
        """A goal (3,) m for an episode whose object starts at ``start``."""
        raise NotImplementedError

    def check_goal(self, goal: ArrayLike) -> FloatArray:
        """A goal that the user chose, as (3,) m.

        Raises:
            ResetOptionError: If it is not three finite numbers.
            UnreachableError: If the robot cannot get there.
        """
        return _check_reach("goal", goal, self._tool_offset())

    def check_object(self, position: ArrayLike) -> FloatArray:
        """A start of the object that the user chose, as (3,) m.

        Raises:
            ResetOptionError: If the task has no object, or it is not three finite numbers.
            UnreachableError: If the robot cannot get there.
        """
        raise ResetOptionError("object", position, f"nothing: {type(self).__name__} has no object")

    def _tool_offset(self) -> FloatArray:
        """From what has to be at the goal to point P, world, m."""
        return np.zeros(3)

    # -- observation ------------------------------------------------------------------------

    def observe(self, state: State) -> FloatArray:
        """The observation vector (..., n), each entry of order one."""
        values = np.concatenate([entry.source(state) for entry in self.entries], axis=-1)
        scaled: FloatArray = (values - self._centre) / self._scale
        return scaled

    def decode(self, observation: ArrayLike) -> dict[str, FloatArray]:
        """The inverse of :meth:`observe`: name -> (..., k) in SI units."""
        vector = np.asarray(observation, dtype=np.float64)
        result, start = {}, 0
        for entry in self.entries:
            stop = start + len(entry.scale)
            result[entry.name] = vector[..., start:stop] * entry.scale + entry.centre
            start = stop
        return result

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return sum(len(entry.scale) for entry in self.entries)

    def achieved(self, state: State) -> FloatArray:
        """What is compared with the goal, (..., 3) m."""
        raise NotImplementedError

    # -- reward -----------------------------------------------------------------------------

    def goal_term(self, achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
        """The part of the reward that depends on the goal, (...,)."""
        return self.goal_term_at(rewards.distance(achieved, desired))

    def goal_term_at(self, gap: FloatArray) -> FloatArray:
        """The same, for distances (...,) m from the goal."""
        return (
            rewards.sparse(gap, self.tolerance) if self.reward == "sparse" else rewards.dense(gap)
        )

    def state_terms(self, state: State) -> dict[str, FloatArray]:
        """Parts of the reward that do not depend on the goal: name -> (...,)."""
        del state
        return {}

    def success(self, achieved: ArrayLike, desired: ArrayLike) -> NDArray[np.bool_]:
        """Whether the goal is achieved, (...,)."""
        return self.success_at(rewards.distance(achieved, desired))

    def success_at(self, gap: FloatArray) -> NDArray[np.bool_]:
        """The same, for distances (...,) m from the goal."""
        result: NDArray[np.bool_] = gap < self.tolerance
        return result


class Reach(Task):
    """Bring point P of the platform to a point in the workspace."""

    def sample_goal(self, rng: np.random.Generator, start: ArrayLike | None) -> FloatArray:
        """Uniform over the well-conditioned part of the goal region, away from home."""
        del start
        return _sample_apart(rng, GOAL_REGION, _ZERO, _MOUNT.to_world(self.home))

    def achieved(self, state: State) -> FloatArray:
        """Point P by forward kinematics of the encoders."""
        return state.fk_position


class PickAndPlace(Task):
    """Pick up a puck with the vacuum cup and bring its centre to the goal.

    Half of the goals lie on the table, half in the air.
    """

    puck = Puck()
    scene = Scene(puck=puck)
    action_size = 4
    entries = (
        *_ROBOT_ENTRIES,
        Entry("object_position", "m", "centre of the puck, from a camera", _CENTRE, _EXTENT,
              lambda s: s.object_position),
        Entry("object_offset", "m", "top of the puck minus lip of the cup",
              _ZERO, (0.1, 0.02, 0.1), lambda s: _top(s) - _lip(s)),
        Entry("object_velocity", "m/s", "velocity of the puck, from a camera", _ZERO, _SPEED,
              lambda s: s.object_velocity),
        Entry("object_tilt", "-", "x and y of the puck's axis", (0.0, 0.0), (1.0, 1.0),
              lambda s: s.object_axis[..., :2]),
        Entry("holding", "-", "+1 if the cup holds the puck (vacuum gauge), else -1",
              (0.5,), (0.5,), lambda s: np.asarray(s.holding, dtype=np.float64)[..., None]),
    )  # fmt: skip

    def sample_object(self, rng: np.random.Generator) -> FloatArray:
        """Uniform over the well-conditioned part of the table, standing."""
        low, high = GOAL_REGION.low, GOAL_REGION.high
        level = float(_MOUNT.to_paper(self._on_table())[2])
        flat = Region((low[0], low[1], level), (high[0], high[1], level))
        return self._sample(rng, flat)

    def sample_goal(self, rng: np.random.Generator, start: ArrayLike | None) -> FloatArray:
        """Half on the table, half in the air, away from where the puck starts."""
        low, high = GOAL_REGION.low, GOAL_REGION.high
        level = float(_MOUNT.to_paper(self._on_table())[2])
        if rng.random() < 0.5:
            region = Region((low[0], low[1], level), (high[0], high[1], level))
        else:
            region = Region(low, (high[0], high[1], level - MIN_SEPARATION))
        far = (np.inf, np.inf, np.inf) if start is None else start
        return _sample_apart(rng, region, self._tool_offset(), far)

    def check_object(self, position: ArrayLike) -> FloatArray:
        """A start of the puck that the user chose; see the base class."""
        return self._check_height("object", _check_reach("object", position, self._tool_offset()))

    def check_goal(self, goal: ArrayLike) -> FloatArray:
        """A goal for the puck that the user chose; see the base class."""
        return self._check_height("goal", super().check_goal(goal))

    def _check_height(self, name: str, point: FloatArray) -> FloatArray:
        if point[2] < self.puck.height / 2 - 1e-6:
            valid = f"z >= {self.puck.height / 2} m, half the puck's height above the table"
            raise ResetOptionError(name, point.tolist(), valid)
        return point

    def achieved(self, state: State) -> FloatArray:
        """Centre of the puck."""
        return state.object_position

    def state_terms(self, state: State) -> dict[str, FloatArray]:
        """Dense only: minus the distance from the cup to the puck, half as dear as the goal."""
        if self.reward == "sparse":
            return {}
        return {"approach": 0.5 * rewards.dense(rewards.distance(_lip(state), _top(state)))}

    def _tool_offset(self) -> FloatArray:
        return np.array([0.0, 0.0, self.puck.height / 2 + CUP_LENGTH])

    def _on_table(self) -> FloatArray:
        """Point P when the cup touches a puck that stands on the table, world (x, y any)."""
        return np.add(self._tool_offset(), (0.0, 0.0, self.puck.height / 2))

    def _sample(self, rng: np.random.Generator, region: Region) -> FloatArray:
        point = workspace.sample(rng, region, rewards.SAFE_CONDITIONING)
        return np.asarray(_MOUNT.to_world(point) - self._tool_offset())


def make(name: str, reward: str) -> Task:
    """The task of that name.

    Raises:
        ConfigurationError: If there is none, or the reward is unknown.
    """
    tasks = {"reach": Reach, "pick_and_place": PickAndPlace}
    if name not in tasks:
        raise ConfigurationError("task", name, ", ".join(map(repr, tasks)))
    return tasks[name](reward)


def _sample_apart(
    rng: np.random.Generator, region: Region, tool_offset: ArrayLike, start: ArrayLike
) -> FloatArray:
    """A safe goal (world) whose distance from ``start`` is at least MIN_SEPARATION."""
    while True:
        point = workspace.sample(rng, region, rewards.SAFE_CONDITIONING)
        goal: FloatArray = _MOUNT.to_world(point) - np.asarray(tool_offset)
        if not rewards.distance(goal, start) < MIN_SEPARATION:
            return goal


def _check_reach(name: str, value: ArrayLike, tool_offset: FloatArray) -> FloatArray:
    """Three finite numbers (world) at which point P would be inside the task region."""
    try:
        point = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ResetOptionError(name, value, "three finite numbers in m, world frame") from error
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ResetOptionError(name, value, "three finite numbers in m, world frame")
    place = _MOUNT.to_paper(point + tool_offset)
    margin = TASK_REGION.margin(place)
    if margin < -1e-9:
        corners = [
            _MOUNT.to_world(corner) - tool_offset for corner in (TASK_REGION.low, TASK_REGION.high)
        ]
        low, high = np.min(corners, axis=0).round(4), np.max(corners, axis=0).round(4)
        raise UnreachableError(
            tuple(point),
            "box",
            margin,
            f"{name} must lie between {low.tolist()} and {high.tolist()} m",
        )
    return point


def _lip(state: State) -> FloatArray:
    """Centre of the cup's lip, pushed out, by forward kinematics, world."""
    lip: FloatArray = state.fk_position - _CUP
    return lip


def _top(state: State) -> FloatArray:
    """Centre of the puck's top face, world."""
    return state.object_position + state.object_axis * (PickAndPlace.puck.height / 2)
