"""A trained policy on disk: what its two files hold, and how they are read without trusting them.

``NAME.json`` says what the policy is: its network, spaces, environment and recipe, the versions it
was trained with. ``NAME.safetensors`` holds the weights. Both are plain data: nothing in them is
ever executed or unpickled, and nothing is allocated before its size has been checked.

The JSON carries the SHA-256 of the weights and of its own entries. That detects damage and mix-ups
of files. It does not detect an author of ill will, who can write new sums for new contents: such a
policy can act badly, but it cannot run code.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tpm_gym.errors import MissingPackageError, PolicyFileError
from tpm_gym.policy.strict_json import Entry, EntryError, parse, shown

__all__ = [
    "FORMAT",
    "VERSION",
    "Description",
    "Network",
    "digest",
    "files",
    "read_description",
    "read_weights",
]

FORMAT: Final = "tpm_gym.policy"
VERSION: Final = 1

MAX_JSON: Final = 1 << 20
"""Size of the JSON file at most, bytes."""
MAX_WEIGHTS: Final = 64 << 20
"""Size of the weights at most, bytes."""
MAX_HEADER: Final = 16 << 10
"""What the safetensors file may hold besides the weights at most, bytes."""
MAX_LAYERS: Final = 20
MAX_UNITS: Final = 4096
"""Hidden layers, and units of each, or entries of an observation or action, at most."""

_DAMAGED: Final = "get an intact copy of both files, or export the policy again"
_LARGEST: Final = 1e30  # far from where float32 overflows
_GOAL_KEYS: Final = ("observation", "achieved_goal", "desired_goal")


@dataclass(frozen=True)
class Network:
    """The layers from an observation to the mean action.

    Attributes:
        features: What the first layer sees: ``"concatenate"``, all entries of the observation, or
            ``"goal_gap"``, ``observation`` and (``desired_goal`` - ``achieved_goal``) / unit.
        keys: The entries in the order in which they are joined.
        unit: The gap to the goal that becomes 1, m; 1 where no gap is taken.
        hidden: Units of the hidden layers.
        activation: What follows each hidden layer: ``"relu"`` or ``"tanh"``.
        output: What follows the last layer: ``"tanh"``, then stretched to the action space, or
            ``"clip"``, cut off at its bounds.
    """

    features: str
    keys: tuple[str, ...]
    unit: float
    hidden: tuple[int, ...]
    activation: str
    output: str


@dataclass(frozen=True)
class Description:
    """Everything about a policy but its weights.

    Attributes:
        env_id: The environment it was trained on.
        algorithm: ``"sac"``, ``"tqc"`` or ``"ppo"``.
        seed: Seed of the training; None where it is not known.
        steps: Environment steps it was trained for.
        recipe: The hyperparameters.
        versions: Versions it was trained with, by package; None where one was absent.
        observation_space: The observations it takes.
        action_space: The actions it gives.
        network: Its network.
        weights_size: Size of the file of weights, bytes.
        weights_sha256: SHA-256 of the file of weights.
    """

    env_id: str
    algorithm: str
    seed: int | None
    steps: int
    recipe: Mapping[str, Any]
    versions: Mapping[str, str | None]
    observation_space: spaces.Dict
    action_space: spaces.Box[Any]
    network: Network
    weights_size: int
    weights_sha256: str

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights by name; each layer maps x to weight x + bias."""
        boxes = self.observation_space
        inputs = sum(
            math.prod(boxes[key].shape or ())
            for key in self.network.keys
            # The achieved goal only shows in the gap, which has the size of the desired goal.
            if not (self.network.features == "goal_gap" and key == "achieved_goal")
        )
        sizes = [inputs, *self.network.hidden, math.prod(self.action_space.shape)]
        found: dict[str, tuple[int, ...]] = {}
        for i, (before, after) in enumerate(itertools.pairwise(sizes)):
            found[f"layers.{i}.weight"] = (after, before)
            found[f"layers.{i}.bias"] = (after,)
        return found


def files(path: str | Path) -> tuple[Path, Path]:
    """The JSON file and the file of weights that a path names.

    Args:
        path: Either of the two, or what they have in common.

    Raises:
        PolicyFileError: It names a folder, or an archive of Stable-Baselines3.
    """
    path = Path(path)
    if path.suffix == ".zip":
        raise PolicyFileError(
            str(path),
            "is an archive of Stable-Baselines3, which holds pickles: loading it can run any code",
            "if you trust it, convert it once: python train/export.py MODEL.zip OUT --trust-pickle",
        )
    if path.is_dir():
        raise PolicyFileError(str(path), "is a folder", "name a policy in it, as in FOLDER/best")
    stem = path.with_suffix("") if path.suffix in (".json", ".safetensors") else path
    return Path(f"{stem}.json"), Path(f"{stem}.safetensors")


