"""Many environments at a time, in closed form, as Gymnasium's vector environments are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, brief, finite, is_whole
from tpm_gym.envs.env import action_space, observation_space, require_same
from tpm_gym.envs.registration import VECTOR_ENTRY_POINT
from tpm_gym.envs.report import Observation, compute_reward, observe, report
from tpm_gym.errors import (
    ActionError,
    ConfigurationError,
    EpisodeError,
    InputError,
    ResetOptionError,
)
from tpm_gym.mechanism.machine import Machine
from tpm_gym.simulation.analytic.simulation import AnalyticSimulation, Moment
from tpm_gym.simulation.drives import Servo, drives_and_randomisation
from tpm_gym.simulation.randomisation import NOMINAL, Randomisation
from tpm_gym.simulation.state import CONTROL_PERIOD, State
from tpm_gym.tasks.control import make_control
from tpm_gym.tasks.registry import make_task
from tpm_gym.tasks.task import Task

__all__ = ["TPMVectorEnv", "VectorSnapshot", "make_vector"]

Step = tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]


def make_vector(num_envs: int = 1, *, engine: str = "pybullet", **options: Any) -> VectorEnv:
    """What ``gym.make_vec`` calls: closed form where that is asked for, else one after another.

    Args:
        num_envs: How many.
        engine: ``"analytic"`` makes a :class:`TPMVectorEnv`; others are stepped in turn, by a
            ``SyncVectorEnv``, for whose own options ``vectorization_mode="sync"`` has to be said.
        options: Those of an environment.
    """
    if engine == "analytic":
        return TPMVectorEnv(num_envs=num_envs, **options)
    mode = options.pop("autoreset_mode", AutoresetMode.NEXT_STEP)
    spec = _spec_of(options)
    envs = [lambda: gym.make(spec, engine=engine, **options)] * num_envs
    return SyncVectorEnv(envs, autoreset_mode=mode)


def _spec_of(options: Mapping[str, Any]) -> Any:
    """The registered spec with these task, control and reward."""
    for spec in gym.registry.values():
        of_id = {**spec.kwargs, "max_episode_steps": spec.max_episode_steps}
        if spec.vector_entry_point == VECTOR_ENTRY_POINT and all(
            options.get(name, value) == value for name, value in of_id.items()
        ):
            return spec
    valid = "task, control, reward and max_episode_steps of a registered id"
    raise ConfigurationError("options", dict(options), valid)


@dataclass(frozen=True)
class VectorSnapshot:
    """Everything that the next steps of vector environments depend on, and of which kind."""

    kind: Mapping[str, Any]
    simulation: Moment
    rngs: list[dict[str, Any]]
    goals: FloatArray
    elapsed: IntArray
    ended: BoolArray
    pending: FloatArray


class TPMVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """So many :class:`~tpm_gym.TPMEnv`, computed at a time by the closed form of their machine.

    Spaces, rewards, resets from seeds and infos are those of ``TPMEnv``, whatever their number: an
    environment has the same bits alone or among thousands. ``closure_error`` is zero by
    construction. Infos come as Gymnasium's vector environments have them, a mask ``_key`` beside
    each ``key``.

    Args:
        task: See :class:`~tpm_gym.TPMEnv`, also for the other options that are not here.
        control: See there.
        reward: See there.
        num_envs: How many.
        max_episode_steps: After so many, an episode is truncated; None for never.
        autoreset_mode: When environments whose episode ended are reset: ``NEXT_STEP``,
            ``SAME_STEP`` (with ``final_obs`` and ``final_info`` in the infos), or ``DISABLED`` (by
            ``reset(options={"reset_mask": ...})``).
        stagger: Whether the first episodes after a reset of all are of different lengths, so that
            not all end at the same step; it makes on-policy batches more even.
        render_mode: None: there are no pictures of many.
        physics: A :class:`~tpm_gym.simulation.analytic.physics.Physics`, or a mapping.

    Attributes:
        kind: What has to be equal for a snapshot of other environments to fit.

    Raises:
        ConfigurationError: If an option is out of range.
    """

    def __init__(
        self,
        task: str | type[Task] | Task = "reach",
        control: str = "cartesian",
        reward: str | None = None,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        stagger: bool = False,
        render_mode: None = None,
        machine: str | Machine | None = None,
        goals: str | None = None,
        penalty_weight: float | None = None,
        drive: str | Servo | Mapping[str, Any] | None = None,
        randomisation: Randomisation | Mapping[str, Any] | None = None,
        physics: Any = None,
    ) -> None:
        """Check the options and build the robots."""
        if not is_whole(num_envs, 1):
            raise ConfigurationError("num_envs", num_envs, "a whole number, 1 or more")
        self.num_envs = int(num_envs)
        if max_episode_steps is not None and not is_whole(max_episode_steps, 1):
            valid = "a whole number, 1 or more, or None for no end"
            raise ConfigurationError("max_episode_steps", max_episode_steps, valid)
        if not isinstance(stagger, bool):
            raise ConfigurationError("stagger", stagger, "True or False")
        if render_mode is not None:
            valid = "None; pictures are of one: gym.make(..., engine='analytic', render_mode=...)"
            raise ConfigurationError("render_mode", render_mode, valid)
        self.autoreset_mode = _mode_of(autoreset_mode)
        self.metadata = {
            "render_modes": [],
            "render_fps": round(1 / CONTROL_PERIOD),
            "autoreset_mode": self.autoreset_mode,
        }
        self.task = make_task(
            task, machine=machine, reward=reward, goals=goals, penalty_weight=penalty_weight
        )
        self.machine = self.task.machine
        self.control = make_control(control, self.machine)
        self.drive, self.randomisation = drives_and_randomisation(drive, randomisation)
        self.single_observation_space = observation_space(self.task)
        self.single_action_space = action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.simulation = AnalyticSimulation(
            self.task.scene,
            count=num_envs,
            machine=self.machine,
            physics=physics,
            drive=self.drive,
        )
        self.kind = {
            "task": type(self.task),
            "num_envs": num_envs,
            "machine": self.machine,
            "drive": self.drive,
            "randomisation": self.randomisation,
            "physics": self.simulation.physics,
        }
        self._altered = self.randomisation != Randomisation()
        many = type(self.task).sample_each is not Task.sample_each
        self._ahead_of_time = many and not self._altered
        self._home = tuple(self.machine.require_inverse(self.machine.home).tolist())
        self._limit, self._stagger = max_episode_steps, stagger
        self._rngs: list[np.random.Generator] = []
        self._ahead: dict[str, FloatArray] = {}  # starts of next episodes, where they are drawn
        self._drawn = np.zeros(num_envs, dtype=np.bool_)
        self._undrawn: list[Any] = [None] * num_envs  # states of their generators before that
        self._state: State | None = None
        self._goals = np.full((num_envs, self.task.goal_size), np.nan)
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.ones(num_envs, dtype=np.bool_)  # until they are reset
        self._pending = np.zeros((self.randomisation.latency, num_envs, self.task.action_size))

    # -- the Gymnasium interface ----------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in all environments, or in those of a mask.

        Args:
            seed: Of the first environment; the others' are one more each. Or one for each.
            options: ``reset_mask``, (num_envs,) of booleans; the rest is that of
                :meth:`TPMEnv.reset`, the same for all.

        Raises:
            InputError: If there is another number of seeds.
            ResetOptionError: If the mask is none; and what ``TPMEnv.reset`` raises.
            EpisodeError: If the environments are closed.
        """
        self._require_open()
        chosen, mask = options, None
        if isinstance(options, Mapping) and "reset_mask" in options:
            chosen = {name: value for name, value in options.items() if name != "reset_mask"}
            mask = options["reset_mask"]
        rows = self._rows_of(mask)
        self._seed(rows, seed)
        infos = self._begin(rows, chosen)
        if self._stagger and len(rows) == self.num_envs and self._limit is not None:
            self._elapsed[:] = np.arange(self.num_envs) * self._limit // self.num_envs
        self._state = self.simulation.state()
        observation, _, told = report(self.task, self._state, self._goals)
        return observation, {**_masked(told, rows, self.num_envs), **infos}

    def _rows_of(self, mask: Any) -> IntArray:
        if mask is None:
            return np.arange(self.num_envs)
        array = np.asarray(mask)
        if array.shape != (self.num_envs,) or array.dtype != np.bool_ or not array.any():
            valid = f"({self.num_envs},) booleans, at least one of them true"
            raise ResetOptionError("reset_mask", brief(mask), valid)
        return np.flatnonzero(array)

    def _seed(self, rows: IntArray, seed: int | Sequence[int | None] | None) -> None:
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else []
        if len(seeds) != self.num_envs:
            raise InputError("seed", brief(seed), f"one seed, or {self.num_envs}")
        if not self._rngs:
            self._rngs = [seeding.np_random(own)[0] for own in seeds]
            return
        for row in rows.tolist():
            if seeds[row] is not None:
                self._rngs[row] = seeding.np_random(seeds[row])[0]
                self._drawn[row] = False

    def _begin(self, rows: IntArray, options: dict[str, Any] | None = None) -> dict[str, Any]:
        """Start episodes in some environments; what is to be told of their randomisation."""
        plants = [NOMINAL] * len(rows)
        if self._ahead_of_time and not options:
            starts = self._drawn_ahead(rows)
        else:
            self._undraw(rows)
            rngs = self._rngs_of(rows)
            starts = self.task.starts(rngs, options)
            plants = [self.randomisation.draw(rng, self.machine) for rng in rngs]
        self._goals[rows] = starts.pop("goal")
        self.simulation.reset(rows, self._home, starts, plants, self._draw_noise(rows))
        self._pending[:, rows] = 0.0
        self._elapsed[rows] = 0
        self._ended[rows] = False
        infos: dict[str, Any] = {}
        if self._altered:
            for row, plant in zip(rows.tolist(), plants, strict=True):
                self._add_info(infos, {"randomisation": self.randomisation.told(plant)}, row)
        return infos

    def _rngs_of(self, rows: IntArray) -> list[np.random.Generator]:
        return [self._rngs[row] for row in rows.tolist()]

    def _drawn_ahead(self, rows: IntArray) -> dict[str, FloatArray]:
        """Where episodes start, drawn for all environments as soon as one has to be: it is cheaper.

        Only where nothing else is drawn, by a task that draws for many at a time.
        """
        if not self._drawn[rows].all():
            empty = np.flatnonzero(~self._drawn)
            rngs = self._rngs_of(empty)
            for row, rng in zip(empty.tolist(), rngs, strict=True):
                self._undrawn[row] = rng.bit_generator.state
            for name, values in self.task.starts(rngs, None).items():
                shape = (self.num_envs, *values.shape[1:])
                self._ahead.setdefault(name, np.empty(shape))[empty] = values
            self._drawn[:] = True
        self._drawn[rows] = False
        return {name: values[rows] for name, values in self._ahead.items()}

    def _undraw(self, rows: IntArray) -> None:
        """Put generators back to before they drew ahead."""
        for row in rows[self._drawn[rows]].tolist():
            self._rngs[row].bit_generator.state = self._undrawn[row]
        self._drawn[rows] = False

    def step(self, actions: NDArray[Any]) -> Step:
        """Run one control step of 40 ms in all environments, or reset those whose episode ended.

        Raises:
            ActionError: If the actions have the wrong shape or are not finite.
            EpisodeError: Before reset, after close, or where an episode ended and is not reset.
        """
        self._require_open()
        shape = (self.num_envs, self.task.action_size)
        values = finite("actions", actions, shape, ActionError)
        # By columns, as the simulation has it; np.clip costs more.
        values = np.minimum(np.maximum(np.asfortranarray(values), -1.0), 1.0)
        ended = np.flatnonzero(self._ended)
        if len(ended) and not (self._rngs and self.autoreset_mode == AutoresetMode.NEXT_STEP):
            own = ', for some with options={"reset_mask": ...}' if self._rngs else " first"
            raise EpisodeError(
                f"no episode is running in environment {ended[0]}; call reset(){own}"
            )
        self._move(values, np.flatnonzero(~self._ended))
        self._elapsed += 1
        infos = self._begin(ended) if len(ended) else {}
        self._state = self.simulation.state()
        observation, reward, told = report(self.task, self._state, self._goals)
        truncated = told["assembly_mode_changed"] | told["working_mode_changed"]
        if self._limit is not None:
            truncated |= self._elapsed >= self._limit
        reward[ended] = 0.0
        self._ended = truncated.copy()
        infos = {**_masked(told, None, self.num_envs), **infos}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and truncated.any():
            infos = self._begin_anew(observation, told)
        return observation, reward, np.zeros_like(truncated), truncated, infos

    def _move(self, values: FloatArray, running: IntArray) -> None:
        """A control period with these actions, or those that come late."""
        if len(self._pending):
            values, *pending = (*self._pending, values)
            self._pending = np.array(pending)
        simulation = self.simulation
        command = self.control.command(values[:, :3], simulation.commands)
        vacuum = values[:, 3] > 0 if self.task.vacuum else np.zeros(self.num_envs, dtype=np.bool_)
        simulation.move(command, vacuum, self._draw_noise(running))

    def _begin_anew(self, observation: Observation, last: Mapping[str, Any]) -> dict[str, Any]:
        """Reset what has ended, in the observation too; infos, with what it ended with."""
        rows, n = np.flatnonzero(self._ended), self.num_envs
        final = np.full(n, None, dtype=object)
        for row in rows.tolist():
            final[row] = {name: values[row].copy() for name, values in observation.items()}
        told = self._begin(rows)
        self._state = self.simulation.state()
        anew, _, first = report(self.task, _take(self._state, rows), self._goals[rows])
        for name, values in anew.items():
            observation[name][rows] = values
        ended = np.isin(np.arange(n), rows)
        return {
            **_masked(_updated(last, first, rows), None, n),
            **told,
            "final_obs": final,
            "_final_obs": ended,
            "final_info": _masked(last, rows, n),
            "_final_info": ended,
        }

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is held beyond memory."""
        del kwargs

    # -- beyond Gymnasium -----------------------------------------------------------------------

    @property
    def state(self) -> State:
        """What the simulation reported last, with a leading axis.

        Raises:
            EpisodeError: If there is no episode.
        """
        self._require_open()
        if self._state is None:
            raise EpisodeError("no episode is running; call reset() first")
        return self._state

    @property
    def goal(self) -> FloatArray:
        """The episodes' goals, (num_envs, goal size) m, world."""
        return np.array(self._goals)

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """See :meth:`TPMEnv.compute_reward`."""
        return compute_reward(self.task, achieved_goal, desired_goal, info)

    def save_state(self) -> VectorSnapshot:
        """Take down everything that the next steps depend on.

        Raises:
            EpisodeError: If there is no episode.
        """
        _ = self.state  # there has to be an episode
        self._undraw(np.arange(self.num_envs))
        return VectorSnapshot(
            self.kind,
            self.simulation.save(),
            [dict(rng.bit_generator.state) for rng in self._rngs],
            *(values.copy() for values in (self._goals, self._elapsed, self._ended, self._pending)),
        )

    def restore_state(self, snapshot: VectorSnapshot) -> Observation:
        """Go back to a moment that :meth:`save_state` took down, of as many and equal environments.

        Returns:
            The observation at that moment.

        Raises:
            InputError: If the moment is none, or that of other environments; nothing has happened
                then.
        """
        self._require_open()
        if not isinstance(snapshot, VectorSnapshot):
            raise InputError("snapshot", type(snapshot), "what save_state() returned")
        require_same(snapshot.kind, self.kind)
        self.simulation.restore(snapshot.simulation)
        self._seed(np.arange(self.num_envs), None)
        self._drawn[:] = False
        for rng, state in zip(self._rngs, snapshot.rngs, strict=True):
            rng.bit_generator.state = state
        self._goals, self._elapsed, self._ended, self._pending = (
            values.copy()
            for values in (snapshot.goals, snapshot.elapsed, snapshot.ended, snapshot.pending)
        )
        self._state = self.simulation.state()
        return observe(self.task, self._state, self._goals)

    def _draw_noise(self, rows: IntArray) -> FloatArray | None:
        """Errors of one reading of these environments' encoders, rad, for all."""
        size = self.randomisation.encoder_noise
        if size == 0:
            return None
        noise = np.zeros((3, self.num_envs))
        for row in rows.tolist():
            noise[:, row] = self._rngs[row].normal(0.0, size, 3)
        return noise

    def _require_open(self) -> None:
        if self.closed:
            raise EpisodeError("the environments are closed; make new ones")


def _mode_of(value: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(value)
    except ValueError as error:
        valid = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ConfigurationError("autoreset_mode", value, valid) from error


def _masked(told: Mapping[str, Any], rows: IntArray | None, count: int) -> dict[str, Any]:
    """Values (count,) with a mask beside each: true in ``rows``, or everywhere."""
    mask = np.ones(count, dtype=np.bool_)
    if rows is not None:
        mask[:] = False
        mask[rows] = True
    infos: dict[str, Any] = {}
    for name, value in told.items():
        nested = isinstance(value, Mapping)
        infos[name] = _masked(value, rows, count) if nested else value
        infos[f"_{name}"] = mask
    return infos


def _updated(last: Mapping[str, Any], first: Mapping[str, Any], rows: IntArray) -> dict[str, Any]:
    """The same values (n,) with others in some rows; the old arrays stay as they were."""
    result: dict[str, Any] = {}
    for name, value in last.items():
        if isinstance(value, Mapping):
            result[name] = _updated(value, first[name], rows)
        else:
            result[name] = value.copy()
            result[name][rows] = first[name]
    return result


def _take(state: State, rows: IntArray) -> State:
    """Some rows of a state."""
    return State(**{field.name: getattr(state, field.name)[rows] for field in fields(State)})
