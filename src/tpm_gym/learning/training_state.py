"""State of a training between two rollouts, saved and restored exactly, to the last bit.

On one thread, and on the same kind of computer, a restored training continues as if it had not been
interrupted. A resumed hindsight training looks untrained if one of three things is missing:

- the count of steps: Stable-Baselines3 acts at random for the first ``learning_starts`` steps;
- the optimisers;
- the unfinished episode: the replay buffer would join it to another episode, and relabel its steps
  with goals that were never reached.
"""

import io
import json
import random
from collections import deque
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import CSVOutputFormat, Logger, TensorBoardOutputFormat
from stable_baselines3.her import HerReplayBuffer
from tensorboard.compat.proto.event_pb2 import (  # type: ignore[import-untyped]
    Event,
    SessionLog,
)
from typing_extensions import TypedDict

from tpm_gym import TPMError
from tpm_gym.learning.checkpoint import STATE, TENSORS, Content, starting
from tpm_gym.learning.errors import CheckpointError
from tpm_gym.learning.provenance import versions, write_whole
from tpm_gym.learning.rollout import Action, GoalEnv, Observation
from tpm_gym.learning.run_folder import CONFIG_FILE, LAST, PROGRESS_FILE, RESTORED, clear_tests
from tpm_gym.learning.vec_env import AnalyticVecEnv

_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining")
_PER_KEY = ("observations", "next_observations")
_PER_ROW = ("actions", "rewards", "dones", "timeouts", "ep_start", "ep_length")


class _Episode(TypedDict):
    """Return and length of an episode."""

    r: float
    l: int  # noqa: E741


class _State(TypedDict):
    """Content of the JSON file of a checkpoint: the state except tensors and arrays."""

    counters: dict[str, float]
    statistics: tuple[list[_Episode], list[float]]
    log: tuple[dict[str, int], dict[str, list[str]]]  # counts, and formats that are left out
    rng: dict[str, Any]
    episodes: Any
    versions: dict[str, str | None]
    seconds: float


