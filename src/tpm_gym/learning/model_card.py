"""Model cards of exported policies, for the Hugging Face Hub."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tpm_gym.learning import provenance
from tpm_gym.learning.errors import ConfigError
from tpm_gym.learning.policies import SCRIPTED

_OURS = "library_name: tpm_gym"
_WAY = "`tpm-gym evaluate --policy POLICY --json FILE`, with one policy"
_ROWS = {
    "success_at_end": "success at the end",
    "return": "return",
    "unsafe_share": "fraction of steps with unsafe conditioning",
    "torque_rms": "torque, RMS, N m",
}


def write(policy: Path, evaluation: Path) -> Path:
    """Write the model card of a policy beside its files; return the path of the card.

    Args:
        policy: JSON file of an exported policy.
        evaluation: JSON file of ``tpm-gym evaluate --json`` with one policy.

    Raises:
        ConfigError: As :func:`check`.
    """
    content = provenance.read_json(policy)
    card = policy.with_suffix(".md")
    text = _text(card.stem, content, check(card, content["env"], evaluation))
    provenance.write_whole(card, lambda part: part.write_text(text, encoding="utf-8"))
    return card


def check(card: Path, env_id: str, evaluation: Path) -> dict[str, Any]:
    """Return the results in a file of ``tpm-gym evaluate --json`` as entries of the card.

    Raises:
        ConfigError: ``evaluation`` is no such file, its environment is not ``env_id``, or ``card``
            exists and is no model card of tpm_gym.
    """
    if card.is_dir() or (
        card.exists() and _OURS not in card.read_text(encoding="utf-8", errors="replace")
    ):
        raise ConfigError(f"{card}: is no model card of tpm_gym, and would be replaced; move it")
    try:
        tested = provenance.read_json(evaluation)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--evaluation {evaluation}: {error}") from error
    ends = ("mean", "low", "high")
    try:
        env = tested["env"]
        found = {
            "success": tested["success_at_end"]["mean"],
            "episodes": f"{tested['episodes']:,}",
            "first": tested["seed"],
            "rows": "\n".join(
                f"| {label} | " + "".join(f"{tested[key][end]:.4g} | " for end in ends).rstrip()
                for key, label in _ROWS.items()
            ),
            "command": tested["command"],
            "versions": ", ".join(f"{key} {value}" for key, value in tested["versions"].items()),
        }
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise ConfigError(f"--evaluation {evaluation}: is no result of {_WAY}") from error
    if (policy := tested.get("policy")) in SCRIPTED:
        raise ConfigError(f"--evaluation {evaluation}: is of the {policy} policy; give {_WAY}")
    if env != env_id:
        raise ConfigError(f"--evaluation {evaluation}: is of {env}, the policy is of {env_id}")
    return found


def _text(name: str, content: Mapping[str, Any], tested: Mapping[str, Any]) -> str:
    metric = {"type": "success_rate", "value": tested["success"], "name": "success at the end"}
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": content["env"], "type": content["env"]},
        "metrics": [metric],
    }
    front = {
        "library_name": "tpm_gym",
        "license": "mit",
        "tags": ["reinforcement-learning", "gymnasium", "parallel-robot", content["algorithm"]],
        "model-index": [{"name": name, "results": [result]}],
    }
    options = content.get("env_options", {})
    template = Path(__file__).with_suffix(".md").read_text(encoding="utf-8")
    return template.format(
        front=yaml.safe_dump(front, sort_keys=False),
        algorithm=content["algorithm"].upper(),
        env=content["env"],
        steps=content["steps"],
        seed=content["seed"],
        hidden=" and ".join(str(width) for width in content["network"]["hidden"]),
        options="".join(
            f", {key}={json.dumps(value) if isinstance(value, str) else value}"
            for key, value in options.items()
        ),
        name=name,
        **tested,
    )
