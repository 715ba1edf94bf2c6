"""Export of a trained policy as safetensors and JSON. Loading these files runs no code."""

import io
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from safetensors.numpy import save as safetensors_bytes
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor
from torch import nn
from typing_extensions import NotRequired, TypedDict

from tpm_gym import TPMError, load_policy
from tpm_gym.learning import model_card, provenance
from tpm_gym.learning.algorithms import ALGORITHMS, NAMES, Actor
from tpm_gym.learning.configuration import UNSET, EnvOptions
from tpm_gym.learning.environments import (
    check_env_id,
    conditions_set_by,
    import_module_of,
    make_env,
)
from tpm_gym.learning.errors import ConfigError, PolicyError
from tpm_gym.learning.features import GoalGapExtractor
from tpm_gym.learning.policies import exported_in, refused
from tpm_gym.learning.run_folder import CONFIG_FILE, description
from tpm_gym.policy.files import FORMAT, VERSION, digest, files

TOLERANCE: Final = 1e-4
"""Largest error of an exported action, relative to the larger of 1 and half the action's range.

Single precision rounds the actions of networks with large weights by 1e-5. Wrong weights or a wrong
activation cause far larger errors.
"""
_NORMALISER: Final = "vecnormalize.pkl"  # name that rl-baselines3-zoo gives it
_TRIALS: Final = 64
_ACTIVATIONS: Final = {nn.ReLU: "relu", nn.Tanh: "tanh"}


class _Origin(TypedDict):
    """Entries of a run's configuration that are part of an exported policy."""

    env: str
    algo: str
    seed: int
    recipe: dict[str, Any]
    env_options: dict[str, Any]
    id_options: NotRequired[dict[str, Any]]
    versions: dict[str, Any]


def save_policy(
    model: BaseAlgorithm,
    path: str | Path,
    *,
    env_id: str,
    env_options: EnvOptions | None = None,
) -> Path:
    """Write the policy of a model as safetensors and JSON; return the path of the JSON file.

    :func:`tpm_gym.load_policy` and ``tpm-gym evaluate --policy`` read these files. The model can
    come from ``tpm-gym train`` or from a program of your own that uses Stable-Baselines3.

    Args:
        model: SAC, TQC or PPO with a MultiInputPolicy.
        path: Path of the files without their endings. An earlier policy is replaced.
        env_id: Id of the environment of the training.
        env_options: Machine, engine, drive and shield of the training, if they differ from the
            defaults of ``env_id``.

    Raises:
        PolicyError: The model has other spaces than the environment, the files cannot hold the
            policy, or they would replace files that are no policy.
        ConfigError: There is no such environment, or ``path`` ends in .zip.
    """
    path, options = Path(path), (env_options or EnvOptions()).given()
    check_env_id(env_id)
    with closing(make_env(env_id, **options)) as env:
        for kind in ("observation_space", "action_space"):
            trained, there = getattr(model, kind), getattr(env, kind)
            if trained != there:
                problem = (
                    f"the model has the {kind.replace('_', ' ')} {trained}, {env_id} has {there}"
                )
                raise refused(str(path), f"{problem}; give the environment id of its training")
    return save(model, path, env_id=env_id, seed=model.seed, recipe={}, env_options=options)


