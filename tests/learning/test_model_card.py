"""Model cards say what the files say, and the Hub's own library reads them."""

import json
import re
from pathlib import Path

import gymnasium as gym
import pytest
from huggingface_hub import ModelCard
from paths import ROOT

from tpm_gym.learning.command_line import main
from tpm_gym.policy.files import digest

POLICIES = ROOT / "train" / "policies"
NAME = "TPMReach-v0"
RESULTS, OTHER = (POLICIES / f"{name}.evaluation.json" for name in (NAME, "TPMPickAndPlace-v0"))


def export(out: Path, evaluation: Path) -> None:
    main(["export", str(POLICIES / f"{NAME}.json"), str(out), "--evaluation", str(evaluation)])


@pytest.mark.usefixtures("needs_pybullet")
def test_a_published_policy_gets_a_card_whose_lines_run(tmp_path, monkeypatch):
    export(tmp_path / "reach", RESULTS)
    for suffix in (".json", ".safetensors"):
        copied = (tmp_path / f"reach{suffix}").read_bytes()
        assert copied == (POLICIES / f"{NAME}{suffix}").read_bytes()
    card = ModelCard.load(tmp_path / "reach.md")
    (result,) = card.data.eval_results
    success = json.loads(RESULTS.read_text())["success_at_end"]
    assert (result.dataset_name, result.metric_value) == (NAME, success["mean"])
    (script,) = re.findall(r"```python\n(.*?)```", card.text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(script, {})


def test_the_lines_of_a_card_make_the_environment_of_the_training(tmp_path):
    content = json.loads((POLICIES / f"{NAME}.json").read_text())
    content["env_options"] = {"machine": "wide", "engine": "analytic", "shield": True}
    (tmp_path / "own.json").write_text(json.dumps({**content, "sha256": digest(content)}))
    weights = (POLICIES / f"{NAME}.safetensors").read_bytes()
    (tmp_path / "own.safetensors").write_bytes(weights)
    words = [str(tmp_path / "own.json"), str(tmp_path / "reach"), "--evaluation", str(RESULTS)]
    main(["export", *words])
    (made,) = re.findall(r"gym\.make\(.*\)", (tmp_path / "reach.md").read_text())
    spec = eval(made, {"gym": gym}).spec
    assert spec.kwargs.items() >= content["env_options"].items()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[", "Expecting value"),
        ("{}", "is no result of"),
        (json.dumps(json.loads(RESULTS.read_text()) | {"return": "good"}), "is no result of"),
        (OTHER.read_text(), "the policy is of TPMReach-v0"),
        (json.dumps(json.loads(RESULTS.read_text()) | {"policy": "expert"}), "is of the expert"),
    ],
    ids=["damaged", "empty", "text", "another", "expert"],
)
def test_results_of_something_else_are_rejected(content, message, tmp_path):
    evaluation = tmp_path / "evaluation.json"
    evaluation.write_text(content)
    with pytest.raises(SystemExit, match=message):
        export(tmp_path / "reach", evaluation)
    assert list(tmp_path.iterdir()) == [evaluation]


def test_a_card_replaces_no_file_of_others(tmp_path):
    card = tmp_path / "reach.md"
    card.write_text("my notes")
    with pytest.raises(SystemExit, match="no model card of tpm_gym"):
        export(tmp_path / "reach", RESULTS)
    assert card.read_text() == "my notes"
    assert list(tmp_path.iterdir()) == [card]
    card.unlink()
    card.mkdir()
    with pytest.raises(SystemExit, match="no model card of tpm_gym"):
        export(tmp_path / "reach", RESULTS)
    card.rmdir()
    for _ in range(2):  # an earlier card is replaced
        export(tmp_path / "reach", RESULTS)
    assert "library_name: tpm_gym" in card.read_text()
