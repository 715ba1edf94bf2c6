"""Files of a trained policy: their content, and reading them without unpickling.

``NAME.json`` describes the policy: its network, spaces, environment, recipe and versions.
``NAME.safetensors`` holds the weights. Both are plain data of a limited size; nothing in them is
executed or unpickled. The JSON contains SHA-256 sums. They reveal a damaged file, and also
two files that do not belong together. A forged file with new sums can make a policy act badly, but
cannot run code.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tpm_gym.errors import InputError, MissingPackageError, PolicyFileError
from tpm_gym.resources import POLICIES

try:
    import safetensors.numpy
    from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
except ImportError as error:
    raise MissingPackageError(str(error.name), "policy") from error

FORMAT: Final = "tpm_gym.policy"
VERSION: Final = 1

MAX_JSON, MAX_WEIGHTS = 1 << 20, 64 << 20  # largest sizes of the two files, bytes
_GOALS: Final = ("achieved_goal", "desired_goal")
_Name = Annotated[str, Field(pattern="^[ -~]{1,100}$")]  # printable
_Count = Annotated[int, Field(ge=0)]
_Size = Annotated[int, Field(ge=1)]
_Bound = Annotated[float, Field(ge=-1e30, le=1e30)]


class _Entries(BaseModel):
    """Base class of JSON objects; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(_Entries):
    """Bounded space of arrays; ``low`` and ``high`` are flat, in row-major order."""

    shape: tuple[_Size, ...]
    dtype: Literal["float32", "float64"]
    low: tuple[_Bound, ...]
    high: tuple[_Bound, ...]

    @model_validator(mode="after")
    def _consistent(self) -> Box:
        if (self.space.low > self.space.high).any():
            raise ValueError("low must be nowhere above high")
        return self

    @property
    def space(self) -> spaces.Box[Any]:
        """Space for Gymnasium."""
        dtype = np.dtype(self.dtype).type
        low, high = (np.array(flat, dtype).reshape(self.shape) for flat in (self.low, self.high))
        return spaces.Box(low, high, dtype=dtype)


class Features(_Entries):
    """Input of the first layer.

    ``concatenate`` joins the entries of the observation in the order of ``keys``. ``goal_gap``
    joins ``observation`` and ``(desired_goal - achieved_goal) / unit``, with ``unit`` in metres.
    """

    kind: Literal["concatenate", "goal_gap"]
    keys: tuple[_Name, ...] = ("observation", *_GOALS)
    unit: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0


class Network(_Entries):
    """Layers from an observation to the mean action.

    The activation follows each hidden layer. The output of the last layer goes through tanh and is
    scaled to the action space, or is clipped to it.
    """

    features: Features
    hidden: tuple[_Size, ...]
    activation: Literal["relu", "tanh"]
    output: Literal["tanh", "clip"]


class Weights(_Entries):
    """Size (bytes) and SHA-256 of the file of weights."""

    bytes: Annotated[int, Field(ge=0, le=MAX_WEIGHTS)]
    sha256: str