def save(
    model: BaseAlgorithm,
    path: Path,
    *,
    env_id: str,
    seed: int | None,
    recipe: Mapping[str, Any],
    env_options: Mapping[str, Any] | None = None,
    versions: Mapping[str, str | None] | None = None,
) -> Path:
    """Write the policy of a model; return the path of the JSON file.

    The files are ``path``.safetensors and ``path``.json. They get these names only after a check
    that the written policy acts like the model. A policy that the files cannot express is refused,
    not changed.

    Args:
        model: SAC, TQC or PPO with a MultiInputPolicy.
        path: Path of the files without their endings. An earlier policy is replaced.
        env_options: Machine, engine, drive and shield of the training. For options that are left
            out, the values that the registration of ``env_id`` sets are written.
        versions: Versions at training; by default the installed ones.

    Raises:
        PolicyError: The files cannot hold the policy, or would replace files that are no policy.
        ConfigError: ``path`` ends in .zip.
    """
    _require_free(path)
    try:
        known = (name for name, row in ALGORITHMS.items() if type(model) is row.load_class())
        if (algorithm := next(known, None)) is None:
            raise PolicyError(f"{type(model).__name__} is none of {NAMES}")
        if not isinstance(model.observation_space, spaces.Dict):
            raise PolicyError(f"observations in {model.observation_space}, not in a Dict")
        network, weights = _network(model, ALGORITHMS[algorithm].actor)
        data = safetensors_bytes(weights)
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "env": env_id,
            "env_options": {**conditions_set_by(env_id), **(env_options or {})},
            "algorithm": algorithm,
            "seed": seed,
            "steps": model.num_timesteps,
            "recipe": dict(recipe),
            "versions": dict(provenance.versions() if versions is None else versions),
            "network": network,
            "action_space": _box(model.action_space),
            "observation_space": {k: _box(box) for k, box in model.observation_space.items()},
            "weights": {"bytes": len(data), "sha256": sha256(data).hexdigest()},
        }
        content["sha256"] = digest(content)
        return _write(path, content, data, model)
    except TPMError as error:
        raise refused(str(path), f"cannot be exported: {error}") from error


def save_archive(model: BaseAlgorithm, path: Path) -> None:
    """Save a model as an archive of Stable-Baselines3; no reader sees an incomplete file."""
    file = io.BytesIO()  # PyTorch itself, writing to a full disk, would hide the error
    model.save(file)
    provenance.write_whole(path, lambda part: part.write_bytes(file.getvalue()))


def remove(path: Path) -> None:
    """Delete the files that :func:`save` wrote as ``path``; leave files that are no policy."""
    json_file, weights_file = files(path)
    if _is_policy(json_file):
        weights_file.unlink(missing_ok=True)
        json_file.unlink()  # last, since it shows that both files are ours


def _is_policy(json_file: Path) -> bool:
    """Return whether a file is the JSON of a policy, whole or damaged."""
    try:
        content = provenance.read_json(json_file)
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT


def _require_free(path: Path) -> None:
    """Raise an error if ``path`` ends in .zip, or if its files exist and are no exported policy."""
    if path.suffix == ".zip":
        raise ConfigError(f"OUT {path}: is a name for a .json and a .safetensors, not for a .zip")
    pair = files(path)
    taken = [str(file) for file in pair if os.path.lexists(file)]
    if taken and not _is_policy(pair[0]):
        raise refused(
            taken[0], "is no policy of tpm_gym, and would be replaced; choose another name"
        )


