"""Datasets for offline learning, in the format of Minari.

Episodes of the kinds ``expert``, ``noisy`` and ``random`` depend only on their seeds. Repeating a
command therefore gives a bit-equal dataset, and a longer dataset begins with the episodes of a
shorter one. Episodes of the kind ``replay`` also depend on the training; see
:mod:`tpm_gym.learning.replay`.
"""

from __future__ import annotations

import copy
import hashlib
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, get_args

import gymnasium as gym
import numpy as np
import tyro
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from rich.console import Console

import tpm_gym
from tpm_gym.errors import ConfigurationError, TPMError, brief
from tpm_gym.learning import provenance
from tpm_gym.learning.configuration import (
    UNSET,
    EnvOptions,
    GivenEnvOptions,
    TrainingConfig,
    check_least,
    check_seed,
    complete,
    unset,
)
from tpm_gym.learning.environments import USUAL, check_env_id, import_module_of, make_envs
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.evaluation import bar
from tpm_gym.learning.policies import NoisyPolicy, load_policy
from tpm_gym.learning.rollout import (
    BATCH,
    TEST_SEED,
    Policy,
    Step,
    play,
    run_episodes,
    summarise,
)
from tpm_gym.mechanism.machine import Machine, registered_name
from tpm_gym.tasks.registry import TASKS, make_task
from tpm_gym.tasks.task import Task

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

    from tpm_gym.envs.vector import TPMVectorEnv

