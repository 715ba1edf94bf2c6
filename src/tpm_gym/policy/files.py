"""Files of a trained policy: their content, and how they are read without trust.

``NAME.json`` describes the policy: its network, spaces, environment, recipe and versions.
``NAME.safetensors`` holds the weights. Both are plain data. Nothing in them is executed or
unpickled, and files beyond a fixed size are not read.

The JSON holds the SHA-256 of the weights and of its own entries, which shows damage and files that
do not belong together. An attacker can write new sums for new content. Such a policy can act badly,
but it cannot run code.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import operator
import os
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
    import safetensors
    from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, model_validator
except ImportError as error:
    raise MissingPackageError(str(error.name), "policy") from error

FORMAT: Final = "tpm_gym.policy"
VERSION: Final = 1

# Largest sizes in bytes: the JSON file, the weights, and the header of their file
MAX_JSON, MAX_WEIGHTS, MAX_HEADER = 1 << 20, 64 << 20, 16 << 10
MAX_UNITS: Final = 4096  # of a layer; also the largest size of an observation or action
_GOAL_KEYS: Final = ("observation", "achieved_goal", "desired_goal")
_Key = Annotated[str, Field(pattern="^[A-Za-z0-9_]{1,100}$")]
_Package = Annotated[str, Field(pattern="^[A-Za-z0-9_.-]{1,100}$")]
_Version = Annotated[str, Field(pattern="^[ -~]{1,100}$")]
_Count = Annotated[int, Field(ge=0, le=2**63)]
_Size = Annotated[int, Field(ge=1, le=MAX_UNITS)]
_Bound = Annotated[float, Field(ge=-1e30, le=1e30)]
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
# Not strict, since JSON has lists for tuples
_Bounds = Annotated[tuple[_Bound, ...], Strict(False), Field(max_length=MAX_UNITS)]


class _Entries(BaseModel):
    """Object with exactly these keys and types; true is no integer."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


