"""What a task is: the scene, what is sampled, observed, rewarded, called a success; its expert.

A task sees only :class:`~tpm_gym.simulation.state.State`; every function of a state accepts any
leading batch shape. Goals, positions and velocities are in the world frame, in metres and seconds.

A new one is one file: derive from :class:`Task`, write :meth:`~Task.sample`, :meth:`~Task.achieved`
and, for an expert, :meth:`~Task.plan`; then :func:`tpm_gym.register_task`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, finite
from tpm_gym.errors import ConfigurationError, ResetOptionError, UnreachableError
from tpm_gym.kinematics.namespaces import Numbers
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene, State
from tpm_gym.tasks import rewards, sampling
from tpm_gym.tasks.motion import Motion, Move, hanging

__all__ = ["Entry", "Task"]

Values = tuple[float, ...]

_ZERO = (0.0, 0.0, 0.0)
_LIP = np.array(CUP.lip)


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
    centre: Values
    scale: Values
    source: Callable[[State], ArrayLike]


class Task(ABC):
    """Base of all tasks: the robot's own observation, the reward, success by distance.

    Args:
        machine: What the task is done with.
        reward: ``"sparse"`` (0 where the goal is achieved, else -1) or ``"dense"`` (minus the
            distance in units of 0.1 m).
        goals: How goals and starts are sampled: one of :attr:`samplings`.
        penalty_weight: Weight of the singularity penalty; 0 switches it off.

    Attributes:
        scene: What the simulation must hold.
        vacuum: Whether actions have a fourth entry, which switches the vacuum.
        goal_size: Length of a goal; three for each point that has to be somewhere: those of the
            scene's objects in its order, or P.
        tolerance: Distance below which a goal is achieved, m.
        samplings: What ``goals`` may be.
        entries: What the observation vector consists of, in order.

    Raises:
        ConfigurationError: If an option is none of those.
    """

    scene: ClassVar[Scene] = Scene()
    vacuum: ClassVar[bool] = False
    goal_size: ClassVar[int] = 3
    tolerance: ClassVar[float] = 0.010
    samplings: ClassVar[tuple[str, ...]] = ("sampled",)

    def __init__(
        self,
        machine: Machine,
        reward: str = "sparse",
        goals: str = "sampled",
        penalty_weight: float = 1.0,
    ) -> None:
        """Check the options."""
        if reward not in ("sparse", "dense"):
            raise ConfigurationError("reward", reward, "'sparse' or 'dense'")
        if goals not in self.samplings:
            raise ConfigurationError("goals", goals, " or ".join(map(repr, self.samplings)))
        self.penalty_weight = float(
            finite("penalty_weight", penalty_weight, (), ConfigurationError)
        )
        if isinstance(penalty_weight, bool) or self.penalty_weight < 0:
            raise ConfigurationError("penalty_weight", penalty_weight, "a number, 0 or more")
        if self.goal_size < 3 or self.goal_size % 3:
            raise ConfigurationError("goal_size", self.goal_size, "three for each point")
        shown = len(self.markers(np.zeros(self.goal_size)))
        if shown != self.scene.markers:
            valid = f"{shown}, as a goal shows: scene = Scene(..., markers={shown})"
            raise ConfigurationError("markers", self.scene.markers, valid)
        self.machine, self.reward, self.goals = machine, reward, goals
        self._within = self._not_lost()
        self._bounds = [corners.tolist() for corners in self._within]
        self._robot = [("the robot at home", *box) for box in machine.occupied(machine.home)]
        self._set_entries()

    def _set_entries(self) -> None:
        self.entries = self.observed()
        self._centre = np.concatenate([entry.centre for entry in self.entries])
        self._scale = np.concatenate([entry.scale for entry in self.entries])

    def __getstate__(self) -> dict[str, Any]:
        """Entries hold functions, which cannot be pickled; they follow from the rest."""
        return {name: value for name, value in vars(self).items() if name != "entries"}

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Take all but the entries from another task, and make those anew."""
        vars(self).update(values)
        self._set_entries()

    # -- to be written for each task ------------------------------------------------------------

    @abstractmethod
    def sample(
        self, rng: np.random.Generator, chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """Where an episode starts and what it aims at.

        Args:
            rng: Source of randomness.
            chosen: What the user has chosen of it, within reach; to be taken as it is. What is
                sampled beside it keeps clear of it.

        Returns:
            Centre (3,) m of each of the scene's objects by name, and ``"goal"`` (goal_size,) m.
        """

    def sample_each(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """The same for r episodes, of a generator each: arrays (r, ...).

        One by one; who writes it for many at a time draws what :meth:`sample` would.
        """
        drawn, sizes = [self.sample(rng, chosen) for rng in rngs], self._sizes
        for start in drawn:
            if start.keys() != sizes.keys():
                raise ConfigurationError("sample()", list(start), f"the keys {', '.join(sizes)}")
            for name, size in sizes.items():
                finite(f"sample()[{name!r}]", start[name], (size,), ConfigurationError)
        return {name: np.array([start[name] for start in drawn]) for name in sizes}

    def __init_subclass__(cls, **options: Any) -> None:
        """Ask one by one whoever writes :meth:`sample` only."""
        super().__init_subclass__(**options)
        if "sample" in vars(cls) and "sample_each" not in vars(cls):
            cls.sample_each = Task.sample_each  # type: ignore[method-assign]

    @abstractmethod
    def achieved(self, state: State) -> FloatArray:
        """What is compared with the goal, (..., goal_size) m."""

    def plan(self, motion: Motion) -> Iterator[Move]:
        """The moves of the scripted controller, from what it sees; the last one is kept.

        Raises:
            ConfigurationError: If the task has none.
        """
        raise ConfigurationError("expert", type(self).__name__, "a task that has a plan")

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Weighted terms of the reward that do not depend on the goal: name -> (...,)."""
        del state
        return {}

    def observed(self) -> tuple[Entry, ...]:
        """What the observation vector consists of; the robot's own entries come first."""
        return self.robot_entries()

    # -- reward: here and nowhere else ------------------------------------------------------------

    def reward_terms(self, state: State, gap: Numbers, penalty: Numbers) -> dict[str, Numbers]:
        """The terms of the reward, weighted: name -> (...,); their sum is the reward.

        Args:
            state: The state that was reached.
            gap: What :meth:`gap` says of the goal, (...,) m.
            penalty: What :meth:`penalty` says of the state, (...,).

        Raises:
            ConfigurationError: If :meth:`shaping` gives a term the name of another.
        """
        terms = {"goal": self.goal_term(gap), "singularity": -self.penalty_weight * penalty}
        own = self.shaping(state)
        if not terms.keys().isdisjoint(own):
            name = next(name for name in own if name in terms)
            raise ConfigurationError("shaping", name, f"names other than {', '.join(terms)}")
        return {**terms, **own}

    def goal_term(self, gap: Numbers) -> Numbers:
        """The one term that depends on the goal, (...,), for a gap (...,) m."""
        return (
            rewards.sparse(gap, self.tolerance) if self.reward == "sparse" else rewards.dense(gap)
        )

    def check(self, state: State) -> None:
        """Refuse a task of which a method does not give what it has to, for one state.

        Raises:
            ConfigurationError: If it does not; named by the method.
        """
        achieved = np.shape(self.achieved(state))
        if achieved != (self.goal_size,):
            valid = f"of shape ({self.goal_size},), as goal_size says"
            raise ConfigurationError("achieved()", f"of shape {achieved}", valid)
        shaping: object = self.shaping(state)
        if not isinstance(shaping, Mapping):
            raise ConfigurationError("shaping()", shaping, "a dictionary of terms; {} for none")

    def penalty(self, state: State) -> Numbers:
        """Nearness to a singularity before weighting, (...,) in [0, 1]; 1 where one was passed."""
        conditioning = state.conditioning * (1 - state.passed_singularity)
        return rewards.singularity_penalty(conditioning, self.machine.safe_conditioning)

    def success(self, gap: Numbers) -> BoolArray | bool:
        """Whether the goal is achieved, (...,), for a gap (...,) m."""
        near: BoolArray | bool = gap < self.tolerance
        return near

    def gap(self, achieved: ArrayLike, desired: ArrayLike) -> Numbers:
        """How far from the goal, (...,) m: what reward and success are made of."""
        return rewards.distance(achieved, desired)

    # -- start of an episode ----------------------------------------------------------------------

    def start(self, rng: np.random.Generator, options: Any) -> dict[str, FloatArray]:
        """What :meth:`sample` gives, with what ``reset(options=...)`` asks for.

        Raises:
            ResetOptionError: If an option is unknown, or not so many finite numbers, or an object
                would start inside another or inside the robot.
            UnreachableError: If the robot cannot get to an object or the goal.
            ConfigurationError: If what the task samples lacks something, has something else, or
                puts an object into another or into the robot.
        """
        return sampling.first_of(self.starts([rng], options))

    def starts(self, rngs: Sequence[np.random.Generator], options: Any) -> dict[str, FloatArray]:
        """The same for r episodes, of a generator each: arrays (r, ...)."""
        chosen = {} if options is None else self._chosen(options)
        starts = self.sample_each(rngs, chosen)
        self._check_free(starts, chosen)
        return starts

    @property
    def _sizes(self) -> dict[str, int]:
        """Of what is sampled, by name."""
        return {block.name: 3 for block in self.scene.objects} | {"goal": self.goal_size}

    def _chosen(self, options: Any) -> dict[str, FloatArray]:
        """What the user has chosen, by name."""
        objects = self.scene.objects
        known: dict[str, tuple[int, tuple[Block | None, ...]]] = {
            **{block.name: (3, (block,)) for block in objects},
            "goal": (self.goal_size, objects or (None,)),
        }
        valid = f"a dictionary with keys among {', '.join(map(repr, known))}"
        if not isinstance(options, Mapping):
            raise ResetOptionError("options", options, valid)
        chosen: dict[str, FloatArray] = {}
        for name, value in options.items():
            if name not in known:
                raise ResetOptionError(str(name), value, valid)
            chosen[name] = self._within_reach(name, value, *known[name])
        return chosen

    def _within_reach(
        self, name: str, value: Any, size: int, blocks: tuple[Block | None, ...]
    ) -> FloatArray:
        """Points (size,) m that the user chose, of P or of blocks' centres in turn; a copy."""
        points = np.array(finite(name, value, (size,), ResetOptionError))
        for point, block in zip(points.reshape(-1, 3), cycle(blocks), strict=False):
            low, high = self.reach_of(block)
            margin = float(np.minimum(point - low, high - point).min())
            if margin < -1e-6:
                hint = f"{name} must lie in {_range(low, high)}"
                raise UnreachableError(point.tolist(), "box", margin, hint)
        return points

    def reach_of(self, block: Block | None) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest place (3,) m for point P, or for the centre of a block in the cup."""
        region, mount = self.machine.region, self.machine.mount
        corners = np.stack([mount.to_world(corner) for corner in (region.low, region.high)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        if block is not None:
            offset = hanging(block)
            low, high = low - offset, high - offset
            low[2] = max(low[2], block.height / 2)  # on the table
        return low, high

    def _place_of(self, block: Block) -> tuple[FloatArray, FloatArray]:
        """The same, for a block that has to be in reach where it stands on the table."""
        low, high = self.reach_of(block)
        if low[2] > block.height / 2 + 1e-9:
            least = f"at least {low[2] + block.height / 2:.4g} m high"
            valid = f"blocks {least}: the cup of {self.machine.name!r} comes no lower"
            raise ConfigurationError("scene", block.name, valid)
        return low, high

    def on_table(self, block: Block) -> Region:
        """Goals for point P, machine's frame, with a block in the cup that stands on the table."""
        low, high = self.machine.goal_region.low, self.machine.goal_region.high
        touching = hanging(block) + (0.0, 0.0, block.height / 2)
        level = float(self.machine.mount.to_paper(touching)[2])
        return Region((*low[:2], level), (*high[:2], level))

    def _check_free(self, starts: Mapping[str, FloatArray], chosen: Collection[str]) -> None:
        """Refuse objects that would start inside the robot at home, or inside another object."""
        taken = [(block.name, *_boxes(starts[block.name], block)) for block in self.scene.objects]
        for name, low, high in taken:
            for other, least, most in self._robot + taken:
                mine = name in chosen or other not in chosen  # else it is found the other way round
                if other == name or not mine:
                    continue
                inside = np.flatnonzero(((low < most) & (high > least)).all(axis=1))
                if len(inside):
                    row = inside[0]
                    corners = (np.broadcast_to(c, low.shape)[row] for c in (least, most))
                    valid = f"clear of {other}, {_range(*corners)}"
                    place = starts[name][row].tolist()
                    if name in chosen:
                        raise ResetOptionError(name, place, valid)
                    raise ConfigurationError(f"sample()[{name!r}]", place, valid)

    # -- observation ------------------------------------------------------------------------------

    def robot_entries(self) -> tuple[Entry, ...]:
        """What encoders and forward kinematics tell."""
        centre, extent, speed, step = self._scales()
        return (
            Entry("position", "m", "P by forward kinematics of the encoders", centre, extent,
                  lambda s: s.fk_position),
            Entry("velocity", "m/s", "J(theta) theta_dot, from the encoders", _ZERO, speed,
                  lambda s: s.fk_velocity),
            Entry("command", "m", "commanded P minus position", _ZERO, step,
                  lambda s: s.command - s.fk_position),
        )  # fmt: skip

    def object_entries(self, index: int = 0) -> tuple[Entry, ...]:
        """What a camera and the vacuum gauge tell of one of the scene's objects."""
        centre, extent, speed, _ = self._scales()
        name = self.scene.objects[index].name
        near = tuple(min(0.1, max(0.02, half)) for half in extent)
        return (
            Entry(f"{name}_position", "m", f"centre of the {name}, from a camera", centre, extent,
                  lambda s: s.object_position[..., index, :]),
            Entry(f"{name}_offset", "m", f"top of the {name} minus lip of the cup", _ZERO, near,
                  lambda s: self.top(s, index) - self.lip(s)),
            Entry(f"{name}_velocity", "m/s", f"velocity of the {name}, from a camera", _ZERO, speed,
                  lambda s: s.object_velocity[..., index, :]),
            Entry(f"{name}_tilt", "-", f"x and y of the {name}'s axis", (0.0, 0.0), (1.0, 1.0),
                  lambda s: s.object_axis[..., index, :2]),
            Entry(f"{name}_held", "-", f"share of the vacuum that holds the {name}, by a gauge",
                  (0.5,), (0.5,),
                  lambda s: np.asarray((s.held == index) * (s.vacuum / CUP.vacuum))[..., None]),
        )  # fmt: skip

    def _scales(self) -> tuple[Values, Values, Values, Values]:
        """Centre and extent of the region (m, world), full speed (m/s), largest step (m)."""
        region, mount, step = self.machine.region, self.machine.mount, self.machine.step_limit
        low, high = np.array(region.low), np.array(region.high)
        columns = (
            mount.to_world((low + high) / 2),
            (high - low) / 2,
            np.divide(step, CONTROL_PERIOD),
        )
        centre, extent, speed = (tuple(column.tolist()) for column in columns)
        return centre, extent, speed, step

    def lip(self, state: State) -> FloatArray:
        """Centre of the cup's lip, pushed out, by forward kinematics, (..., 3) m."""
        lip: FloatArray = state.fk_position - _LIP
        return lip

    def top(self, state: State, index: int = 0) -> FloatArray:
        """Centre of an object's top face, (..., 3) m."""
        half = self.scene.objects[index].height / 2
        return state.object_position[..., index, :] + state.object_axis[..., index, :] * half

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
        return len(self._scale)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return 4 if self.vacuum else 3

    def markers(self, goal: FloatArray) -> FloatArray:
        """The points (k, 3) m that show a goal (goal_size,)."""
        return goal.reshape(-1, 3)

    def _not_lost(self) -> tuple[FloatArray, FloatArray]:
        """Between what corners (n, 3) m the objects are not lost."""
        low, high = np.empty((2, len(self.scene.objects), 3))
        for index, block in enumerate(self.scene.objects):
            least, most = self._place_of(block)
            slack = block.width / 2  # the cup may take it off its middle
            low[index, :2], high[index, :2] = least[:2] - slack, most[:2] + slack
        low[:, 2], high[:, 2] = 0.0, np.inf
        return low, high

    def lost(self, state: State) -> BoolArray | bool:
        """Whether an object is off the table or where the robot cannot get to, (...,)."""
        if not self.scene.objects:
            return np.zeros(state.object_position.shape[:-2], dtype=np.bool_)
        # So written, what is nowhere (NaN) is lost.
        if state.object_position.ndim == 2:  # of one robot: numpy's calls cost more than that
            bounds = zip(state.object_position.tolist(), *self._bounds, strict=True)
            return any(
                not (a <= x <= d and b <= y <= e and c <= z <= f)
                for (x, y, z), (a, b, c), (d, e, f) in bounds
            )
        low, high = self._within
        within = (state.object_position >= low) & (state.object_position <= high)
        lost: BoolArray = ~np.logical_and.reduce(within, axis=(-2, -1))
        return lost


def _range(low: ArrayLike, high: ArrayLike) -> str:
    least, most = (np.asarray(corner).round(4).tolist() for corner in (low, high))
    return f"{least} to {most} m"


def _boxes(points: FloatArray, block: Block) -> tuple[FloatArray, FloatArray]:
    """Corners of upright blocks (r, 3) m; a micrometre in, so that touching is not overlapping."""
    half = np.array(block.half) - 1e-6
    return points - half, points + half