Advance = Callable[[int], object]
Kind = Literal["expert", "noisy", "random", "replay"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
REFERENCE: Final = 100
"""Number of episodes for each of the two reference scores of a dataset. These scores are the mean
returns of random actions and of the expert."""

_INFOS: Final = ("conditioning", "is_success", "singularity_penalty")
_DATA: Final = "data"  # name that Minari expects
_METADATA: Final = "metadata.json"
_OURS: Final = "tpm_gym"  # entry of the metadata that marks our datasets


@dataclass(frozen=True)
class CollectConfig:
    """Collect datasets for offline learning, in the format of Minari.

    The kinds are: "expert"; "noisy", the expert with noise on its actions; "random", uniform random
    actions; and "replay", a policy at ten moments of its training.
    """

    env: Annotated[tuple[str, ...], unset(tuple[str, ...], "all with an expert", "ID ...")] = UNSET
    """Environment ids, or module:id if a module of yours registers it."""

    kind: Annotated[tuple[Kind, ...], tyro.conf.arg(metavar="KIND ...")] = KINDS
    """Kinds of datasets."""

    episodes: int = 1000
    """Episodes of each dataset."""

    seed: int = 0
    """Seed of the first episode, and of the training for kind "replay"."""

    noise: float = 0.3
    """Standard deviation of the noise in kind "noisy", in units of the largest action."""

    steps: Annotated[int, unset(int, "as the recipe says", "INT")] = UNSET
    """Steps of the training for kind "replay"."""

    out: Annotated[Path, unset(Path, "Minari's", "FOLDER")] = UNSET
    """Folder of the datasets. Minari's folder is $MINARI_DATASETS_PATH, or ~/.minari/datasets."""

    overwrite: bool = False
    """Replace datasets that this command wrote earlier."""

    env_options: GivenEnvOptions = field(default_factory=lambda: EnvOptions(engine="analytic"))


@dataclass(frozen=True)
class Dataset:
    """A dataset to collect: its id in Minari, its folder, and the command's options."""

    config: CollectConfig
    env: str
    kind: Kind
    root: Path

    @property
    def name(self) -> str:
        """Id in Minari."""
        own = check_env_id(self.env).kwargs.get("engine") or USUAL["engine"]
        given = {"engine": own, **self.config.env_options.given()}
        if given["engine"] == "analytic":  # the command's default
            del given["engine"]
        if given.get("shield") is False:  # the id's default
            del given["shield"]
        if given.get("shield", True) is not True:
            given["shield"] = f"shield{given['shield']}".replace(".", "_")  # Minari has no dots
        options = [value if isinstance(value, str) else key for key, value in given.items()]
        words = "-".join(filter(None, (self.kind, *options)))
        return f"{self.env.rpartition(':')[2]}/{words}-v0"

    @property
    def folder(self) -> Path:
        """Folder of the dataset; Minari loads its subfolder ``data``."""
        return self.root / self.name

    @property
    def training(self) -> TrainingConfig:
        """Configuration of the training whose policies play the episodes of kind ``replay``.

        Raises:
            ConfigError: There is no recipe for the environment, or an option is refused.
        """
        seed, steps, options = self.config.seed, self.config.steps, self.config.env_options
        return complete(TrainingConfig(env=self.env, seed=seed, steps=steps, env_options=options))


def collect(config: CollectConfig, console: Console | None = None) -> list[Path]:
    """Collect the datasets of a configuration; return their folders.

    Raises:
        ConfigError: An option is not valid, or a dataset is there already.
        ConfigurationError: The environment does not have an option, or refuses its value.
        MissingPackageError: A package is not installed. Every dataset needs Minari and h5py; a
            dataset of kind ``replay`` also needs PyTorch and Stable-Baselines3.
    """
    console = console or Console()
    _require_packages(config.kind)
    from minari.storage import get_dataset_path

    envs = _complete(config)
    root = get_dataset_path() if config.out is UNSET else config.out
    todo = [Dataset(config, env, kind, root) for env in envs for kind in config.kind]
    if "replay" in config.kind:
        console.print("loading PyTorch ...")
    for dataset in todo:
        if dataset.kind == "replay":
            _ = dataset.training  # raises before anything is written
    for env in envs:
        _require_possible(env, config.env_options)
    for dataset in todo:
        _require_free(dataset)
    scores: dict[str, tuple[float, float]] = {}
    for dataset in todo:
        console.print(f"{dataset.name}: {config.episodes} episodes ...", markup=False)
        if dataset.env not in scores:
            scores[dataset.env] = _reference_scores(dataset.env, config.env_options)
        found = _write(dataset, scores[dataset.env], console)
        console.print(f"  {dataset.folder}, sha256 {found}", markup=False, soft_wrap=True)
    return [dataset.folder for dataset in todo]


def _require_packages(kinds: Sequence[str]) -> None:
    """Refuse to start without a package that is needed later."""
    extras = {"minari": "data", "h5py": "data"}
    if "replay" in kinds:
        extras |= {"torch": "train", "stable_baselines3": "train"}
    provenance.require_packages(extras)


def _complete(config: CollectConfig) -> list[str]:
    """Check the options; return the ids of the environments."""
    check_least(config, 1, "episodes", "steps")
    check_least(config, 0, "noise")
    check_seed(config.seed, config.episodes)
    for name in ("env", "kind"):
        if getattr(config, name) == ():
            raise ConfigError(f"--{name}: give at least one")
    if not math.isfinite(config.noise):
        raise ConfigError(f"--noise {config.noise}: must be finite")
    if wrong := [kind for kind in config.kind if kind not in KINDS]:
        raise ConfigError(f"--kind {wrong[0]}: there are {', '.join(KINDS)}")
    if config.env is UNSET:
        return [env for env in tpm_gym.ENV_IDS if _has_expert(env)]
    for env in config.env:
        import_module_of(env)
        if not _has_expert(env):
            raise ConfigError(f"--env {env}: its task has no expert; give it a plan")
        _require_recoverable(env, config.env_options)
    return list(config.env)


def _stored(env: str, options: EnvOptions) -> EnvSpec:
    """Return the registration of ``env``, changed by ``options``, as a dataset stores it.

    A machine or a task that is registered is stored by its name.
    """
    spec = copy.deepcopy(check_env_id(env))
    spec.kwargs |= options.given()
    if isinstance(machine := spec.kwargs.get("machine"), Machine):
        spec.kwargs["machine"] = registered_name(machine) or machine
    if isinstance(task := spec.kwargs.get("task"), type):
        names = (name for name, kind in TASKS.items() if kind is task)
        spec.kwargs["task"] = next(names, task)
    return spec


def _require_recoverable(env: str, options: EnvOptions) -> None:
    """Refuse an environment that could not be made again from a dataset.

    The environment that is made again must have the same task and the same options.
    """
    spec = _stored(env, options)
    for name, value in spec.kwargs.items():
        try:
            found = EnvSpec.from_json(replace(spec, kwargs={name: value}).to_json()).kwargs
        except (TypeError, ValueError):  # no JSON
            found = {}
        if found == {name: value}:
            continue
        both = [{**spec.kwargs, **found}, spec.kwargs] if found else []
        try:
            kinds = [_kind(replace(spec, kwargs=kwargs)) for kwargs in both]
        except TPMError:
            kinds = []
        if not kinds or kinds[0] != kinds[1]:
            shown, way = getattr(value, "name", brief(value)), "register an id with plain data"
            if name in ("machine", "task"):
                way = f"register the {name} with tpm_gym.register_{name}"
            raise ConfigError(
                f"--env {env}: a dataset cannot store its {name}, {shown!r}, so the environment "
                f"could not be recovered; {way}"
            )


def _require_possible(env: str, options: EnvOptions) -> None:
    """Refuse options that the environment refuses, before any dataset is written."""
    try:
        _kind(_stored(env, options))
    except ConfigurationError as error:
        raise replace(error, valid=f"{error.valid} (in {env})") from error


def _kind(spec: EnvSpec) -> Any:
    """Return task and options of an environment."""
    with closing(make_envs(spec, 1)) as envs:
        return envs.kind


def _has_expert(env: str) -> bool:
    kwargs = check_env_id(env).kwargs
    task = make_task(kwargs.get("task", "reach"), kwargs.get("machine"))
    return type(task).plan is not Task.plan


def _reference_scores(env: str, options: EnvOptions) -> tuple[float, float]:
    """Return the mean returns of random actions and of the expert, on held-out seeds."""
    count = REFERENCE if options.in_batches else 1
    with closing(make_envs(env, count, **options.given())) as envs:
        low, high = (
            summarise(run_episodes(envs, load_policy(name, envs), REFERENCE, TEST_SEED))
            for name in ("random", "expert")
        )
    return low["return"].mean, high["return"].mean


# -- episodes -------------------------------------------------------------------------------------


def _episodes(dataset: Dataset, advance: Advance) -> Iterator[EpisodeBuffer]:
    """Play the episodes of a dataset."""
    record = partial(_record, advance)
    config, options = dataset.config, dataset.config.env_options
    if dataset.kind == "replay":
        from tpm_gym.learning import replay

        yield from replay.episodes(dataset.training, config.episodes, record)
        return
    count = min(config.episodes, BATCH) if options.in_batches else 1
    with closing(make_envs(dataset.env, count, **options.given())) as envs:
        policy = load_policy("random" if dataset.kind == "random" else "expert", envs)
        if dataset.kind == "noisy":
            policy = NoisyPolicy(policy, config.noise)
        yield from record(envs, policy, config.episodes, config.seed)


def _record(
    advance: Advance, envs: TPMVectorEnv, policy: Policy, episodes: int, first_seed: int
) -> Iterator[EpisodeBuffer]:
    """Play episodes of a policy; episode i is reset with ``first_seed + i``."""
    for first in range(first_seed, first_seed + episodes, envs.num_envs):
        count = min(envs.num_envs, first_seed + episodes - first)
        yield from _split(list(play(envs, policy, first, count)), first, count)
        advance(count)


def _split(steps: Sequence[Step], first_seed: int, count: int) -> Iterator[EpisodeBuffer]:
    """Yield the episodes of the first ``count`` rows.

    Observations and infos have one entry more than actions: the entry after the last step.
    """
    from minari.data_collector import EpisodeBuffer

    last = steps[-1]
    seen = [*(step.seen for step in steps), last.after]
    told = [*(step.known for step in steps), last.told]
    observations = {name: np.array([each[name] for each in seen]) for name in last.after}
    infos = {name: np.array([each[name] for each in told]) for name in _INFOS}
    actions, rewards, truncated = (
        np.array([getattr(step, name) for step in steps])
        for name in ("action", "reward", "truncated")
    )
    lengths = np.sum([step.running for step in steps], axis=0)
    for row, length in enumerate(lengths[:count].tolist()):
        yield EpisodeBuffer(
            seed=first_seed + row,
            observations={name: all_[: length + 1, row] for name, all_ in observations.items()},
            actions=actions[:length, row],
            rewards=rewards[:length, row],
            terminations=np.zeros(length, dtype=np.bool_),
            truncations=truncated[:length, row],
            infos={name: all_[: length + 1, row] for name, all_ in infos.items()},
        )


# -- files ----------------------------------------------------------------------------------------


def _require_free(dataset: Dataset) -> None:
    """Refuse a folder that exists, unless it holds a dataset of tpm_gym that may be replaced."""
    if not dataset.folder.exists():
        provenance.require_writable("--out", dataset.folder)
        return
    if not dataset.config.overwrite:
        raise ConfigError(f"{dataset.folder} is there already; give --overwrite, or another --out")
    try:
        ours = _OURS in provenance.read_json(dataset.folder / _DATA / _METADATA)
    except (OSError, ValueError):
        ours = False
    if not ours:
        raise ConfigError(
            f"{dataset.folder} holds no dataset of tpm-gym collect, and is not replaced; give "
            "another --out"
        )


def _write(dataset: Dataset, scores: tuple[float, float], console: Console) -> str:
    """Write a dataset under a temporary name and move it; return its digest."""
    from minari.dataset.minari_storage import MinariStorage

    spec = _stored(dataset.env, dataset.config.env_options)
    with closing(gym.make(spec)) as env:
        spaces = env.observation_space, env.action_space
    # Minari cannot write to a relative path.
    with tempfile.TemporaryDirectory(prefix=".", dir=dataset.root.absolute()) as part:
        data = Path(part, _DATA)
        storage = MinariStorage.new(data, *spaces, env_spec=spec)
        with bar(console, dataset.kind, dataset.config.episodes) as advance:
            storage.update_episodes(_episodes(dataset, advance))
        found = digest(data)
        storage.update_metadata(_metadata(dataset, scores, found))
        there = dataset.folder / _DATA
        there.mkdir(parents=True, exist_ok=True)
        for file in data.iterdir():  # one by one: the folder may hold files that are not ours
            file.replace(there / file.name)
    return found


def _metadata(dataset: Dataset, scores: tuple[float, float], found: str) -> dict[str, Any]:
    config = dataset.config
    about = {
        "expert": "The scripted expert.",
        "noisy": f"The scripted expert with normal noise of {config.noise:g} on its actions.",
        "random": "Uniform random actions.",
        "replay": "A policy at ten moments of its training, with its exploration.",
    }
    return {
        "dataset_id": dataset.name,
        "algorithm_name": dataset.kind,
        "author": {"The tpm_gym developers"},
        "description": about[dataset.kind],
        "minari_version": provenance.version("minari"),
        "requirements": [f"tpm-gym=={tpm_gym.__version__}"],
        "ref_min_score": scores[0],
        "ref_max_score": scores[1],
        "num_episodes_average_score": REFERENCE,
        _OURS: {"sha256": found, "seed": config.seed, **provenance.origin()},
    }


def digest(data: Path, episodes: int | None = None) -> str:
    """Return the SHA-256 of the arrays and seeds of a dataset.

    Args:
        data: Folder ``data`` of the dataset.
        episodes: Number of episodes to include, starting with the first; None for all.
    """
    from minari.dataset.minari_storage import MinariStorage

    storage, total = MinariStorage.read(data), hashlib.sha256()
    chosen = range(storage.total_episodes if episodes is None else episodes)
    pairs = zip(storage.get_episodes(chosen), storage.get_episode_metadata(chosen), strict=True)
    for episode, known in pairs:
        total.update(f"{known['seed']}".encode())
        del episode["id"]
        _update(total, episode)
    return total.hexdigest()


def _update(total: Any, arrays: Mapping[str, Any]) -> None:
    """Add arrays to a digest; mappings may be nested."""
    for name, value in sorted(arrays.items()):
        total.update(name.encode())
        if isinstance(value, Mapping):
            _update(total, value)
        else:
            array: NDArray[Any] = np.ascontiguousarray(value)
            total.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
