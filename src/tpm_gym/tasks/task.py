"""Base class of tasks: scene, sampling, observation, reward, success and expert.

A task sees only :class:`~tpm_gym.simulation.state.State`, whose first axis is the robots; goals,
positions and velocities are in the world frame, in metres and seconds.

A new task is one file: derive from :class:`Task`, write :meth:`~Task.sample` and, for an expert,
:meth:`~Task.plan`; then call :func:`tpm_gym.register_task`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, cycle, groupby, pairwise
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from tpm_gym.arrays import BoolArray, FloatArray, Vector, finite, is_number, is_whole, numbers
from tpm_gym.errors import ConfigurationError, InputError, ResetOptionError, UnreachableError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.engine import loops
from tpm_gym.simulation.state import CONTROL_PERIOD, Block, Scene, State
from tpm_gym.tasks.motion import Motion, Move, hanging

Values = tuple[float, ...]

_ZERO = (0.0, 0.0, 0.0)
_LIP = np.array(CUP.lip)


def dense(gap: ArrayLike, unit: float = 0.1) -> FloatArray:
    """Return minus ``gap`` (m) in units of ``unit`` (m), so that a typical error costs about 1."""
    reward: FloatArray = np.asarray(gap, dtype=np.float64) / -unit
    return reward


@dataclass(frozen=True)
class Entry:
    """One quantity in the observation vector, stored as (value - centre) / scale.

    Attributes:
        name: Name of the entry.
        unit: Unit of the value before scaling.
        meaning: Description, with the sensor.
        centre: Value that is stored as 0.
        scale: Difference that is stored as 1.
        source: Function that reads values (n, ...) from a state. Adjacent entries may share it.
        columns: Columns (start, stop) of this entry in the result of ``source``; None for all.
    """

    name: str
    unit: str
    meaning: str
    centre: Values
    scale: Values
    source: Callable[[State], FloatArray]
    columns: tuple[int, int] | None = None


class Task(ABC):
    """Base class of tasks: observation of the robot, reward, and success by distance.

    Args:
        machine: Machine that performs the task.
        reward: Goal term: ``"sparse"`` (0 where the goal is achieved, else -1) or ``"dense"``
            (minus the distance in units of 0.1 m). The terms of :meth:`shaping` are added to both.
        goals: Name of the sampling of goals and starts, one of :attr:`samplings`.
        penalty_weight: Weight of the singularity penalty; 0 switches it off.

    Attributes:
        scene: Objects, goal markers, belt and paint; a task may set it for each machine.
        vacuum: Whether actions have a fourth entry, which switches the vacuum.
        goal_size: Length of a goal: three for each object in the scene's order, or three for P.
        tolerance: Distance below which a goal is achieved, m.
        samplings: Values of ``goals``.
        controls: Names of the controls that can perform the task.
        events: Names of methods of the task that return (n,) bool for a state. ``info`` has the
            results. An evaluation reports the share of episodes in which each event occurred.
        control_period: Time between two actions, s. The machine's limits are for 40 ms, and are
            scaled to this time. For a shorter time, set :attr:`accelerations`: without it, the
            commands can need more torque than the motors have, and shields cannot be used.
        accelerations: Limits along x, y, z of the machine's frame, m/s^2: largest acceleration of
            the command, and its deceleration before an end of the region; None for no limits.
        max_episode_steps: Control steps after which ``gym.make`` truncates an episode.
        camera_delay: Control steps by which observation and achieved goal show objects late.
        entries: Entries of the observation vector, in order.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    scene: Scene = Scene()
    vacuum: ClassVar[bool] = False
    goal_size: ClassVar[int] = 3
    tolerance: ClassVar[float] = 0.010
    samplings: ClassVar[tuple[str, ...]] = ("sampled",)
    controls: ClassVar[tuple[str, ...]] = ("cartesian", "joints")
    events: ClassVar[tuple[str, ...]] = ()
    control_period: ClassVar[float] = CONTROL_PERIOD
    accelerations: tuple[Vector, Vector] | None = None
    max_episode_steps: ClassVar[int] = 50
    camera_delay: ClassVar[int] = 0

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
        if not is_whole(self.goal_size, 3) or self.goal_size % 3:
            raise ConfigurationError("goal_size", self.goal_size, "three for each point")
        if not (is_number(self.control_period) and self.control_period > 0):
            raise ConfigurationError("control_period", self.control_period, "a positive number")
        if not (is_number(self.tolerance) and self.tolerance > 0):
            raise ConfigurationError("tolerance", self.tolerance, "a positive number")
        if not is_whole(self.camera_delay, 0):
            raise ConfigurationError("camera_delay", self.camera_delay, "a whole number, 0 or more")
        if not isinstance(self.scene, Scene):
            raise ConfigurationError("scene", self.scene, "a Scene; Scene() has no objects")
        self.machine, self.reward, self.goals = machine, reward, goals
        shown = len(self.markers(np.zeros(self.goal_size)))
        if shown != self.scene.markers:
            valid = f"{shown}, as a goal shows: scene = Scene(..., markers={shown})"
            raise ConfigurationError("markers", self.scene.markers, valid)
        self._within = self._not_lost()
        self._halves = np.array([block.height / 2 for block in self.scene.objects])
        self._robot = [("the robot at home", *box) for box in machine.occupied(machine.home)]
        self._set_entries()

    def _set_entries(self) -> None:
        self.entries = self.observed()
        if not self.entries:
            raise ConfigurationError("observed()", self.entries, "at least one Entry")
        for entry in self.entries:
            label, shape = f"observed(), {entry.name!r}", (len(entry.centre),)
            finite(f"{label}, centre", entry.centre, shape, ConfigurationError)
            if not finite(f"{label}, scale", entry.scale, shape, ConfigurationError).all():
                raise ConfigurationError(f"{label}, scale", entry.scale, "numbers other than 0")
        self._centre = np.concatenate([entry.centre for entry in self.entries])
        self._scale = np.concatenate([entry.scale for entry in self.entries])
        # A source that adjacent entries share is called only once.
        groups = groupby(self.entries, key=lambda entry: entry.source)
        self._sources = [(source, _columns(list(entries))) for source, entries in groups]

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without those that hold functions, which cannot be pickled."""
        own = vars(self).items()
        return {name: value for name, value in own if name not in ("entries", "_sources")}

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Restore the attributes, and rebuild the entries of the observation vector."""
        vars(self).update(values)
        self._set_entries()

    # -- to be written for each task ------------------------------------------------------------

    @abstractmethod
    def sample(
        self, rngs: Sequence[np.random.Generator], chosen: Mapping[str, FloatArray]
    ) -> dict[str, FloatArray]:
        """Draw the object positions and goals of r episodes.

        Args:
            rngs: A generator for each episode. An episode draws from its own generator only, so
                that its values do not depend on the other episodes.
            chosen: Values (r, ...) that the user has chosen, by name. They are within reach. The
                result contains them unchanged. Sampled positions must not be too near to them.

        Returns:
            Centres (r, 3) m of the scene's objects by name, and ``"goal"`` (r, goal_size) m. The
            observation space limits goals to coordinates from -2 to 2 m. With a belt, also
            ``"belt_speed"`` (r, 1) m/s.
        """

    def achieved(self, state: State) -> FloatArray:
        """Return the achieved goal, (n, goal_size) m: the objects' centres; P if there are none.

        P is computed by forward kinematics from the encoder readings.
        """
        places = state.object_position
        return places.reshape(len(places), -1) if self.scene.objects else state.fk_position

    def plan(self, motion: Motion) -> Iterator[Move]:
        """Yield the expert's moves for one robot; the last move is repeated to the episode's end.

        Raises:
            ConfigurationError: If the task has no plan.
        """
        raise ConfigurationError("expert", type(self).__name__, "a task that has a plan")

    def shaping(self, state: State) -> dict[str, FloatArray]:
        """Return weighted terms of the reward that do not depend on the goal: name -> (n,)."""
        return {}

    def observed(self) -> tuple[Entry, ...]:
        """Return the entries of the observation vector: the robot's, then those of each object."""
        objects = (self.object_entries(index) for index in range(len(self.scene.objects)))
        return (*self.robot_entries(), *chain(*objects))

    def departures(self, goals: FloatArray) -> FloatArray | None:
        """Return the starts of P (r, 3) m, machine's frame, for goals (r, goal_size) m, world.

        None stands for the machine's home.
        """
        return None

    # -- reward: here and nowhere else ------------------------------------------------------------

    def reward_terms(
        self, state: State, gap: FloatArray, penalty: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the weighted terms of the reward: name -> (n,); their sum is the reward.

        Args:
            state: The state that was reached.
            gap: (n,) m, distance to the goal by :meth:`gap`.
            penalty: (n,), singularity penalty by :meth:`penalty`.
        """
        goal, singularity = self.goal_term(gap), -self.penalty_weight * penalty
        return {"goal": goal, "singularity": singularity, **self.shaping(state)}

    def goal_term(self, gap: FloatArray) -> FloatArray:
        """Return the goal term (...,) of a gap (...,) m; in a sparse reward, a NaN gap gives -1."""
        if self.reward == "sparse":
            missed: FloatArray = np.subtract(gap < self.tolerance, 1.0)
            return missed
        return dense(gap)

    def penalty(self, state: State) -> FloatArray:
        """Return the singularity penalty before weighting, (n,) in [0, 1].

        The penalty is 1 past a singularity. Elsewhere it is 1 - (c / safe)^4 if the conditioning c
        is below the machine's ``safe_conditioning`` (safe), else 0. It is steepest at c = safe.
        Policies ignored an earlier penalty, a cubic function of c with slope 0 at c = safe. With
        SAC, joint increments as actions, and goals next to a singularity, c was below safe for 24%
        of the time without a penalty, for 19% with the cubic penalty, and for 1% with this penalty.
        """
        values: FloatArray = loops().singularity_penalty(
            state.conditioning,
            self.machine.safe_conditioning,
            state.assembly_mode_changed,
            state.working_mode_changed,
        )
        return values

    def success(self, gap: FloatArray) -> BoolArray:
        """Return whether the goal is achieved, (...,), for a gap (...,) m."""
        near: BoolArray = gap < self.tolerance
        return near

    def gap(self, achieved: ArrayLike, desired: ArrayLike) -> FloatArray:
        """Return the Euclidean distance to the goal, (...,) m: reward and success depend on it."""
        # Copies: the loop is compiled for one kind of array.
        first, second = np.array(achieved, np.float64), np.array(desired, np.float64)
        if first.shape != second.shape:
            first, second = map(np.copy, np.broadcast_arrays(first, second))
        if first.ndim == 2:
            return loops().distances(first, second)  # type: ignore[no-any-return]
        shape = first.shape
        rows = loops().distances(first.reshape(-1, shape[-1]), second.reshape(-1, shape[-1]))
        return rows.reshape(shape[:-1])  # type: ignore[no-any-return]

    # -- start of an episode ----------------------------------------------------------------------

    def start(
        self, rngs: Sequence[np.random.Generator], options: Any = None
    ) -> dict[str, FloatArray]:
        """Sample the starts of r episodes, and apply ``reset(options=...)``.

        Returns:
            As :meth:`sample`.

        Raises:
            ResetOptionError: If an option is unknown, is not a finite array of the right shape, or
                would put an object into another object or into the robot.
            UnreachableError: If the robot cannot get to an object or the goal.
            ConfigurationError: If the result of :meth:`sample` or :meth:`departures` is wrong.
        """
        chosen = {} if options is None else self._chosen(options)
        given = {name: np.tile(value, (len(rngs), 1)) for name, value in chosen.items()}
        starts = self.sample(rngs, dict(given))
        names: object = list(starts) if isinstance(starts, Mapping) else starts
        if not isinstance(starts, Mapping) or starts.keys() != self._sizes.keys():
            raise ConfigurationError("sample()", names, f"the keys {', '.join(self._sizes)}")
        for name, size in self._sizes.items():
            label, shape = f"sample()[{name!r}]", (len(rngs), size)
            starts[name] = finite(label, starts[name], shape, ConfigurationError)
            if name in given and not np.array_equal(starts[name], given[name]):
                valid = f"chosen[{name!r}], {given[name][0].tolist()}, as the user chose it"
                raise ConfigurationError(label, starts[name][0].tolist(), valid)
        self._check_free(starts, chosen)
        self._check_departures(starts["goal"])
        return starts

    def _check_departures(self, goals: FloatArray) -> None:
        """Raise ConfigurationError if P cannot start at the points of :meth:`departures`."""
        if (departures := self.departures(goals)) is not None:
            region = self.machine.region
            points = finite("departures()", departures, (len(goals), 3), ConfigurationError)
            outside = (np.minimum(points - region.low, region.high - points) < -1e-6).any(axis=1)
            if outside.any():
                valid = f"in the machine's frame, inside its region, {region}"
                raise ConfigurationError("departures()", points[outside][0].tolist(), valid)

    @property
    def _sizes(self) -> dict[str, int]:
        """Lengths of the sampled arrays, by name."""
        sizes = {block.name: 3 for block in self.scene.objects} | {"goal": self.goal_size}
        return sizes if self.scene.belt is None else sizes | {"belt_speed": 1}

    def _chosen(self, options: Any) -> dict[str, FloatArray]:
        """Check the user's options, and return their values by name."""
        objects, belt = self.scene.objects, self.scene.belt
        blocks: dict[str, tuple[Block | None, ...]] = {
            **{block.name: (block,) for block in objects},
            "goal": objects or (None,),
        }
        valid = f"a dictionary with keys among {', '.join(map(repr, self._sizes))}"
        if not isinstance(options, Mapping):
            raise ResetOptionError("options", options, valid)
        chosen: dict[str, FloatArray] = {}
        for name, value in options.items():
            if name in blocks:
                chosen[name] = self._within_reach(name, value, blocks[name])
            elif belt is not None and name == "belt_speed":
                speed = numbers(name, value, ResetOptionError).reshape(-1)
                chosen[name] = belt.require(speed, 1, ResetOptionError)
            else:
                raise ResetOptionError(str(name), value, valid)
        return chosen

    def _within_reach(self, name: str, value: Any, blocks: Sequence[Block | None]) -> FloatArray:
        """Copy points (size,) m that a user chose for P or for blocks; raise if out of reach."""
        points = np.array(finite(name, value, (self._sizes[name],), ResetOptionError))
        for point, block in zip(points.reshape(-1, 3), cycle(blocks), strict=False):
            boxes = self.goals_of(block) if name == "goal" else [self.starts_of(block)]
            margin = max(float(np.minimum(point - low, high - point).min()) for low, high in boxes)
            if margin < -1e-6:
                hint = f"{name} must lie in {' or in '.join(_range(*box) for box in boxes)}"
                raise UnreachableError(point.tolist(), "box", margin, hint)
        return points

    def starts_of(self, block: Block | None) -> tuple[FloatArray, FloatArray]:
        """Return the low and high corners (3,) m, world, of the places where a block may start.

        The default is :meth:`reach_of`. A task with other starts overrides this method.
        """
        return self.reach_of(block)

    def goals_of(self, block: Block | None) -> list[tuple[FloatArray, FloatArray]]:
        """Return the boxes in which goals lie, as low and high corners (3,) m, world, each.

        By default there is one box: the reach of point P, or of a block in the cup. A task with
        goals elsewhere overrides this method.

        Args:
            block: Block that has to reach the goals; None for goals of point P.
        """
        return [self.reach_of(block)]

    def reach_of(self, block: Block | None) -> tuple[FloatArray, FloatArray]:
        """Return the low and high corners (3,) m of the region of P, or of a block in the cup."""
        region, mount = self.machine.region, self.machine.mount
        corners = np.stack([mount.to_world(corner) for corner in (region.low, region.high)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        if block is not None:
            offset = hanging(block)
            low, high = low - offset, high - offset
            low[2] = max(low[2], block.height / 2)  # on the table
        return low, high

    def _place_of(self, block: Block) -> tuple[FloatArray, FloatArray]:
        """Return :meth:`reach_of` for a block on the table; raise if the table is out of reach."""
        low, high = self.reach_of(block)
        if low[2] > block.height / 2 + 1e-9:
            least = f"at least {low[2] + block.height / 2:.4g} m high"
            valid = f"blocks {least}: the cup of {self.machine.name!r} comes no lower"
            raise ConfigurationError("scene", block.name, valid)
        return low, high

    def on_table(self, block: Block) -> Region:
        """Return the flat region of P, machine's frame, in which a held block touches the table."""
        low, high = self.machine.goal_region.low, self.machine.goal_region.high
        touching = hanging(block) + (0.0, 0.0, block.height / 2)
        level = float(self.machine.mount.to_paper(touching)[2])
        return Region((*low[:2], level), (*high[:2], level))

    def _check_free(self, starts: Mapping[str, FloatArray], chosen: Collection[str]) -> None:
        """Raise if objects would start inside the robot at home, or inside another object."""
        taken = [(block.name, *_boxes(starts[block.name], block)) for block in self.scene.objects]
        for name, low, high in taken:
            for other, least, most in self._robot + taken:
                mine = name in chosen or other not in chosen  # else the other object reports it
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
        """Return the robot's entries of the observation, from encoders and forward kinematics."""
        centre, extent, speed, step = self._scales()
        measure = self._measure
        return (
            Entry("position", "m", "P by forward kinematics of the encoders", centre, extent,
                  measure, (0, 3)),
            Entry("velocity", "m/s", "J(theta) theta_dot, from the encoders", _ZERO, speed,
                  measure, (3, 6)),
            Entry("command", "m", "commanded P minus position", _ZERO, step, measure, (6, 9)),
        )  # fmt: skip

    def object_entries(self, index: int = 0, turn: bool = False) -> tuple[Entry, ...]:
        """Return one object's entries of the observation, from a camera and the vacuum gauge.

        Args:
            index: Number of the object in the scene.
            turn: Whether its rotation about the vertical is measured, as four times the angle. This
                value is equal for the four orientations in which a square block looks the same.
        """
        centre, extent, speed, _ = self._scales()
        name, near = self.scene.objects[index].name, tuple(min(0.1, max(0.02, e)) for e in extent)
        flat, unit = (0.0, 0.0), (1.0, 1.0)
        gauge = f"vacuum, measured by a gauge, 0 to 1; 0 if the {name} is not held"
        rows: tuple[tuple[str, str, str, Values, Values], ...] = (
            ("position", "m", f"centre of the {name}, from a camera", centre, extent),
            ("offset", "m", f"top of the {name} minus lip of the cup", _ZERO, near),
            ("velocity", "m/s", f"velocity of the {name}, from a camera", _ZERO, speed),
            ("tilt", "-", f"x and y of the unit vector along the {name}'s z axis", flat, unit),
            ("held", "-", gauge, (0.5,), (0.5,)),
        )
        ends = np.cumsum([9 + 12 * index, *(len(row[-1]) for row in rows)]).tolist()
        entries = tuple(
            Entry(f"{name}_{own}", unit, meaning, middle, scale, self._measure, columns)
            for (own, unit, meaning, middle, scale), columns in zip(
                rows, pairwise(ends), strict=True
            )
        )
        if not turn:
            return entries
        meaning, source = f"cosine and sine of 4 times the yaw of the {name}", partial(_turn, index)
        return (*entries, Entry(f"{name}_turn", "-", meaning, flat, unit, source))

    def _measure(self, state: State) -> FloatArray:
        """Return the measurements (n, 9 + 12 k): 9 of the robot, and 12 of each of k objects."""
        plain = np.ascontiguousarray
        values: FloatArray = loops().measured(
            state.fk_position, state.fk_velocity, state.command, plain(state.object_position),
            state.object_axis, plain(state.object_velocity), state.held, state.vacuum,
            _LIP, self._halves, CUP.vacuum,
        )  # fmt: skip
        return values

    def _scales(self) -> tuple[Values, Values, Values, Values]:
        """Return the region's centre and half size, m, world; speed limits, m/s; step limits, m."""
        region, mount = self.machine.region, self.machine.mount
        step = np.multiply(self.machine.step_limit, self.control_period / CONTROL_PERIOD)
        low, high = np.array(region.low), np.array(region.high)
        columns = (
            mount.to_world((low + high) / 2),
            (high - low) / 2,
            step / self.control_period,
            step,
        )
        centre, extent, speed, largest = (tuple(column.tolist()) for column in columns)
        return centre, extent, speed, largest

    def lip(self, state: State) -> FloatArray:
        """Return the centre (n, 3) m of the extended cup's lip, by forward kinematics."""
        lip: FloatArray = state.fk_position - _LIP
        return lip

    def top(self, state: State, index: int = 0) -> FloatArray:
        """Return the centre (n, 3) m of an object's top face."""
        half = self.scene.objects[index].height / 2
        return state.object_position[:, index] + state.object_axis[:, index] * half

    def observe(self, state: State) -> FloatArray:
        """Return the observation vectors (n, k), each entry of order one."""
        values = []
        for source, columns in self._sources:  # a comprehension is slower
            values.append(source(state)[:, columns])
        scaled: FloatArray = np.concatenate(values, axis=1)
        loops().normalise(scaled, self._centre, self._scale)
        return scaled

    def decode(self, observation: ArrayLike) -> dict[str, FloatArray]:
        """Invert :meth:`observe`: name -> (..., k) in SI units.

        Raises:
            InputError: If ``observation`` is not an array of numbers (..., observation_size).
        """
        vector = numbers("observation", observation)
        if vector.shape[-1:] != (self.observation_size,):
            valid = f"(..., {self.observation_size}), as with observations='state'"
            raise InputError("observation", vector.shape, valid)
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
        """Return the points (k, 3) m that show a goal (goal_size,)."""
        return goal.reshape(-1, 3)

    def _not_lost(self) -> tuple[FloatArray, FloatArray]:
        """Return the corners (k, 3) m of k boxes: an object is lost outside of its box."""
        low, high = np.empty((2, len(self.scene.objects), 3))
        for index, block in enumerate(self.scene.objects):
            places = self._place_of(block), self.starts_of(block), *self.goals_of(block)
            ends = np.stack([*chain(*places)])
            # The cup may hold the block off its middle, and the block may stop beside its goal.
            slack = max(block.width / 2, self.tolerance)
            low[index, :2] = ends[:, :2].min(axis=0) - slack
            high[index, :2] = ends[:, :2].max(axis=0) + slack
        low[:, 2], high[:, 2] = 0.0, np.inf
        return low, high

    def lost(self, state: State) -> BoolArray:
        """Return whether an object left the table, or the box of its allowed places, (n,)."""
        # The box is around the robot's reach, all starts and all goals.
        places = np.ascontiguousarray(state.object_position)
        lost: BoolArray = loops().any_outside(places, *self._within)
        return lost


def _turn(index: int, state: State) -> FloatArray:
    """Return cosine and sine of four times the yaw of an object, (n, 2)."""
    x, y, z, w = state.object_quaternion[:, index].T
    angle = 4 * np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _columns(entries: Sequence[Entry]) -> Any:
    """Return the NumPy index of the entries' columns in the result of the ``source`` they share."""
    if entries[0].columns is None:
        return slice(None)
    chosen = [k for entry in entries for k in range(*entry.columns or (0,))]
    return slice(len(chosen)) if chosen == list(range(len(chosen))) else chosen


def _range(low: ArrayLike, high: ArrayLike) -> str:
    least, most = (np.asarray(corner).round(4).tolist() for corner in (low, high))
    return f"{least} to {most} m"


def _boxes(points: FloatArray, block: Block) -> tuple[FloatArray, FloatArray]:
    """Return low and high corners (r, 3) m of upright blocks, each 1 um inside the block."""
    half = np.array(block.half) - 1e-6  # blocks may touch
    return points - half, points + half
