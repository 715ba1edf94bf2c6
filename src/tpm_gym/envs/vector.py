"""Many environments at a time, as Gymnasium's vector environments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from tpm_gym.arrays import BoolArray, FloatArray, IntArray, brief, finite, is_whole
from tpm_gym.envs.core import (
    Core,
    EnvSnapshot,
    Observation,
    action_space,
    compute_reward,
    seed_of,
)
from tpm_gym.envs.rendering import RENDER_MODES
from tpm_gym.errors import (
    ActionError,
    ConfigurationError,
    EpisodeError,
    InputError,
    ResetOptionError,
)
from tpm_gym.simulation.engine import most_robots
from tpm_gym.simulation.imaging import tile
from tpm_gym.simulation.state import State
from tpm_gym.tasks.task import Task

_MOST = 10**6  # largest number of environments; those of pick-and-place take some 10 GB
_FEWEST = 2048  # smallest number of environments for each of several threads

Step = tuple[Observation, FloatArray, BoolArray, BoolArray, dict[str, Any]]


class TPMVectorEnv(VectorEnv[Observation, NDArray[Any], NDArray[Any]]):
    """n environments that are stepped together.

    Spaces, rewards, seeds and infos are as in :class:`~tpm_gym.TPMEnv`, which also explains the
    arguments that are not listed here. In the analytic engine, the results of an environment do not
    depend, in any bit, on the number of environments and threads. Infos have the form of
    Gymnasium's vector environments, with a mask ``_key`` for each ``key``.

    Args:
        num_envs: Number of environments, n.
        engine: ``"analytic"`` computes all environments together. With other engines, each
            environment has its own engine, and the environments are stepped one after another.
        num_threads: Largest number of threads that step the environments of the analytic engine.
            Several threads are used only if each of them steps at least 2,048 environments. With
            fewer, they gain little or are slower.
        max_episode_steps: Steps after which an episode is truncated; None for no limit.
        autoreset_mode: Time of the reset after the end of an episode: ``NEXT_STEP``, ``SAME_STEP``
            (with ``final_obs`` and ``final_info`` in the infos), or ``DISABLED`` (the user calls
            ``reset(options={"reset_mask": ...})``).
        stagger: Whether the first episodes after a full reset have different lengths, so that
            they do not all end at the same step. This makes on-policy batches more even.
        render_mode: As in :class:`~tpm_gym.TPMEnv`, but not ``"human"``.

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
        engine: str = "pybullet",
        num_threads: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        stagger: bool = False,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """Check the options and start the simulations."""
        for name, count in (("num_envs", num_envs), ("num_threads", num_threads)):
            if not is_whole(count, 1) or count > _MOST:
                raise ConfigurationError(name, count, f"a whole number, 1 or more, at most {_MOST}")
        if max_episode_steps is not None and not is_whole(max_episode_steps, 1):
            valid = "a whole number, 1 or more, or None for no limit"
            raise ConfigurationError("max_episode_steps", max_episode_steps, valid)
        if not isinstance(stagger, bool):
            raise ConfigurationError("stagger", stagger, "True or False")
        at_most = most_robots(engine)
        modes = [mode for mode in RENDER_MODES if mode != "human"]
        if render_mode is not None and render_mode not in modes:
            valid = f"None, {', '.join(map(repr, modes))}; windows show single environments"
            raise ConfigurationError("render_mode", render_mode, valid)
        if num_threads > 1 and options.get("observations") == "pixels":
            raise ConfigurationError("num_threads", num_threads, "1 with observations='pixels'")
        options["render_mode"] = render_mode
        self.render_mode = render_mode
        self.num_envs = int(num_envs)
        self.autoreset_mode = _mode_of(autoreset_mode)
        self.metadata = {
            "render_modes": modes,
            "autoreset_mode": self.autoreset_mode,
        }
        at_once = self.autoreset_mode == AutoresetMode.SAME_STEP
        self._stagger = max_episode_steps if stagger else None
        self._parts: list[_Part] = []
        try:
            for size in _sizes(self.num_envs, at_most, num_threads):
                core = Core(task, control, reward, count=size, engine=engine, **options)
                self._parts.append(_Part(core, max_episode_steps, at_once))
        except BaseException:
            self.close_extras()
            raise
        ends = np.cumsum([part.core.count for part in self._parts]).tolist()
        self._slices = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]
        self._threads = len(self._parts) if at_most is None else 1
        self._pool = self._make_pool()
        first = self._parts[0].core
        self.metadata["render_fps"] = round(1 / first.task.control_period)
        self.task, self.machine, self.control = first.task, first.machine, first.control
        self.drive, self.randomisation = first.drive, first.randomisation
        self.single_observation_space = first.observation_space
        self.single_action_space = action_space(self.task)
        self._shape = self.num_envs, self.task.action_size
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _make_pool(self) -> ThreadPoolExecutor | None:
        return ThreadPoolExecutor(self._threads) if self._threads > 1 else None

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without threads, for :func:`copy.deepcopy` and :mod:`pickle`."""
        return {**vars(self), "_pool": None}

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Restore the environments, and start threads of their own."""
        vars(self).update(values)
        self._pool = None if self.closed else self._make_pool()

    def _each(self, function: Callable[[_Part, slice], Any]) -> list[Any]:
        """Call a function for each part, in parallel if there are several threads."""
        (first, *rest) = zip(self._parts, self._slices, strict=True)
        if self._pool is None:
            return [function(*pair) for pair in (first, *rest)]
        others = [self._pool.submit(function, *pair) for pair in rest]
        try:
            own = function(*first)  # this thread works too
        finally:
            wait(others)
        return [own, *(other.result() for other in others)]

    # -- the Gymnasium interface ----------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in all environments, or in the environments of a mask.

        Args:
            seed: Seed of the first environment, increased by one for each further environment;
                or n seeds, one for each environment.
            options: ``reset_mask``, (n,) booleans; and the options of :meth:`TPMEnv.reset`, used
                for all environments.

        Raises:
            InputError: If a seed is not possible, or the number of seeds is not n; the environments
                are then unchanged.
            ResetOptionError: If the mask is not valid; also the errors of ``TPMEnv.reset``.
            EpisodeError: If the environments are closed.
        """
        self._require_open()
        chosen, mask = options, np.ones(self.num_envs, dtype=np.bool_)
        if isinstance(options, Mapping) and "reset_mask" in options:
            chosen = {name: value for name, value in options.items() if name != "reset_mask"}
            mask = self._mask(options["reset_mask"])
        rngs = self._generators(seed)

        def begin(part: _Part, rows: slice) -> Any:
            return part.reset(np.flatnonzero(mask[rows]), rngs[rows], chosen)

        found = self._each(begin)
        if self._stagger is not None and mask.all():
            lengths = np.arange(self.num_envs) * self._stagger // self.num_envs
            for part, rows in zip(self._parts, self._slices, strict=True):
                part.elapsed[:] = lengths[rows]
        return self._merged(found)

    def _mask(self, mask: Any) -> BoolArray:
        array = np.asarray(mask)
        if array.shape != (self.num_envs,) or array.dtype != np.bool_ or not array.any():
            valid = f"({self.num_envs},) booleans, at least one of them true"
            raise ResetOptionError("reset_mask", brief(mask), valid)
        return array

    def _generators(self, seed: Any) -> list[np.random.Generator | None]:
        """Return a generator for each seed; None where an environment keeps its generator."""
        if seed is None or is_whole(seed, 0):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else []
        whole = all(own is None or is_whole(own, 0) for own in seeds)
        if len(seeds) != self.num_envs or not whole or isinstance(seed, str):
            valid = f"one whole number, 0 or more, or {self.num_envs} of them"
            raise InputError("seed", brief(seed), valid)
        return [None if own is None else seeding.np_random(int(own))[0] for own in seeds]

    def step(self, actions: NDArray[Any]) -> Step:
        """Run one control step in each environment, and reset environments whose episode ended.

        With ``NEXT_STEP``, the reset replaces the next control step of the environment. With
        ``SAME_STEP``, it follows the last control step of the episode at once.

        Raises:
            ActionError: If the actions have the wrong shape or are not finite.
            EpisodeError: Before reset, after close, or if an environment still has to be reset.
        """
        plain = type(actions) is np.ndarray and actions.dtype.char in "df"
        if not plain or actions.shape != self._shape or not np.isfinite(actions).all():
            actions = finite("actions", actions, self._shape, ActionError)
        self._require_running()
        if len(self._parts) == 1:
            observation, reward, ended, info = self._parts[0].step(actions)
        else:
            found = self._each(lambda part, rows: part.step(actions[rows]))
            observations, rewards, ends, infos = zip(*found, strict=True)
            observation, info = self._merged(zip(observations, infos, strict=True))
            reward, ended = np.concatenate(rewards), np.concatenate(ends)
        return observation, reward, np.zeros_like(ended), ended, info

    def _require_running(self) -> None:
        """Raise EpisodeError if the environments are closed, or if the user must reset some."""
        if self.closed:
            self._require_open()
        begun = all(part.core.rngs for part in self._parts)
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and begun:
            return
        ended = np.flatnonzero(np.concatenate([part.ended for part in self._parts]))
        if len(ended):
            way = ', for some with options={"reset_mask": ...}' if begun else " first"
            raise EpisodeError(
                f"no episode is running in environment {ended[0]}; call reset(){way}"
            )

    def _merged(
        self, found: Iterable[tuple[Observation, dict[str, Any]]]
    ) -> tuple[Observation, dict[str, Any]]:
        """Join observations and infos of all parts."""
        observations, infos = zip(*found, strict=True)
        if len(infos) == 1:
            return observations[0], infos[0]
        counts = [part.core.count for part in self._parts]
        return _joined(observations, counts), _joined(infos, counts)

    def render(self) -> tuple[Any, ...] | None:
        """Draw all environments; see :meth:`TPMEnv.render`."""
        self._require_open()
        if self.render_mode is None:
            return None
        return tuple(self._frame(row) for row in range(self.num_envs))

    def _frame(self, row: int) -> Any:
        part = next(k for k, rows in enumerate(self._slices) if row < rows.stop)
        return self._parts[part].core.frame(row - self._slices[part].start)

    def render_tile(self, count: int = 16, columns: int | None = None) -> NDArray[Any]:
        """Draw the first environments side by side, as one picture.

        Args:
            count: Number of environments to draw. If there are fewer, all environments are drawn.
            columns: Pictures in each line; with None, there are about as many columns as lines.

        Raises:
            ConfigurationError: If ``render_mode`` is None or ``"rgbd_tuple"``.
        """
        self._require_open()
        for name, value in (("count", count), ("columns", 1 if columns is None else columns)):
            if not is_whole(value, 1):
                raise ConfigurationError(name, value, "a whole number, 1 or more")
        if self.render_mode in (None, "rgbd_tuple"):
            valid = "'rgb_array', 'depth_array' or 'segmentation'"
            raise ConfigurationError("render_mode", self.render_mode, valid)
        return tile([self._frame(row) for row in range(min(count, self.num_envs))], columns)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the simulations and the threads."""
        # Gymnasium before 1.3 also closes an environment whose constructor raised, so that
        # attributes may be missing.
        for part in getattr(self, "_parts", ()):
            part.core.close()
        if getattr(self, "_pool", None) is not None:
            self._pool.shutdown()  # type: ignore[union-attr]

    def _require_open(self) -> None:
        if self.closed:
            raise EpisodeError("the environments are closed; make new ones")

    # -- beyond Gymnasium -----------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The state after the last step or reset, with a leading axis.

        Raises:
            EpisodeError: If no episode is running.
        """
        states = [vars(part.core.state) for part in self._parts]
        if len(states) == 1:
            return State(**states[0])
        return State(**{k: np.concatenate([s[k] for s in states]) for k in states[0]})

    @property
    def kind(self) -> Mapping[str, Any]:
        """Task and options. Snapshots of environments with other values cannot be restored."""
        return self._parts[0].core.kind

    @property
    def episode(self) -> IntArray:
        """(n,) number of episodes that were started or restored."""
        return np.concatenate([part.core.episode for part in self._parts])

    @property  # type: ignore[misc]  # Gymnasium's can be set
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Generators of the n environments; none before the first reset."""
        return tuple(rng for part in self._parts for rng in part.core.rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Seeds of the n generators."""
        return tuple(map(seed_of, self.np_random))

    @property
    def goal(self) -> FloatArray:
        """The episodes' goals, (n, goal size) m, world."""
        return np.concatenate([part.core.goals for part in self._parts])

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """See :meth:`TPMEnv.compute_reward`."""
        return compute_reward(self.task, achieved_goal, desired_goal, info)

    def save_state(self) -> list[EnvSnapshot]:
        """Return everything that the next steps depend on.

        Raises:
            EpisodeError: If no episode is running.
        """
        return [part.core.save(elapsed=part.elapsed, ended=part.ended) for part in self._parts]

    def restore_state(self, snapshots: Sequence[EnvSnapshot]) -> Observation:
        """Continue from snapshots of these environments or of equal ones.

        Returns:
            The observation at that moment.

        Raises:
            InputError: If they are not snapshots of equal environments; the environments are then
                unchanged.
        """
        self._require_open()
        if not isinstance(snapshots, list) or len(snapshots) != len(self._parts):
            valid = "what save_state() of as many environments and threads returned"
            raise InputError("snapshots", brief(snapshots), valid)
        for part, snapshot in zip(self._parts, snapshots, strict=True):
            part.require_equal(snapshot)
        pairs = zip(self._parts, snapshots, strict=True)
        return self._merged([(part.restore(snapshot), {}) for part, snapshot in pairs])[0]


class _Part:
    """Part of a vector environment: the environments of one :class:`Core`, with their autoreset.

    Attributes:
        core: Core that runs these environments.
        elapsed: (n,) steps of the episodes so far.
        ended: (n,) whether an environment needs a reset.
    """

    def __init__(self, core: Core, limit: int | None, at_once: bool) -> None:
        """Start with no episode running."""
        self.core, self._limit, self._at_once = core, limit, at_once
        self.elapsed = np.zeros(core.count, dtype=np.int64)
        self.ended = np.ones(core.count, dtype=np.bool_)

    def reset(
        self, rows: IntArray, rngs: Sequence[np.random.Generator | None], options: Any
    ) -> tuple[Observation, dict[str, Any]]:
        """Start episodes in the environments ``rows``.

        ``rngs`` has an entry for each of the n environments: a new generator, or None if the
        environment keeps its generator.

        Returns:
            Observations and infos of all n environments.
        """
        core = self.core
        own = core.rngs or [seeding.np_random(None)[0] for _ in range(core.count)]
        infos, first = {}, not core.rngs
        if len(rows):
            infos = self._begin(rows, [rngs[k] or own[k] for k in rows.tolist()], options)
        if first and len(rows) < core.count:
            # The engine needs all robots at home. The others still wait for their own reset.
            others = np.setdiff1d(np.arange(core.count), rows)
            self._begin(others, [own[k] for k in others.tolist()])
            self.ended[others] = True
        observation, _, info = core.report()
        return observation, {**_masked(info, rows, core.count), **infos}

    def _begin(
        self, rows: IntArray, rngs: Sequence[np.random.Generator], options: Any = None
    ) -> dict[str, Any]:
        """Start episodes in some environments; return the infos about their randomisation."""
        drawn = self.core.reset(rows, rngs, options)
        self.elapsed[rows] = 0
        self.ended[rows] = False
        infos: dict[str, Any] = {}
        for row, own in zip(rows.tolist(), drawn, strict=True):
            if own:
                _add(infos, {"randomisation": own}, row, self.core.count)
        return infos

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Observation, FloatArray, BoolArray, dict[str, Any]]:
        """Run a control step, and reset environments whose episode ended."""
        core = self.core
        renewed = np.flatnonzero(self.ended)
        core.step(actions.astype(np.float64), np.flatnonzero(~self.ended))
        self.elapsed += 1
        infos = {}
        if len(renewed):
            infos = self._begin(renewed, [core.rngs[row] for row in renewed.tolist()])
        observation, reward, info = core.report()
        ended = info["assembly_mode_changed"] | info["working_mode_changed"]
        if self._limit is not None:
            ended = ended | (self.elapsed >= self._limit)
        reward[renewed] = 0.0
        self.ended = ended.copy()
        infos = {**_masked(info, None, core.count), **infos}
        if self._at_once and ended.any():
            infos = self._begin_anew(observation, info)
        return observation, reward, ended, infos

    def _begin_anew(self, observation: Observation, last: Mapping[str, Any]) -> dict[str, Any]:
        """Reset the environments whose episodes ended, and return the infos of all environments.

        In ``observation`` and in the returned infos, the first values of the new episodes replace
        the last values of the ended episodes. The last values are in ``final_obs`` and
        ``final_info`` of the returned infos.

        Args:
            observation: Observations after the last step. The arrays are changed in place.
            last: Infos after the last step.
        """
        core, rows, ended = self.core, np.flatnonzero(self.ended), self.ended.copy()
        final = np.full(core.count, None, dtype=object)
        for row in rows.tolist():
            final[row] = {name: values[row].copy() for name, values in observation.items()}
        randomised = self._begin(rows, [core.rngs[row] for row in rows.tolist()])
        new, _, first = core.report(rows)
        for name, values in new.items():
            observation[name][rows] = values
        return {
            **_masked(_updated(last, first, rows), None, core.count),
            **randomised,
            "final_obs": final,
            "_final_obs": ended,
            "final_info": _masked(last, rows, core.count),
            "_final_info": ended,
        }

    def require_equal(self, snapshot: Any) -> None:
        """Raise InputError unless ``snapshot`` is from a part of equal size, task and options."""
        self.core.require_equal(snapshot)
        if "elapsed" not in snapshot.columns:
            valid = "from save_state() of a vector environment, which counts steps"
            raise InputError("snapshot", "from a single environment", valid)

    def restore(self, snapshot: EnvSnapshot) -> Observation:
        """Continue from a snapshot."""
        observation = self.core.restore(snapshot)
        self.elapsed = snapshot.columns["elapsed"].copy()
        self.ended = snapshot.columns["ended"].copy()
        return observation


