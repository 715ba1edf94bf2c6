"""Core of n environments of one task in one engine; :class:`TPMEnv` is the case n = 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import FloatArray, IntArray, Vector, finite, numbers
from tpm_gym.envs.rendering import Pixels, Rendering
from tpm_gym.errors import ConfigurationError, EpisodeError, InputError
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.drives import Servo, drives_and_randomisation
from tpm_gym.simulation.randomisation import NOMINAL, Randomisation
from tpm_gym.simulation.simulation import Simulation, Snapshot
from tpm_gym.simulation.state import CONTROL_PERIOD, State
from tpm_gym.tasks import checking
from tpm_gym.tasks.control import Follower, make_control
from tpm_gym.tasks.registry import make_task
from tpm_gym.tasks.task import Task

if TYPE_CHECKING:
    from tpm_gym.envs.shield import BrakingShield, Shield

OBSERVATION_BOUND = 10.0
GOAL_BOUND = 2.0

INFO: Final = {
    "is_success": bool,
    "closure_error": float,
    "vacuum": float,
    "conditioning": float,
    "singularity_penalty": float,
    "assembly_mode_changed": bool,
    "working_mode_changed": bool,
    "object_lost": bool,
    "reward_terms": dict,
}
"""Type of each entry that all infos have. The events of a task are further entries."""

_TAKEN: Final = ("randomisation", "final_obs", "final_info", "episode")
"""Names of entries that this package or Gymnasium adds to some infos. No event of a task may have
one of these names, or a name in ``INFO``."""

Observation = dict[str, Any]  # arrays of float32
Report = tuple[Observation, FloatArray, dict[str, Any]]
"""Observation, reward (n,) and info, whose values are arrays (n,)."""


@dataclass(frozen=True)
class EnvSnapshot:
    """Everything that the next steps of n environments depend on.

    Attributes:
        kind: Task and options. Environments with another task or with other options cannot restore
            the snapshot.
        simulation: Snapshot of the simulation.
        rngs: States of the n random generators, with their seeds.
        columns: Arrays by name: goals, delayed actions, and delayed camera measurements. A vector
            environment adds the number of steps of each episode, and whether the episode has ended.
    """

    kind: Mapping[str, Any]
    simulation: Snapshot
    rngs: list[dict[str, Any]]
    columns: dict[str, NDArray[Any]]


class Core:
    """n environments of one task in one engine; rows are environments.

    The arguments are explained in :class:`tpm_gym.TPMEnv`.

    Attributes:
        task: The task.
        control: The control.
        rngs: A generator for each environment, once they are reset.
        episode: (n,) number of episodes that were started or restored.
        goals: (n, goal_size) m, world.
    """

    def __init__(
        self,
        task: str | type[Task] | Task = "reach",
        control: str = "cartesian",
        reward: str | None = None,
        *,
        count: int = 1,
        engine: str = "pybullet",
        machine: str | Machine | None = None,
        goals: str | None = None,
        penalty_weight: float | None = None,
        drive: str | Servo | Mapping[str, Any] | None = None,
        randomisation: Randomisation | Mapping[str, Any] | None = None,
        shield: bool | float = False,
        physics: Any = None,
        observations: str = "state",
        pixel_size: int = 84,
        render_mode: str | None = None,
        renderer: str | None = None,
        camera: Any = "table",
        width: int = 640,
        height: int = 480,
    ) -> None:
        """Check the options and start the simulation."""
        self.count = count
        self.task = make_task(
            task, machine=machine, reward=reward, goals=goals, penalty_weight=penalty_weight
        )
        checking.check(self.task, taken=(*INFO, *_TAKEN))
        if control not in self.task.controls:
            valid = f"{' or '.join(map(repr, self.task.controls))} for {type(self.task).__name__}"
            raise ConfigurationError("control", control, valid)
        self.machine = self.task.machine
        self.control = make_control(control, self.machine, self.task.control_period)
        self.drive, self.randomisation = drives_and_randomisation(drive, randomisation)
        self.randomisation.require_fitting(self.machine)
        self._altered = self.randomisation != Randomisation()
        limits, period = _accelerations(self.task), self.task.control_period
        self._follower = None if limits is None else Follower(self.machine, *limits, period)
        self._shield = None if shield is False else self._make_shield(shield)
        self._rendering = Rendering(self.machine, render_mode, camera, width, height)
        self._pixels: Pixels | None = None
        if observations == "pixels":
            self._pixels = Pixels(self.task, camera, pixel_size)
        elif observations != "state":
            raise ConfigurationError("observations", observations, "'state' or 'pixels'")
        gui = render_mode == "human"
        self._engine = {"engine": engine, "physics": physics, "gui": gui, "renderer": renderer}
        self.kind = {
            "task": type(self.task),
            "reward": self.task.reward,
            "goals": self.task.goals,
            "penalty_weight": self.task.penalty_weight,
            "control": control,  # of the delayed actions
            "machine": self.machine,
            "engine": engine,
            "drive": self.drive,
            "randomisation": self.randomisation,
            "physics": _as_in_json(physics),
            "shield": shield,
            "number of environments": count,
            "observations": observations,
        }
        self._home = self.machine.require_inverse(np.array(self.machine.home))
        self._state: State | None = None
        self.closed = False
        self.rngs: list[np.random.Generator] = []
        self.episode = np.zeros(count, dtype=np.int64)
        self.goals = np.full((count, self.task.goal_size), np.nan)
        self._pending = np.zeros((self.randomisation.latency, count, self.task.action_size))
        # Objects in the last control steps, oldest first, if the camera is late
        self._views = np.zeros((self.task.camera_delay, count, len(self.task.scene.objects), 9))
        self._newest = self._views[:1]  # a copy, as users may change arrays of the state
        self.simulation = self._start()

    def _make_shield(self, shield: bool | float) -> Shield | BrakingShield:
        from tpm_gym.envs.shield import make_shield  # imports Numba

        if self._follower is None and self.task.control_period < CONTROL_PERIOD:
            # The limit of the step alone lets commands reverse faster than the motors can.
            valid = "False, or a task that sets accelerations, as its control period is shorter"
            raise ConfigurationError("shield", shield, f"{valid} than {CONTROL_PERIOD} s")
        exact = self.drive is None and not self._altered
        return make_shield(shield, self.machine, self.control, self._follower, exact)

    def _start(self) -> Simulation:
        return Simulation(
            self.task.scene,
            machine=self.machine,
            count=self.count,
            control_period=self.task.control_period,
            drive=self.drive,
            **self._engine,
        )

    # -- running ----------------------------------------------------------------------------

    def reset(
        self, rows: IntArray, rngs: Sequence[np.random.Generator], options: Any = None
    ) -> list[dict[str, Any]]:
        """Start episodes in some environments.

        Args:
            rows: (r,) environments.
            rngs: Their generators from now on.
            options: As in :meth:`tpm_gym.TPMEnv.reset`.

        Returns:
            The randomisation of each episode; empty dictionaries without randomisation.

        Raises:
            EpisodeError: If the environments are closed.
            ResetOptionError: If an option is not possible; the environments are then unchanged.
            UnreachableError: If an object or the goal is out of reach; the environments are then
                unchanged.
            ConfigurationError: If the task returns a wrong start, or a goal outside the observation
                space.
        """
        self.require_open()
        before = [rng.bit_generator.state for rng in rngs] if options is not None else []
        try:
            starts = self.task.start(rngs, options)
            _require_in_space(starts["goal"])
        except BaseException:
            for rng, state in zip(rngs, before, strict=False):
                rng.bit_generator.state = state
            raise
        plants = [NOMINAL] * len(rows)
        if self._altered:
            plants = [self.randomisation.draw(rng, self.machine) for rng in rngs]
        self.rngs = self.rngs or [np.random.default_rng() for _ in range(self.count)]
        for row, rng in zip(rows.tolist(), rngs, strict=True):
            self.rngs[row] = rng
        self.goals = self.goals.copy()
        self.goals[rows] = starts.pop("goal")
        departures = self.task.departures(self.goals[rows])
        home = self._home if departures is None else self.machine.require_inverse(departures)
        self._state = None
        self.episode[rows] += 1
        self._pending[:, rows] = 0.0
        noise = self._noise(rows)[rows] if self.randomisation.encoder_noise > 0 else None
        speed = starts.pop("belt_speed")[:, 0] if "belt_speed" in starts else None
        self.simulation.reset(rows, home, starts, plants, noise, speed)
        if len(self._views):
            self._views[:, rows] = _view(self.simulation.state())[rows]
        return [self.randomisation.told(plant) if self._altered else {} for plant in plants]

    def step(self, actions: FloatArray, running: IntArray) -> None:
        """Run a control period in all environments.

        Args:
            actions: (n, action_size) finite numbers; clipped to [-1, 1].
            running: (r,) environments whose episode is running. Encoder noise is drawn only for
                these environments.
        """
        actions = np.minimum(np.maximum(actions, -1.0), 1.0)
        late = self._pending
        if len(late):
            late = np.concatenate([late, actions[None]])
            actions, late = late[0], late[1:]
        simulation = self.simulation
        commands = self.control.command(actions[:, :3], simulation.commands)
        if self._follower is not None:
            commands = self._follower.limit(commands, simulation.commands, simulation.recent[:, 0])
        if self._shield is not None:
            commands = self._shield.command(commands, simulation.recent)
        vacuum = actions[:, 3] > 0 if self.task.vacuum else np.zeros(self.count, dtype=np.bool_)
        if len(self._views):
            self._views = np.concatenate([self._views[1:], self._newest])
        self._state = None
        noisy = self.randomisation.encoder_noise > 0
        simulation.move(commands, vacuum, self._noise(running) if noisy else None)
        self._pending = late

    def report(self, rows: IntArray | None = None) -> Report:
        """Read the state, and return observation, reward and info of all or of some environments.

        Raises:
            ConfigurationError: If a result of the task is not finite.
        """
        state, goals = self.simulation.state(), self.goals
        self._state = seen = state
        if len(self._views):
            seen, self._newest = _seen(state, self._views[0]), _view(state)[None]
        if rows is not None:
            state, seen, goals = state.take(rows), seen.take(rows), goals[rows]
        task = self.task
        found = np.ascontiguousarray(task.achieved(seen))
        observed, achieved, desired, sound = self.simulation.loops.bounded(
            task.observe(seen), OBSERVATION_BOUND, found, GOAL_BOUND, goals
        )
        gap, penalty = task.gap(achieved, desired), task.penalty(state)
        terms = task.reward_terms(state, gap, penalty)
        reward = terms["goal"] + _goal_free(terms)
        # A scalar product would be faster for a few robots. For many, BLAS would wake threads.
        if not (sound and np.isfinite(reward).all()):
            raise _not_finite(task, seen, achieved, terms)
        observation = {"observation": observed, "achieved_goal": achieved, "desired_goal": desired}
        if self._pixels is not None:
            chosen = range(self.count) if rows is None else rows.tolist()
            drawn = [(row, self._markers(row)) for row in chosen]
            observation = self._pixels.observe(observation, self.simulation, drawn)
        info = {
            "is_success": task.success(gap),
            "closure_error": state.closure_error,
            "vacuum": state.vacuum,
            "conditioning": state.conditioning,
            "singularity_penalty": penalty,
            "assembly_mode_changed": state.assembly_mode_changed,
            "working_mode_changed": state.working_mode_changed,
            "object_lost": task.lost(state),
            "reward_terms": terms,
            **{event: getattr(task, event)(state) for event in task.events},
        }
        return observation, reward, info

    def _noise(self, rows: IntArray) -> FloatArray:
        """Draw the errors (n, 3) rad of one reading of the encoders, for some environments."""
        noise = np.zeros((self.count, 3))
        for row in rows.tolist():
            noise[row] = self.rngs[row].normal(0.0, self.randomisation.encoder_noise, 3)
        return noise

    # -- pictures ---------------------------------------------------------------------------

    def frame(self, row: int) -> Any:
        """Draw an environment in its ``render_mode``.

        Raises:
            EpisodeError: If the environments are closed, or before the first reset.
            ConfigurationError: If the engine cannot draw in this ``render_mode``.
        """
        return self._rendering.frame(self.simulation, row, self._markers(row))

    def show(self) -> None:
        """Update the window."""
        self.simulation.show(self._rendering.view.camera, self._markers(0))

    def _markers(self, row: int) -> FloatArray:
        """Return the goal markers (k, 3) m of an environment."""
        self.require_open()
        if not self.rngs:
            raise EpisodeError("there is nothing to draw before the first episode; call reset()")
        return self.task.markers(self.goals[row])

    @property
    def observation_space(self) -> spaces.Dict:
        """Space of one environment's observations."""
        goal = _box(GOAL_BOUND, self.task.goal_size)
        observation = _box(OBSERVATION_BOUND, self.task.observation_size)
        vectors = {"observation": observation, "achieved_goal": goal, "desired_goal": goal}
        if self._pixels is not None:
            return spaces.Dict(self._pixels.spaces_of(vectors))
        return spaces.Dict({**vectors})

    # -- state, end -------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The state after the last step or reset.

        Raises:
            EpisodeError: If no episode is running.
        """
        if self._state is None:
            self.require_open()
            raise EpisodeError("no episode is running; call reset() first")
        return self._state

    def save(self, **columns: NDArray[Any]) -> EnvSnapshot:
        """Return a snapshot of everything that the next steps depend on.

        Args:
            columns: Further arrays to keep in the snapshot, by name.

        Raises:
            EpisodeError: If no episode is running.
        """
        _ = self.state  # raises without an episode
        rngs = [{**rng.bit_generator.state, "seed": seed_of(rng)} for rng in self.rngs]
        own = {"goals": self.goals, "pending": self._pending, "views": self._views, **columns}
        copies = {name: values.copy() for name, values in own.items()}
        return EnvSnapshot(self.kind, self._save_simulation(), rngs, copies)

    def _save_simulation(self) -> Snapshot:
        """Return a snapshot, and update :attr:`state`, since saving restarts the simulation."""
        snapshot = self.simulation.save()
        self._state = self.simulation.state()
        self._newest = _view(self._state)[None]
        return snapshot

    def restore(self, snapshot: Any) -> Observation:
        """Continue from a snapshot of these or equal environments; return the observation.

        Raises:
            EpisodeError: If the environments are closed.
            InputError: If ``snapshot`` is no snapshot of equal environments; the environments are
                then unchanged.
        """
        self.require_open()
        self.require_equal(snapshot)
        self.rngs = [np.random.default_rng(state.get("seed")) for state in snapshot.rngs]
        for rng, state in zip(self.rngs, snapshot.rngs, strict=True):
            rng.bit_generator.state = state
        self.goals = snapshot.columns["goals"].copy()
        self._pending = snapshot.columns["pending"].copy()
        self._views = snapshot.columns["views"].copy()
        self._state = None
        self.episode += 1  # the expert must plan again
        self.simulation.restore(snapshot.simulation)
        return self.report()[0]

    def require_equal(self, snapshot: Any) -> None:
        """Raise InputError if ``snapshot`` is no snapshot of these or equal environments."""
        if not isinstance(snapshot, EnvSnapshot):
            raise InputError("snapshot", type(snapshot), "what save_state() returned")
        other = [name for name in self.kind if snapshot.kind.get(name) != self.kind[name]]
        if other:
            differing = f"another {', '.join(other)}"
            raise InputError("snapshot", differing, "of the same task and options")

    def require_open(self) -> None:
        """Raise EpisodeError if the environments are closed."""
        if self.closed:
            raise EpisodeError("the environment is closed; make a new one")

    def close(self) -> None:
        """Close the simulation; a second call does nothing."""
        if not self.closed:
            self.closed, self._state = True, None
            self.simulation.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for :func:`copy.deepcopy` and :mod:`pickle`, during episodes too.

        In the result, ``simulation`` is a snapshot of the simulation, or None if no episode is
        running.

        Raises:
            ConfigurationError: If there is a window: PyBullet opens only one in a process.
        """
        if self._engine["gui"]:
            valid = "None or 'rgb_array' for an environment that is copied or pickled"
            raise ConfigurationError("render_mode", "human", valid)
        snapshot = None if self._state is None else self._save_simulation()
        return {**vars(self), "simulation": snapshot}

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Create a new simulation, and continue from the state of the original."""
        vars(self).update(values)
        snapshot: Snapshot | None = values["simulation"]
        self.simulation = self._start()
        if self.closed:
            self.simulation.close()
        elif snapshot is not None:
            self.simulation.restore(snapshot)


def seed_of(rng: np.random.Generator) -> int:
    """Return the seed that a generator was made with."""
    return int(rng.bit_generator.seed_seq.entropy)  # type: ignore[attr-defined]


def _as_in_json(physics: Any) -> Any:
    """Return physics as a dictionary, like in a spec that went through JSON."""
    settings = is_dataclass(physics) and not isinstance(physics, type)
    return asdict(physics) if settings else physics


def _view(state: State) -> FloatArray:
    """Return what a camera measures of k objects, (n, k, 9): position, z axis, velocity."""
    parts = state.object_position, state.object_axis, state.object_velocity
    return np.concatenate(parts, axis=2)


def _seen(state: State, view: FloatArray) -> State:
    """Return a copy of a state in which the objects are as in ``view``, from :func:`_view`."""
    position, axis, velocity = np.split(view, 3, axis=2)
    return replace(state, object_position=position, object_axis=axis, object_velocity=velocity)


# -- observation, reward, info ------------------------------------------------------------------


def action_space(task: Task) -> spaces.Box:
    """Return the space of a task's actions."""
    return _box(1.0, task.action_size)