def digest(content: Mapping[str, Any]) -> str:
    """SHA-256, in hex, of the entries of a JSON file but ``sha256`` itself, however laid out."""
    entries = {name: value for name, value in content.items() if name != "sha256"}
    text = json.dumps(entries, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def read_description(path: str | Path) -> Description:
    """Read and check the JSON file of a policy.

    Args:
        path: Either of the policy's files, or what they have in common.

    Raises:
        PolicyFileError: The file is missing, damaged, or an entry cannot be.
    """
    file, _ = files(path)
    text = _read(file, MAX_JSON)
    try:
        content = parse(text)
    except ValueError as error:
        raise PolicyFileError(str(file), f"is no valid JSON ({error})", _DAMAGED) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        remedy = "name the .json that train/export.py wrote"
        raise PolicyFileError(str(file), f"does not describe a policy ({FORMAT!r})", remedy)
    version = content.get("version")
    if type(version) is not int or version != VERSION:
        reason = f"has format version {shown(version)}, this tpm_gym reads version {VERSION}"
        raise PolicyFileError(str(file), reason, "use the tpm_gym that wrote it, or a newer one")
    if content.get("sha256") != digest(content):
        reason = "its SHA-256 does not match its entries: it was damaged, or edited by hand"
        raise PolicyFileError(str(file), reason, _DAMAGED)
    try:
        return _description(Entry("", content))
    except EntryError as error:
        raise PolicyFileError(str(file), str(error), _DAMAGED) from error


def read_weights(path: str | Path, description: Description) -> dict[str, NDArray[np.float32]]:
    """Read and check the weights of a policy.

    Args:
        path: Either of the policy's files, or what they have in common.
        description: What its JSON file says.

    Returns:
        The weights by name, as ``description.shapes`` has them; all finite.

    Raises:
        PolicyFileError: The file is missing, damaged, or does not fit the description.
        MissingPackageError: safetensors is not installed.
    """
    try:
        import safetensors
    except ImportError as error:
        raise MissingPackageError("safetensors", "policy") from error
    _, file = files(path)
    data = _read(file, description.weights_size)
    if len(data) < description.weights_size:
        reason = f"is cut off: {len(data)} bytes of {description.weights_size}"
        raise PolicyFileError(str(file), reason, _DAMAGED)
    if hashlib.sha256(data).hexdigest() != description.weights_sha256:
        reason = "its SHA-256 is not the one in the JSON file: damaged, or of another policy"
        raise PolicyFileError(str(file), reason, _DAMAGED)
    try:
        tensors = dict(safetensors.deserialize(data))  # type: ignore[no-untyped-call]
    except safetensors.SafetensorError as error:
        reason = f"is no safetensors file: {shown(str(error))}"
        raise PolicyFileError(str(file), reason, _DAMAGED) from error
    forms = {name: (tensor["dtype"], tuple(tensor["shape"])) for name, tensor in tensors.items()}
    wanted = {name: ("F32", shape) for name, shape in description.shapes.items()}
    if forms != wanted:
        odd = sorted(name for name in {*forms, *wanted} if forms.get(name) != wanted.get(name))[0]
        reason = f"tensor {shown(odd)} is {shown(forms.get(odd))}, not {shown(wanted.get(odd))}"
        raise PolicyFileError(str(file), reason, _DAMAGED)
    weights = {}
    for name, tensor in tensors.items():
        values = np.frombuffer(tensor["data"], dtype="<f4").reshape(wanted[name][1])
        if not np.isfinite(values).all():
            raise PolicyFileError(str(file), f"tensor {name!r} is not finite", _DAMAGED)
        weights[name] = values.astype(np.float32)
    return weights


def _read(file: Path, limit: int) -> bytes:
    """Return the content of a file, after a look at its size."""
    try:
        if not file.is_file():  # a pipe, for one, would never end
            reason = "is not a file" if file.exists() else "there is no such file"
            raise PolicyFileError(str(file), reason, "check the name")
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size > limit:
                reason = f"is too large: {size} bytes, at most {limit} can belong to the policy"
                raise PolicyFileError(str(file), reason, _DAMAGED)
            return stream.read(size)
    except OSError as error:
        reason = f"cannot be read: {error.strerror}"
        raise PolicyFileError(str(file), reason, "check its permissions") from error


def _description(whole: Entry) -> Description:
    """Check every entry of the JSON file."""
    entries = whole.record(
        *("format", "version", "algorithm", "env", "seed", "steps", "recipe", "versions"),
        *("observation_space", "action_space", "network", "weights", "sha256"),
    )
    recipe = entries["recipe"].members(r"\w{1,100}", most=64)
    versions = entries["versions"].members(r"[\w.-]{1,100}", most=64)
    boxes = entries["observation_space"].members(r"\w{1,100}", most=16)
    observation: dict[str, spaces.Space[Any]] = {name: _box(e) for name, e in boxes.items()}
    weights = entries["weights"].record("bytes", "sha256")
    seed = entries["seed"]
    description = Description(
        env_id=entries["env"].text(r"[\w.:/-]{1,100}"),
        algorithm=entries["algorithm"].choice("sac", "tqc", "ppo"),
        seed=None if seed.value is None else seed.integer(0, 2**63),
        steps=entries["steps"].integer(0, 2**63),
        recipe={name: entry.value for name, entry in recipe.items()},
        versions={
            name: None if entry.value is None else entry.text("[ -~]{1,100}")
            for name, entry in versions.items()
        },
        observation_space=spaces.Dict(observation),
        action_space=_box(entries["action_space"]),
        network=_network(entries["network"], observation),
        weights_size=weights["bytes"].integer(0, MAX_WEIGHTS + MAX_HEADER),
        weights_sha256=weights["sha256"].text("[0-9a-f]{64}"),
    )
    needed = 4 * sum(math.prod(shape) for shape in description.shapes.values())
    if needed > MAX_WEIGHTS:
        raise entries["network"].wrong(f"a network of at most {MAX_WEIGHTS} bytes")
    weights["bytes"].integer(needed, needed + MAX_HEADER)
    return description


def _network(entry: Entry, observation: Mapping[str, spaces.Space[Any]]) -> Network:
    """Check the network against the observations it sees."""
    entries = entry.record("features", "hidden", "activation", "output")
    features = entries["features"]
    kind = features.members(r"\w*", most=8).get("kind", features).choice("concatenate", "goal_gap")
    if kind == "concatenate":
        joined = features.record("kind", "keys")["keys"]
        keys, unit = tuple(key.text(r"\w{1,100}") for key in joined.items(16)), 1.0
        if sorted(keys) != sorted(observation):
            raise joined.wrong(f"all keys of the observation, {', '.join(observation)}")
    else:
        keys = _GOAL_KEYS
        unit = features.record("kind", "unit")["unit"].number(1e-6, 1e6)
        goals = [observation[key].shape for key in keys[1:] if key in observation]
        if set(keys) != set(observation) or goals[0] != goals[1]:
            raise features.wrong(f"of a kind that suits the observation {shown(observation)}")
    return Network(
        features=kind,
        keys=keys,
        unit=unit,
        hidden=tuple(e.integer(1, MAX_UNITS) for e in entries["hidden"].items(MAX_LAYERS)),
        activation=entries["activation"].choice("relu", "tanh"),
        output=entries["output"].choice("tanh", "clip"),
    )


def _box(entry: Entry) -> spaces.Box[Any]:
    """Check a space of arrays."""
    entries = entry.record("shape", "dtype", "low", "high")
    shape = tuple(e.integer(1, MAX_UNITS) for e in entries["shape"].items(4))
    size = math.prod(shape)
    if size > MAX_UNITS:
        raise entries["shape"].wrong(f"of at most {MAX_UNITS} entries in all")
    dtype = np.dtype(entries["dtype"].choice("float32", "float64")).type
    bounds: dict[str, NDArray[Any]] = {}
    for name in ("low", "high"):
        values = [e.number(-_LARGEST, _LARGEST) for e in entries[name].items(size)]
        if len(values) != size:
            raise entries[name].wrong(f"a list of {size} numbers")
        bounds[name] = np.array(values, dtype).reshape(shape)
    if (bounds["low"] > bounds["high"]).any():
        raise entries["low"].wrong("nowhere above high")
    return spaces.Box(bounds["low"], bounds["high"], dtype=dtype)