class Box(_Entries):
    """Bounded space of arrays; ``low`` and ``high`` are flat, by rows."""

    shape: Annotated[tuple[_Size, ...], Strict(False), Field(max_length=4)]
    dtype: Literal["float32", "float64"]
    low: _Bounds
    high: _Bounds

    @model_validator(mode="after")
    def _consistent(self) -> Box:
        if not len(self.low) == len(self.high) == math.prod(self.shape):
            raise ValueError("low and high must be of the size that shape has")
        if any(map(operator.gt, self.low, self.high)):
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

    ``concatenate``: the entries of the observation in the order of ``keys``. ``goal_gap``:
    ``observation`` and (``desired_goal`` - ``achieved_goal``) / ``unit``, with ``unit`` in m.
    """

    kind: Literal["concatenate", "goal_gap"]
    keys: Annotated[tuple[_Key, ...], Strict(False), Field(max_length=16)] = _GOAL_KEYS
    unit: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0

    @model_validator(mode="after")
    def _consistent(self) -> Features:
        wanted = "keys" if self.kind == "concatenate" else "unit"
        if self.model_fields_set != {"kind", wanted}:
            raise ValueError(f"must hold kind and {wanted} where kind is {self.kind!r}")
        return self


class Network(_Entries):
    """Layers from an observation to the mean action.

    The activation follows each hidden layer. The output of the last layer goes through tanh and is
    scaled to the action space, or is clipped to it.
    """

    features: Features
    hidden: Annotated[tuple[_Size, ...], Strict(False), Field(max_length=20)]
    activation: Literal["relu", "tanh"]
    output: Literal["tanh", "clip"]


class Weights(_Entries):
    """Size and sum of the file of weights."""

    bytes: Annotated[int, Field(ge=0, le=MAX_WEIGHTS)]
    sha256: _Sha256


class Description(_Entries):
    """Everything about a policy except its weights.

    ``env_options`` are machine, engine and drive of the training, where they differ from the id's.
    ``steps`` counts environment steps of the training. ``seed`` is None if it is not known, a
    version if the package was not installed.
    """

    format: Literal["tpm_gym.policy"]
    version: int = Field(ge=VERSION, le=VERSION)  # a Literal would take true for 1
    env_id: str = Field(alias="env", pattern="^[A-Za-z0-9_.:/-]{1,100}$")
    env_options: dict[Literal["machine", "engine", "drive"], _Version] = {}
    algorithm: _Key
    seed: _Count | None
    steps: _Count
    recipe: Annotated[dict[_Key, Any], Field(max_length=64)]
    versions: Annotated[dict[_Package, _Version | None], Field(max_length=64)]
    network: Network
    observations: Annotated[
        dict[_Key, Box], Field(min_length=1, max_length=16, alias="observation_space")
    ]
    actions: Box = Field(alias="action_space")
    weights: Weights
    sha256: _Sha256

    @model_validator(mode="after")
    def _consistent(self) -> Description:
        boxes, features = self.observations, self.network.features
        if sorted(features.keys) != sorted(boxes):
            raise ValueError(f"observation_space must hold exactly {_shown(features.keys)}")
        if features.kind == "goal_gap" and len({boxes[key].shape for key in _GOAL_KEYS[1:]}) > 1:
            raise ValueError("the goals in observation_space must be of one shape")
        needed = 4 * sum(math.prod(shape) for shape in self.shapes.values())
        if not needed <= self.weights.bytes <= needed + MAX_HEADER:
            raise ValueError(f"weights.bytes must be from {needed} to {needed + MAX_HEADER}")
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
        """Shapes of the weights by name; a layer maps x to weight x + bias."""
        gap = self.network.features.kind == "goal_gap"
        # The achieved goal is only in the gap, which has the size of the desired goal.
        seen = (key for key in self.observations if not (gap and key == "achieved_goal"))
        inputs = sum(len(self.observations[key].low) for key in seen)
        sizes = [inputs, *self.network.hidden, len(self.actions.low)]
        found: dict[str, tuple[int, ...]] = {}
        for i, (before, after) in enumerate(itertools.pairwise(sizes)):
            found |= {f"layers.{i}.weight": (after, before), f"layers.{i}.bias": (after,)}
        return found


def files(path: str | Path) -> tuple[Path, Path]:
    """Return the JSON file and the file of weights; ``path`` is either, or their common name."""
    if not isinstance(path, str | Path) or not str(path):
        given = path if path == "" else type(path)
        raise InputError("path", given, "the str or Path of a policy, as in 'runs/reach/best.json'")
    path = Path(path)
    if path.suffix == ".zip":
        raise PolicyFileError(
            str(path),
            "is an archive of Stable-Baselines3, which holds pickles: loading it can run any code",
            "if you trust it, convert it once: tpm-gym export MODEL.zip OUT --trust-pickle",
        )
    if os.path.isdir(path):  # path.is_dir() raises if a name is too long
        raise PolicyFileError(str(path), "is a folder", "name a policy in it, as in FOLDER/best")
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    return Path(f"{stem}.json"), Path(f"{stem}.safetensors")


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256, in hex, of all entries but ``sha256``; their layout does not matter."""
    entries = {name: value for name, value in content.items() if name != "sha256"}
    text = json.dumps(entries, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def read_description(path: str | Path) -> Description:
    """Read the JSON file of a policy, named as for :func:`files`; refuse a damaged one."""
    file, _ = files(path)
    data = _read(file, MAX_JSON)
    try:
        content = json.loads(data.decode("utf-8"))
        description = Description.model_validate(content)
        intact = description.sha256 == digest(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place, given = ".".join(map(str, first["loc"])) or "(all)", first["input"]
        # A deeply nested value cannot be printed.
        value = "" if isinstance(given, dict | list) else f", not {_shown(given)}"
        reason = f"describes no policy: entry {_shown(place)}: {first['msg']}{value}"
        raise _damaged(file, reason) from error
    except (ValueError, RecursionError) as error:
        raise _damaged(file, f"is no valid JSON ({error})") from error
    if not intact:
        raise _damaged(file, "its SHA-256 does not match its entries: damaged, or edited by hand")
    return description


def read_weights(path: str | Path, description: Description) -> dict[str, NDArray[np.float32]]:
    """Read finite weights by name, of the shapes in ``description.shapes``; refuse others."""
    _, file = files(path)
    data = _read(file, description.weights.bytes)
    if hashlib.sha256(data).hexdigest() != description.weights.sha256:
        size = f"{len(data)} of {description.weights.bytes} bytes"
        problem = f"it belongs to another policy, or is damaged: {size}"
        raise _damaged(file, f"its SHA-256 is not that in the JSON file; {problem}")
    try:
        tensors = dict(safetensors.deserialize(data))  # type: ignore[no-untyped-call]
    except safetensors.SafetensorError as error:
        raise _damaged(file, f"is no safetensors file: {_shown(str(error))}") from error
    forms = {name: (tensor["dtype"], tuple(tensor["shape"])) for name, tensor in tensors.items()}
    wanted = {name: ("F32", shape) for name, shape in description.shapes.items()}
    for name in sorted({*forms, *wanted}):
        if (form := forms.get(name)) != (fit := wanted.get(name)):
            raise _damaged(file, f"tensor {_shown(name)} is {_shown(form)}, not {_shown(fit)}")
    weights = {
        name: np.frombuffer(tensors[name]["data"], "<f4").reshape(shape).astype(np.float32)
        for name, shape in description.shapes.items()
    }
    if not all(np.isfinite(values).all() for values in weights.values()):
        raise _damaged(file, "has a weight that is not finite")
    return weights


def published() -> list[str]:
    """Return the ids of the environments with a published policy."""
    return sorted(file.stem for file in POLICIES.glob("*.safetensors"))


def _damaged(file: Path, reason: str) -> PolicyFileError:
    remedy = "get an intact copy of both files, export the policy again, or update tpm_gym"
    return PolicyFileError(str(file), reason, remedy)


def _read(file: Path, limit: int) -> bytes:
    """Return the content of a file that is not larger than ``limit`` bytes."""
    try:
        if not file.is_file():  # reading a pipe would never end
            remedy = f"name a file, or a published policy: {', '.join(published())}"
            raise PolicyFileError(str(file), "there is no such file", remedy)
        with file.open("rb") as stream:
            if (size := os.fstat(stream.fileno()).st_size) > limit:
                raise _damaged(file, f"is too large: {size} bytes, at most {limit} are valid")
            return stream.read(size)
    except OSError as error:
        reason = f"cannot be read: {error.strerror}"
        raise PolicyFileError(str(file), reason, "check its name and permissions") from error


def _shown(value: object) -> str:
    """Return a value for a message: short, and without control characters."""
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