def _box(bound: float, length: int) -> spaces.Box:
    return spaces.Box(-bound, bound, (length,), np.float32)


def _accelerations(task: Task) -> tuple[Vector, Vector] | None:
    """Return the limits of a task's accelerations; refuse limits that are not positive."""
    if task.accelerations is None:
        return None
    limits = finite("accelerations", task.accelerations, (2, 3), ConfigurationError)
    if not (limits > 0).all():
        raise ConfigurationError("accelerations", limits.tolist(), "positive numbers, m/s^2")
    return task.accelerations


def _require_in_space(goals: FloatArray) -> None:
    """Refuse goals (r, goal_size) m that are outside the observation space."""
    beyond = np.abs(goals).max(axis=1) > GOAL_BOUND
    if beyond.any():
        valid = f"coordinates from -{GOAL_BOUND:g} to {GOAL_BOUND:g} m, as the observation space"
        raise ConfigurationError("sample()['goal']", goals[beyond][0].tolist(), valid)


def _goal_free(terms: Mapping[str, Any]) -> Any:
    """Return the sum of the reward terms that do not depend on the goal."""
    total: Any = 0.0
    for name, value in terms.items():
        if name != "goal":
            total = total + value
    return total


def _not_finite(
    task: Task, state: State, achieved: NDArray[Any], terms: Mapping[str, Any]
) -> ConfigurationError:
    """Return an error that names the first non-finite value of a task."""
    values = {
        **{
            f"observed(), {entry.name!r}": entry.source(state)[:, slice(*entry.columns or (None,))]
            for entry in task.entries
        },
        "achieved()": achieved,
        **{f"reward_terms()[{name!r}]": value for name, value in terms.items()},
    }
    name, value = next(item for item in values.items() if not np.isfinite(item[1]).all())
    return ConfigurationError(name, np.asarray(value).tolist(), "finite numbers from the task")


