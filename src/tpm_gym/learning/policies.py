"""Policies by name: the scripted expert, uniform random actions, or a trained policy on file.

An exported policy is plain data and loads safely. An archive of Stable-Baselines3 (.zip) holds
pickles, which can run any code when they are loaded, and needs ``trust_pickle``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

import tpm_gym
from tpm_gym import TPMError
from tpm_gym.learning.algorithms import ALGORITHMS, NAMES
from tpm_gym.learning.errors import PolicyError
from tpm_gym.learning.provenance import read_json
from tpm_gym.learning.rollout import Action, Observation, Policy
from tpm_gym.learning.run_folder import BEST_FILE, CONFIG_FILE, EXPORTED, LAST_FILE
from tpm_gym.resources import POLICIES
from tpm_gym.tasks.expert import Expert

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from tpm_gym.envs.vector import TPMVectorEnv
    from tpm_gym.policy import Policy as ExportedPolicy

SCRIPTED: Final = ("expert", "random")


@dataclass(frozen=True)
class TrainedPolicy:
    """Policy that acts with the mean action of a trained algorithm."""

    model: BaseAlgorithm | ExportedPolicy

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Do nothing: the policy has no memory."""

    def act(self, observation: Observation) -> Action:
        """Return the deterministic actions for ``observation``."""
        action, _ = self.model.predict(observation, deterministic=True)
        return action


@dataclass
class RandomPolicy:
    """Policy that draws uniform actions, with a generator of its own for each episode."""

    space: Any
    rngs: list[np.random.Generator] = field(default_factory=list)

    def reset(self, observation: Observation, seeds: Sequence[int]) -> None:
        """Seed a generator for each episode with the episode's seed."""
        self.rngs = [np.random.default_rng(seed) for seed in seeds]

    def act(self, observation: Observation) -> Action:
        """Return actions that do not depend on ``observation``."""
        drawn = np.array([rng.uniform(self.space.low, self.space.high) for rng in self.rngs])
        return drawn.astype(self.space.dtype)


class ExpertPolicy(Expert):
    """Policy that acts with the scripted controller, which is deterministic."""

    def reset(self, observation: Observation, seeds: Sequence[int] = ()) -> None:
        """Plan the motion of the episodes."""
        super().reset(observation)


def load_policy(spec: str, envs: TPMVectorEnv, *, trust_pickle: bool = False) -> Policy:
    """Return a policy that acts in ``envs``.

    Args:
        spec: ``expert``, ``random``, an exported policy (either of its files, or their common
            name), the id of a published one, a .zip file of a training, or the folder of a run (its
            best policy).
        trust_pickle: Whether a .zip file may be loaded.

    Raises:
        PolicyError: There is no such policy, its files are damaged, it does not fit ``envs``, or it
            is a .zip file and ``trust_pickle`` is not set.
    """
    if spec == "random":
        return RandomPolicy(envs.single_action_space)
    if spec == "expert":
        return ExpertPolicy(envs)
    path = _policy_file(spec)
    import torch  # here, so that scripted policies need no PyTorch

    torch.set_num_threads(1)  # the networks are small, and one thread repeats exactly
    if path.suffix not in EXPORTED:
        require_trust(spec, path, trust_pickle)
        model = load_model(spec, path)
        for kind in ("observation", "action"):
            trained, given = getattr(model, f"{kind}_space"), getattr(envs, f"single_{kind}_space")
            if trained != given:
                problem = f"was trained with {kind} space {trained}, the environment has {given}"
                raise refused(spec, problem)
        return TrainedPolicy(model)
    try:
        policy = tpm_gym.load_policy(path)
        policy.check(envs)
    except TPMError as error:
        raise refused(spec, str(error)) from error
    return TrainedPolicy(policy)


def trained_in(spec: str) -> tuple[str, dict[str, str]] | None:
    """Return the environment id and its options that a policy was trained with, if any.

    Nothing is unpickled.
    """
    if spec in SCRIPTED:
        return None
    path = _policy_file(spec)
    if path.suffix not in EXPORTED:
        config = run_config(spec, path)
        return config["env"], config["env_options"]
    from tpm_gym.policy.files import read_description

    try:
        description = read_description(path)
    except TPMError as error:
        raise refused(spec, str(error)) from error
    return description.env_id, {str(k): value for k, value in description.env_options.items()}


def refused(spec: str, problem: str) -> PolicyError:
    """Return an error about a policy."""
    return PolicyError(f"policy {spec!r}: {problem}")


def require_trust(spec: str, path: Path, trusted: bool) -> None:
    """Refuse, with a PolicyError, a .zip file that the user does not trust."""
    if not trusted:
        raise refused(
            spec,
            f"{path} holds pickles, and loading it can run any code; if you trust where it comes "
            "from, give --trust-pickle, or convert it once: "
            f"tpm-gym export {path} {path.with_suffix('')} --trust-pickle",
        )


def _policy_file(spec: str) -> Path:
    path = Path(spec)
    if path.is_dir():
        saved = [path / BEST_FILE, path / LAST_FILE]
        candidates = [*(file.with_suffix(".json") for file in saved), *saved]
    elif path.suffix in (".zip", *EXPORTED):
        candidates = [path]
    else:
        candidates = [*(Path(spec + suffix) for suffix in EXPORTED), POLICIES / f"{spec}.json"]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise refused(
        spec,
        f"no file {' or '.join(map(str, candidates))}; expected {', '.join(SCRIPTED)}, an exported "
        "policy (.json), the id of a published one, a .zip of a training, or the folder of a run",
    )


def run_config(spec: str, path: Path) -> dict[str, Any]:
    """Return the run's configuration, from beside or above a .zip file."""
    wanted = {"algo": str, "env": str, "seed": int, "recipe": dict, "env_options": dict}
    files = [folder / CONFIG_FILE for folder in path.resolve().parents[:2]]
    file = next(filter(Path.is_file, files), None)
    if file is None:
        problem = (
            f"no {CONFIG_FILE} beside {path.name} or above it; keep the file in its run folder"
        )
        raise refused(spec, problem)
    try:
        content: dict[str, Any] = dict(read_json(file))
        wrong = [key for key, kind in wanted.items() if not isinstance(content.get(key), kind)]
    except (OSError, ValueError, TypeError) as error:
        raise refused(spec, f"{file} is damaged: {error}") from error
    if wrong:
        raise refused(spec, f"{file} is damaged: no entry {wrong[0]!r}")
    return content


def load_model(spec: str, path: Path) -> BaseAlgorithm:
    """Unpickle a saved algorithm for acting only; see :func:`require_trust`."""
    config = run_config(spec, path)
    algorithm = config["algo"]
    if algorithm not in ALGORITHMS:
        raise refused(spec, f"algorithm {algorithm!r} is none of {NAMES}")
    # Acting needs no replay buffer, and a hindsight buffer would need an environment.
    unused: dict[str, Any] = {
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
        "buffer_size": 1,
    }
    try:
        kind = ALGORITHMS[algorithm].load_class()
        return kind.load(path, device="cpu", custom_objects=unused)
    except Exception as error:  # a damaged archive or pickle can raise anything
        raise refused(spec, f"cannot be loaded as {algorithm}: {error}") from error
