"""Model cards of exported policies, for the Hugging Face Hub."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tpm_gym.learning import provenance
from tpm_gym.learning.errors import ConfigError

_OURS = "library_name: tpm_gym"
_WAY = "`tpm-gym evaluate --policy POLICY --json FILE`, with one policy"
_ROWS = {
    "success_at_end": "success at the end",
    "return": "return",
    "unsafe_share": "fraction of the time below safe conditioning",
    "torque_rms": "torque, RMS, N m",
}


def write(policy: Path, evaluation: Path) -> Path:
    """Write the model card of a policy beside its files; return the path of the card.

    Args:
        policy: JSON file of an exported policy.
        evaluation: JSON file of ``tpm-gym evaluate --json`` with one policy.

    Raises:
        ConfigError: ``evaluation`` is no such file, or belongs to another id, or the card would
            replace a file of others.
    """
    content = provenance.read_json(policy)
    tested = _read(evaluation)
    if tested["env"] != content["env"]:
        raise ConfigError(
            f"--evaluation {evaluation}: is of {tested['env']}, the policy is of {content['env']}"
        )
    card = policy.with_suffix(".md")
    if card.is_dir() or (
        card.exists() and _OURS not in card.read_text(encoding="utf-8", errors="replace")
    ):
        raise ConfigError(f"{card}: is no model card of tpm_gym, and would be replaced; move it")
    try:
        text = _text(card.stem, content, tested)
    except (TypeError, KeyError, ValueError, AttributeError) as error:  # values of other types
        raise ConfigError(f"--evaluation {evaluation}: is no result of {_WAY}") from error
    provenance.write_whole(card, lambda part: part.write_text(text, encoding="utf-8"))
    return card


def _read(evaluation: Path) -> dict[str, Any]:
    try:
        tested: Any = provenance.read_json(evaluation)
        needed = {"env", "episodes", "seed", "command", "versions", *_ROWS}
        if isinstance(tested, dict) and needed <= tested.keys():
            return tested
    except (OSError, ValueError) as error:
        raise ConfigError(f"--evaluation {evaluation}: {error}") from error
    raise ConfigError(f"--evaluation {evaluation}: is no result of {_WAY}")


def _text(name: str, content: Mapping[str, Any], tested: Mapping[str, Any]) -> str:
    success = tested["success_at_end"]
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    metric = {"type": "success_rate", "value": success["mean"], "name": "success at the end"}
    result = {
        "task": task,
        "dataset": {"name": content["env"], "type": content["env"]},
        "metrics": [metric],
    }
    front = {
        "library_name": "tpm_gym",
        "license": "mit",
        "tags": ["reinforcement-learning", "gymnasium", "parallel-robot", content["algorithm"]],
        "model-index": [{"name": name, "results": [result]}],
    }
    rows = (
        f"| {label} | " + " | ".join(f"{tested[key][end]:.4g}" for end in ("mean", "low", "high"))
        for key, label in _ROWS.items()
    )
    options = content.get("env_options", {})
    template = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return template.format(
        front=yaml.safe_dump(front, sort_keys=False),
        algorithm=content["algorithm"].upper(),
        env=content["env"],
        steps=content["steps"],
        seed=content["seed"],
        hidden=" and ".join(str(width) for width in content["network"]["hidden"]),
        options="".join(f", {key}={json.dumps(value)}" for key, value in options.items()),
        name=name,
        episodes=tested["episodes"],
        first=tested["seed"],
        rows=" |\n".join(rows) + " |",
        command=tested["command"],
        versions=", ".join(f"{key} {value}" for key, value in tested["versions"].items()),
    )