def compute_reward(task: Task, achieved: ArrayLike, desired: ArrayLike, info: Any) -> Any:
    """Compute rewards of transitions for any goals; see :meth:`tpm_gym.TPMEnv.compute_reward`.

    Raises:
        InputError: If the goals are no real numbers of fitting shapes, or ``info`` does not fit.
    """
    _require_goals(task.goal_size, achieved, desired)
    goal_term = np.asarray(task.goal_term(task.gap(achieved, desired)))
    try:
        if isinstance(info, Mapping):
            other: Any = float(_goal_free(info.get("reward_terms", {})))
        else:
            others = [float(_goal_free(entry.get("reward_terms", {}))) for entry in info]
            other = np.array(others).reshape(goal_term.shape)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        valid = f"a step's info, or one for each of the {goal_term.size} transitions"
        raise InputError("info", type(info), valid) from error
    total = goal_term + other
    return float(total) if np.ndim(total) == 0 else total


def _require_goals(size: int, achieved: ArrayLike, desired: ArrayLike) -> None:
    """Raise InputError if arrays do not have the shapes of goals.

    Goals that are not finite are accepted, and count as not achieved.
    """
    shapes = [numbers("achieved_goal", achieved).shape, numbers("desired_goal", desired).shape]
    try:
        np.broadcast_shapes(*shapes)
        fit = all(shape[-1:] == (size,) for shape in shapes)
    except ValueError:
        fit = False
    if not fit:
        valid = f"of shapes (..., {size}) that go together"
        raise InputError("achieved_goal, desired_goal", shapes, valid)