class EpisodeRecorder(gym.Wrapper[Observation, Action, Observation, Action]):
    """Wrapper that records the seed and the actions of the unfinished episode.

    PyBullet has state that cannot be read, so the episode is repeated instead. Repeating is exact,
    takes a tenth of a second, and also restores the wrappers inside this one.
    """

    def __init__(self, env: GoalEnv) -> None:
        """Start with no episode."""
        super().__init__(env)
        self._seed: int | None = None
        self._rng: dict[str, Any] = {}
        self._actions: list[Action] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode."""
        self._seed, self._actions = seed, []
        self._rng = dict(self.unwrapped.np_random.bit_generator.state)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Action) -> tuple[Observation, Any, bool, bool, dict[str, Any]]:
        """Run one control step."""
        self._actions.append(np.array(action))
        return self.env.step(action)

    def episode(self) -> dict[str, Any]:
        """Return the unfinished episode as plain data."""
        dtype = str(self._actions[0].dtype) if self._actions else ""
        return {"seed": self._seed, "rng": self._rng, "dtype": dtype, "actions": self._actions}

    def replay(self, episode: Mapping[str, Any]) -> Observation | None:
        """Repeat an episode; return its last observation.

        Return None if the reset or a step raises a TPMError.
        """
        self.unwrapped.np_random.bit_generator.state = episode["rng"]
        try:
            observation, _ = self.reset(seed=episode["seed"])
            for action in episode["actions"]:
                observation, *_ = self.step(np.array(action, dtype=episode["dtype"]))
        except TPMError:
            return None
        return observation


def capture(model: BaseAlgorithm, run: Path, seconds: float, finished: bool = False) -> Content:
    """Return the state of a training between two rollouts; arrays of the buffer are views.

    Args:
        model: Algorithm whose environments are an ``AnalyticVecEnv``, or have an
            :class:`EpisodeRecorder` each.
        seconds: Training time so far, s.
    """
    envs: Any = model.env
    observations: Any = model._last_obs
    if isinstance(envs, AnalyticVecEnv):
        episodes, columns = envs.state()
    else:
        episodes, columns = envs.env_method("episode"), {}
    state = {
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "statistics": [list(model.ep_info_buffer or ()), list(model.ep_success_buffer or ())],
        "log": [model.logger.name_to_count, model.logger.name_to_excluded],
        "rng": _rng_state(model),
        "episodes": episodes,
        "versions": versions(),
        "seconds": seconds,
    }
    files = {
        STATE: json.dumps(state, default=lambda array: array.tolist()).encode(),
        TENSORS: _tensors(model),
    }
    files |= {name: (run / name).read_bytes() for name in RESTORED if (run / name).is_file()}
    arrays = {f"last/{name}": np.array(value) for name, value in observations.items()}
    arrays["episode_starts"] = np.array(model._last_episode_starts)
    arrays |= {f"envs/{name}": values for name, values in columns.items()}
    arrays |= {f"buffer/{name}": array for name, array in _buffer_arrays(model).items()}
    # Values that are not yet written to the log; arrays keep their types.
    arrays |= {f"log/{k}": np.asarray(value) for k, value in model.logger.name_to_value.items()}
    return Content(model.num_timesteps, finished, files, arrays)


def restore_files(run: Path, content: Content) -> None:
    """Set the files of a run back to a checkpoint; delete the files of later policies."""
    clear_tests(run)
    # last.zip marks a finished run, so an earlier one must not stay.
    for name in {*RESTORED, *LAST} - {CONFIG_FILE}:  # the caller writes config.json anew
        if name in content.files:
            write_whole(run / name, partial(Path.write_bytes, data=content.files[name]))
        else:
            (run / name).unlink(missing_ok=True)


def restore(model: BaseAlgorithm, content: Content) -> float:
    """Restore a training in a new algorithm, built with equal arguments.

    Return the training time until the checkpoint, s.
    """
    state = json.loads(content.files[STATE])
    TypeAdapter(_State).validate_python(state)
    content.files.get(PROGRESS_FILE, b"").decode("utf-8")
    if any(value.ndim or value.dtype.kind not in "fiub" for value in _pending(content).values()):
        raise ValueError("values of the log that are no numbers")
    for name in _COUNTERS:
        setattr(model, name, type(getattr(model, name))(state["counters"][name]))
    size = model._stats_window_size
    model.ep_info_buffer, model.ep_success_buffer = (
        deque(entries, maxlen=size) for entries in state["statistics"]
    )
    _restore_buffer(model, content.arrays)
    _restore_episodes(model, state, content.arrays)
    # Generators are restored last, since the lines above may draw from them.
    _restore_tensors(model, content.files[TENSORS])
    _restore_rng(model, state["rng"])
    return float(state["seconds"])


def _tensors(model: BaseAlgorithm) -> bytes:
    """Return networks, optimisers and PyTorch's generators as a file."""
    _, names = model._get_torch_save_params()
    content = {
        "parameters": model.get_parameters(),
        "variables": {name: getattr(model, name).detach() for name in names},
        "rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state_all() if model.device.type == "cuda" else [],
    }
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _restore_tensors(model: BaseAlgorithm, data: bytes) -> None:
    content: dict[str, Any] = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    model.set_parameters(content["parameters"], exact_match=True)
    with torch.no_grad():
        for name, value in content["variables"].items():
            getattr(model, name).copy_(value)  # in place: the optimiser holds this very tensor
    torch.set_rng_state(content["rng"])
    if model.device.type == "cuda" and len(content["cuda_rng"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(content["cuda_rng"])


def _rng_state(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the states of the random generators of Python, NumPy and the action space."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002  # SB3 draws from it
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _restore_rng(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state(state["numpy"])  # noqa: NPY002
    model.action_space.np_random.bit_generator.state = state["actions"]


def _buffer_arrays(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """Return the replay buffer's position and views of its filled part; empty without a buffer."""
    buffer = getattr(model, "replay_buffer", None)
    if not isinstance(buffer, DictReplayBuffer):
        return {}
    size = buffer.size()
    arrays = {"place": np.array([buffer.pos, buffer.full])}
    for group in _PER_KEY:
        arrays |= {f"{group}/{key}": rows[:size] for key, rows in getattr(buffer, group).items()}
    arrays |= {name: getattr(buffer, name)[:size] for name in _PER_ROW if hasattr(buffer, name)}
    if isinstance(buffer, HerReplayBuffer):
        arrays["current_ep_start"] = buffer._current_ep_start
    return arrays


def _restore_buffer(model: BaseAlgorithm, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Fill an empty replay buffer, and restore its record of episodes."""
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, DictReplayBuffer):
        position, full = arrays["buffer/place"].tolist()
        buffer.pos, buffer.full = position, bool(full)
    for name, view in _buffer_arrays(model).items():
        view[:] = arrays[f"buffer/{name}"]


def _restore_episodes(
    model: BaseAlgorithm, state: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Restore the unfinished episodes up to their last step.

    Raises:
        CheckpointError: If the observations after the last step differ from the saved ones, or an
            episode cannot be repeated.
    """
    envs: Any = model.env
    last = starting(arrays, "last/")
    if isinstance(envs, AnalyticVecEnv):
        found = envs.restore(state["episodes"], starting(arrays, "envs/"))
    else:
        each = enumerate(state["episodes"])
        rows = [envs.env_method("replay", episode, indices=[i])[0] for i, episode in each]
        keys = model.observation_space.spaces if None not in rows else ()  # type: ignore[attr-defined]
        found = {name: np.array([row[name] for row in rows]) for name in keys}
    equal = (np.array_equal(found[name], values) for name, values in last.items() if name in found)
    if last.keys() != found.keys() or not all(equal):
        now, before = versions(), state["versions"]
        changed = [f"{k} {before.get(k)} -> {now[k]}" for k in now if before.get(k) != now[k]]
        raise CheckpointError(
            "the unfinished episodes do not repeat: the physics have changed "
            f"({', '.join(changed) or 'with equal versions'}); install the versions of "
            "config.json again, or start the run anew with --overwrite"
        )
    starts = arrays["episode_starts"].astype(np.bool_).reshape(model.n_envs)
    model._last_obs, model._last_episode_starts = last, starts


def _pending(content: Content) -> dict[str, NDArray[Any]]:
    """Return the values that were not yet written to the log."""
    return starting(content.arrays, "log/")


class _Log(Logger):
    """Logger that counts iterations from the beginning of the run, not of the process."""

    earlier = 0

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Store a value for the next line of the log."""
        counted = key == "time/iterations"
        super().record(key, value + self.earlier if counted else value, exclude)


def make_logger(run: Path, content: Content | None, iterations: int) -> Logger:
    """Open the log of a run as it was at a checkpoint, after ``iterations`` rollouts."""
    path = run / PROGRESS_FILE
    before = "" if content is None or not path.is_file() else path.read_text(encoding="utf-8")
    table = CSVOutputFormat(str(path))  # empties the file
    table.file.write(before)
    table.file.flush()
    table.keys = before.split("\n", 1)[0].split(",") if before else []
    events = TensorBoardOutputFormat(str(run))
    logger = _Log(str(run), [table, events])
    logger.earlier = iterations
    if content is not None:
        # TensorBoard then hides events that an earlier process logged after this step.
        start = Event(step=content.step + 1, session_log=SessionLog(status=SessionLog.START))
        writer: Any = events.writer
        writer._get_file_writer().add_event(start)
        counts, excluded = json.loads(content.files[STATE])["log"]
        pending: Any = logger.name_to_value
        pending |= {k: value[()] for k, value in _pending(content).items()}
        logger.name_to_count.update(counts)
        logger.name_to_excluded.update({name: tuple(kinds) for name, kinds in excluded.items()})
    return logger