def convert(
    archive: Path,
    path: Path,
    *,
    trust_pickle: bool,
    env_id: str = UNSET,
    env_options: EnvOptions | None = None,
    evaluation: Path | None = None,
) -> Path:
    """Export a model of Stable-Baselines3, or copy an exported policy; return the JSON file.

    Args:
        archive: Model (.zip), exported policy (.json), or folder of a run (its best policy).
        path: Path of the new files without their endings.
        trust_pickle: Whether a .zip may be loaded, which can run any code.
        env_id: Environment id of the training, required for a .zip outside the folder of a run. For
            other archives, ``env_id`` and ``env_options`` are refused.
        env_options: Machine, engine, drive and shield of the training.
        evaluation: File with results for a model card. It is checked before anything is written.
    """
    if archive.is_dir():
        found = [file for file in exported_in(archive) if file.is_file()]
        if not found:
            missing = " or ".join(file.name for file in exported_in(archive))
            raise ConfigError(f"MODEL {archive}: holds no {missing}; give the .zip of a model")
        archive = found[0]
    if not archive.is_file():
        valid = "the folder of a run, an exported policy (.json), or a .zip of Stable-Baselines3"
        raise ConfigError(f"MODEL {archive}: no such file; give {valid}")
    _require_free(path)
    provenance.require_writable("OUT", path)
    name, options = str(archive), env_options or EnvOptions()
    origins = (description(folder) for folder in archive.resolve().parents[:2])
    config = next(filter(None, origins), None)
    if archive.suffix == ".json" or config is not None:
        for option, value in {"env": env_id, **options.given()}.items():
            if value is not UNSET:
                there = "is for a .zip outside the folder of a run; leave it out"
                raise ConfigError(f"--{option} {value}: {there}")
    if archive.suffix == ".json":
        _check_card(path, load_policy(archive).description.env_id, evaluation)
        for old, new in zip(files(archive), files(path), strict=True):
            provenance.write_whole(new, partial(shutil.copyfile, old))
        return files(path)[0]
    if not trust_pickle:
        raise refused(
            name,
            "holds pickles, and loading it can run any code; if you trust its origin, give "
            "--trust-pickle",
        )
    if config is None:
        if env_id is UNSET:
            where = f"no {CONFIG_FILE} of a training beside it or above it"
            way = "give the environment of its training with --env ID"
            raise refused(name, f"{where} says where it was trained; {way}")
        import_module_of(env_id)
        check_env_id(env_id)
        for folder in (archive.parent, archive.parent / env_id):
            if (folder / _NORMALISER).exists():
                problem = f"normalised observations (VecNormalize), as {folder / _NORMALISER} says"
                raise refused(name, f"cannot be exported: {problem}")
        _check_card(path, env_id, evaluation)
        return save_policy(_load_any(archive), path, env_id=env_id, env_options=options)
    try:
        TypeAdapter(_Origin).validate_python(config, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        way = "keep the file in an intact run folder"
        raise refused(name, f"{CONFIG_FILE} of its run is damaged: {problem}; {way}") from error
    _check_card(path, config["env"], evaluation)
    about = {key: config[key] for key in ("seed", "recipe")}
    # The id may not be registered here.
    about["env_options"] = {**config.get("id_options", {}), **config["env_options"]}
    model = load_model(archive, config["algo"])
    return save(model, path, env_id=config["env"], versions=config["versions"], **about)


def _check_card(path: Path, env_id: str, evaluation: Path | None) -> None:
    if evaluation is not None:
        model_card.check(files(path)[0].with_suffix(".md"), env_id, evaluation)


def load_model(archive: Path, algorithm: str) -> BaseAlgorithm:
    """Unpickle a saved algorithm for acting only; this can run any code."""
    if algorithm not in ALGORITHMS:
        raise refused(str(archive), f"algorithm {algorithm!r} is none of {NAMES}")
    # Acting needs no replay buffer, and a hindsight buffer would need an environment.
    unused: dict[str, Any] = {
        "replay_buffer_class": None,
        "replay_buffer_kwargs": {},
        "buffer_size": 1,
    }
    try:
        kind = ALGORITHMS[algorithm].load_class()
        return kind.load(archive, device="cpu", custom_objects=unused)
    except Exception as error:  # a damaged archive or pickle can raise anything
        raise refused(str(archive), f"cannot be loaded as {algorithm}: {error}") from error


def _load_any(archive: Path) -> BaseAlgorithm:
    """Unpickle a model whose algorithm is not known; this can run any code.

    An archive does not name its algorithm, and Stable-Baselines3 loads A2C as PPO, and TQC as SAC.
    The names of the hyperparameters tell them apart.
    """
    try:
        with zipfile.ZipFile(archive) as file:
            saved = set(json.loads(file.read("data")))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
        raise refused(str(archive), f"is no archive of Stable-Baselines3: {error}") from error
    own = {name: row.hyperparameters() for name, row in ALGORITHMS.items()}
    if not (fitting := [name for name in own if own[name] <= saved]):
        raise refused(str(archive), f"is of an algorithm that is none of {NAMES}")
    return load_model(archive, max(fitting, key=lambda name: len(own[name])))


def _network(
    model: BaseAlgorithm, actor: Actor
) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
    """Return the description and the weights of the layers that compute the mean action."""
    if getattr(model, "use_sde", False):
        raise PolicyError("state-dependent exploration (use_sde)")
    if model.get_vec_normalize_env() is not None:
        raise PolicyError("normalised observations (VecNormalize)")
    part = model.policy.get_submodule
    hidden: Any = part(actor.hidden)
    modules = [*hidden, part(actor.last)]  # linear, activation, linear, ..., linear
    linear: Any = modules[::2]
    kinds = {_ACTIVATIONS.get(type(module)) for module in modules[1::2]} or {"relu"}
    if {type(module) for module in linear} != {nn.Linear} or len(kinds) > 1 or None in kinds:
        raise PolicyError(f"only linear layers with ReLU or Tanh can be: {modules}")
    weights = {
        f"layers.{i}.{tensor}": values.detach().cpu().numpy().astype(np.float32)
        for i, module in enumerate(linear)
        for tensor, values in module.named_parameters()
    }
    if not all(np.isfinite(values).all() for values in weights.values()):
        raise PolicyError("its weights are not finite: the training diverged")
    description = {
        "features": _features(part(actor.features)),
        "hidden": [module.out_features for module in linear[:-1]],
        "activation": kinds.pop(),
        "output": actor.output,
    }
    return description, weights


def _features(extractor: nn.Module) -> dict[str, Any]:
    """Describe the input of the first layer."""
    if type(extractor) is GoalGapExtractor:
        return {"kind": "goal_gap", "unit": extractor.unit}
    if type(extractor) is CombinedExtractor:
        return {"kind": "concatenate", "keys": list(extractor.extractors)}
    raise PolicyError(f"features of {type(extractor).__name__}")


def _box(space: spaces.Space[Any]) -> dict[str, Any]:
    if not isinstance(space, spaces.Box) or not space.is_bounded() or space.dtype.kind != "f":
        raise PolicyError(f"{space} is no bounded Box of floats")
    return {
        "shape": list(space.shape),
        "dtype": space.dtype.name,
        "low": space.low.ravel().tolist(),
        "high": space.high.ravel().tolist(),
    }


def _write(path: Path, content: Mapping[str, Any], data: bytes, model: BaseAlgorithm) -> Path:
    """Write both files to a temporary folder, verify them, and move them to their place."""
    json_file, weights_file = files(path)
    json_file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=json_file.parent, prefix=".export-") as folder:
        new_json, new_weights = files(Path(folder, "policy"))
        provenance.write_json(new_json, content)
        new_weights.write_bytes(data)
        _verify(model, new_json)
        # Between the two renames, a reader sees from the checksums that the files do not match.
        # After a kill there, the JSON file allows the next export to replace both.
        new_json.replace(json_file)
        new_weights.replace(weights_file)
    return json_file


def _verify(model: BaseAlgorithm, written: Path) -> None:
    """Compare the actions of the written policy and of the model."""
    rng = np.random.default_rng(0)
    boxes: Any = model.observation_space
    space: Any = model.action_space
    shapes = {key: (_TRIALS, *box.shape) for key, box in boxes.items()}
    # Observations are below 1 m, and few are above 1 m/s. With larger ones, and the large weights
    # of a long training, NumPy and PyTorch would round differently by as much as the tolerance.
    batch = {
        k: rng.uniform(np.maximum(b.low, -1.0), np.minimum(b.high, 1.0), shapes[k]).astype(b.dtype)
        for k, b in boxes.items()
    }
    training = model.policy.training
    expected, _ = model.predict(batch, deterministic=True)  # switches the training mode off
    model.policy.set_training_mode(training)
    scale = np.maximum(1.0, (space.high - space.low) / 2)
    off = float(np.max(np.abs(load_policy(written).act(batch) - expected) / scale))
    if not off <= TOLERANCE:
        raise PolicyError(f"its actions would be off by {off:.2g}")
