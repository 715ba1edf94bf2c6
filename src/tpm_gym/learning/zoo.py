r"""Recipes for rl-baselines3-zoo.

    python -m rl_zoo3.train --algo sac --env TPMReach-v0 \
        --gym-packages tpm_gym --conf-file tpm_gym.learning.zoo

The zoo imports this module and reads ``hyperparams``: the recipes of the algorithm that the zoo's
option ``--algo`` names.
"""

import argparse
import sys
from typing import Any

from tpm_gym.learning.recipes import read_recipes, recipe_file, with_classes


def hyperparameters(algorithm: str) -> dict[str, dict[str, Any]]:
    """Return the recipes of one algorithm by environment id, in the zoo's form."""
    found = {}
    for env_id, entries in read_recipes(recipe_file(algorithm), algorithm).items():
        found[env_id] = with_classes(entries)
        if arguments := found[env_id].pop("demonstrations", None):
            callback = "tpm_gym.learning.demonstrations.Demonstrations"
            found[env_id]["callback"] = [{callback: dict(arguments)}]
    return found


_parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
_parser.add_argument("--algo", default="ppo")  # the zoo's default
hyperparams = hyperparameters(_parser.parse_known_args(sys.argv)[0].algo)
