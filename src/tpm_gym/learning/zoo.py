"""Recipes for rl-baselines3-zoo.

    python -m rl_zoo3.train --algo sac --env TPMReach-v0 \
        --gym-packages tpm_gym --conf-file tpm_gym.learning.zoo

The zoo imports this module and reads ``hyperparams``. A recipe file is for one algorithm, which is
read from the zoo's command line.
"""

import argparse
import sys
from typing import Any

from tpm_gym.learning.recipes import read_recipes, recipe_file, with_classes


def hyperparameters(algorithm: str) -> dict[str, dict[str, Any]]:
    """Return the recipes of one algorithm by environment id, in the zoo's form."""
    recipes = read_recipes(recipe_file(algorithm), algorithm)
    return {env_id: _translate(entries) for env_id, entries in recipes.items()}


def _translate(entries: dict[str, Any]) -> dict[str, Any]:
    """Replace names by classes, and demonstrations by a callback."""
    translated = with_classes(entries)
    if "demonstrations" in translated:
        arguments = translated.pop("demonstrations")
        callback = "tpm_gym.learning.demonstrations.Demonstrations"
        translated["callback"] = [{callback: dict(arguments)}]
    return translated


def _algorithm(command_line: list[str]) -> str:
    """Return the value of ``--algo``, or the zoo's default."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--algo", default="ppo")
    return str(parser.parse_known_args(command_line)[0].algo)


hyperparams = hyperparameters(_algorithm(sys.argv))