def _sizes(count: int, most: int | None, threads: int) -> list[int]:
    """Divide ``count`` environments into parts, and return the sizes of the parts.

    Args:
        count: Number of environments.
        most: Largest size of a part. If it is None, there is one part for each thread.
        threads: Largest number of threads. Several threads are used only if each of them gets at
            least ``_FEWEST`` environments.
    """
    parts = min(threads, max(count // _FEWEST, 1)) if most is None else -(-count // most)
    return [count // parts + (k < count % parts) for k in range(parts)]


def _mode_of(value: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(value)
    except ValueError as error:
        valid = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ConfigurationError("autoreset_mode", value, valid) from error


def _masked(info: Mapping[str, Any], rows: IntArray | None, count: int) -> dict[str, Any]:
    """Return ``info`` with a mask ``_key`` (count,) for each ``key``.

    The mask is true in ``rows``, or everywhere if ``rows`` is None.
    """
    mask = np.ones(count, dtype=np.bool_)
    if rows is not None:
        mask[:] = False
        mask[rows] = True
    infos: dict[str, Any] = {}
    for name, value in info.items():
        nested = isinstance(value, Mapping)
        infos[name] = _masked(value, rows, count) if nested else value
        infos[f"_{name}"] = mask
    return infos


def _updated(last: Mapping[str, Any], first: Mapping[str, Any], rows: IntArray) -> dict[str, Any]:
    """Return a copy of the infos ``last``, in which ``first`` replaces the values of ``rows``.

    ``last`` are the infos of a step, and ``first`` the infos of new episodes in the environments
    ``rows``.
    """
    result: dict[str, Any] = {}
    for name, value in last.items():
        if isinstance(value, Mapping):
            result[name] = _updated(value, first[name], rows)
        else:
            result[name] = value.copy()
            result[name][rows] = first[name]
    return result


def _add(infos: dict[str, Any], info: Mapping[str, Any], row: int, count: int) -> None:
    """Add the info of one environment, in the form of Gymnasium's vector environments."""
    for name, value in info.items():
        if isinstance(value, Mapping):
            _add(infos.setdefault(name, {}), value, row, count)
        else:
            plain = isinstance(value, (int, float))
            empty = np.zeros(count, type(value)) if plain else np.full(count, None, object)
            infos.setdefault(name, empty)[row] = value
        infos.setdefault(f"_{name}", np.zeros(count, dtype=np.bool_))[row] = True


def _joined(infos: Sequence[Mapping[str, Any]], counts: Sequence[int]) -> dict[str, Any]:
    """Join the infos of parts; entries that a part lacks are 0 or None in its rows."""
    joined: dict[str, Any] = {}
    for name in dict.fromkeys(name for info in infos for name in info):
        values = [info.get(name) for info in infos]
        if any(isinstance(value, Mapping) for value in values):
            joined[name] = _joined([value or {} for value in values], counts)
            continue
        kind = next(value.dtype for value in values if value is not None)
        joined[name] = np.concatenate(
            [
                np.full(count, None if kind.hasobject else 0, kind) if value is None else value
                for value, count in zip(values, counts, strict=True)
            ]
        )
    return joined