class Description(_Entries):
    """Everything about a policy except its weights.

    ``env_options`` are machine, engine, drive and shield of the training; those left out are the
    defaults of the environment id. ``seed`` is None if it is not known. A version is None if the
    package was not installed.
    """

    format: Literal["tpm_gym.policy"]
    version: Literal[1]
    env_id: _Name = Field(alias="env")
    env_options: dict[Literal["machine", "engine", "drive", "shield"], _Name | bool | float] = {}
    algorithm: _Name
    seed: _Count | None
    steps: _Count
    recipe: dict[_Name, Any]
    versions: dict[_Name, _Name | None]
    network: Network
    observations: Annotated[dict[_Name, Box], Field(min_length=1, alias="observation_space")]
    actions: Box = Field(alias="action_space")
    weights: Weights
    sha256: str

    @model_validator(mode="after")
    def _consistent(self) -> Description:
        boxes, features = self.observations, self.network.features
        if sorted(features.keys) != sorted(boxes):
            raise ValueError("observation_space must hold exactly the keys of the features")
        if features.kind == "goal_gap":
            if set(boxes) != {"observation", *_GOALS}:
                raise ValueError("goal_gap needs an observation and two goals")
            if len({boxes[key].shape for key in _GOALS}) > 1:
                raise ValueError("the goals in observation_space must be of one shape")
        return self

    @cached_property
    def observation_space(self) -> spaces.Dict:
        """Space of the observations."""
        return spaces.Dict({key: box.space for key, box in self.observations.items()})

    @cached_property
    def action_space(self) -> spaces.Box[Any]:
        """Space of the actions."""
        return self.actions.space

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights by name; a layer maps x to ``weight @ x + bias``."""
        lengths = {key: len(box.low) for key, box in self.observations.items()}
        if self.network.features.kind == "goal_gap":
            del lengths["achieved_goal"]  # only in the gap, which has the size of the desired goal
        sizes = [sum(lengths.values()), *self.network.hidden, len(self.actions.low)]
        found: dict[str, tuple[int, ...]] = {}
        for i, (before, after) in enumerate(itertools.pairwise(sizes)):
            found |= {f"layers.{i}.weight": (after, before), f"layers.{i}.bias": (after,)}
        return found


def files(path: str | Path) -> tuple[Path, Path]:
    """Return the paths of the JSON file and the file of weights of a policy.

    ``path`` is one of the two paths, or their common part without the suffix.
    """
    if not isinstance(path, str | Path) or not str(path):
        raise InputError("path", path, "the str or Path of a policy, as in 'runs/reach/best.json'")
    path = Path(path)
    if path.suffix == ".zip":
        raise PolicyFileError(
            str(path),
            "is an archive of Stable-Baselines3, which holds pickles: loading it can run any code",
            "if you trust it, convert it once: tpm-gym export MODEL.zip OUT --trust-pickle, with "
            "--env ID unless it is in the folder of a run",
        )
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    return Path(f"{stem}.json"), Path(f"{stem}.safetensors")


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256, in hex, of a policy's JSON without the entry ``sha256``.

    The order of the entries does not matter.
    """
    entries = {name: value for name, value in content.items() if name != "sha256"}
    text = json.dumps(entries, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def read_description(path: str | Path) -> Description:
    """Read the JSON file of a policy; refuse a damaged file. ``path`` is as in :func:`files`."""
    file, _ = files(path)
    data = _read(file, MAX_JSON)
    try:
        content = json.loads(data)
        description = Description.model_validate(content)
        if description.sha256 != digest(content):
            raise ValueError("its SHA-256 does not match its entries: damaged, or edited by hand")
    except ValidationError as error:
        first = error.errors()[0]
        raise _refused(file, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    except (ValueError, RecursionError) as error:
        raise _refused(file, str(error)) from error
    return description


def read_weights(path: str | Path, description: Description) -> dict[str, NDArray[np.float32]]:
    """Read the weights of a policy, by name. ``path`` is as in :func:`files`.

    The file is refused if it is not the one that ``description`` names by its SHA-256, if the
    shapes are not ``description.shapes``, or if a weight is not a finite float32.
    """
    _, file = files(path)
    data = _read(file, description.weights.bytes)
    if hashlib.sha256(data).hexdigest() != description.weights.sha256:
        size = f"{len(data)} of {description.weights.bytes} bytes"
        raise _refused(file, f"its SHA-256 is not that in the JSON file ({size})")
    try:
        weights = {name: np.array(v) for name, v in safetensors.numpy.load(data).items()}
    except (safetensors.SafetensorError, KeyError) as error:  # KeyError: a dtype numpy lacks
        raise _refused(file, str(error)) from error
    if {name: values.shape for name, values in weights.items()} != description.shapes:
        raise _refused(file, "its tensors are not those of the network")
    if any(v.dtype != np.float32 or not np.isfinite(v).all() for v in weights.values()):
        raise _refused(file, "a weight is not a finite float32")
    return weights


def published() -> list[str]:
    """Return the ids of the environments with a published policy."""
    return sorted(file.stem for file in POLICIES.glob("*.safetensors"))


def _refused(file: Path, cause: str) -> PolicyFileError:
    """Return the error for a file that is not a valid policy file.

    The text ``cause`` is cut and made printable, because it may quote the file.
    """
    reason = f"is not a policy file: {cause[:200].encode('unicode_escape').decode()}"
    remedy = "get an intact copy of both files, export the policy again, or update tpm_gym"
    return PolicyFileError(str(file), reason, remedy)


def _read(file: Path, limit: int) -> bytes:
    """Return the content of a file that is not larger than ``limit`` bytes."""
    try:
        if not file.is_file():  # reading a pipe would never end
            remedy = f"name a file, or a published policy: {', '.join(published())}"
            raise PolicyFileError(str(file), "there is no such file", remedy)
        if (size := file.stat().st_size) > limit:
            raise _refused(file, f"it has {size} bytes, at most {limit} are valid")
        return file.read_bytes()
    except OSError as error:
        reason = f"cannot be read: {error.strerror}"
        raise PolicyFileError(str(file), reason, "check its name and permissions") from error
