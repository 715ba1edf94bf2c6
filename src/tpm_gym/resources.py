"""Folders of the package's data: robot descriptions, recipes, trained policies.

In a wheel, they are in ``tpm_gym/data``. In a checkout, they are in ``urdf`` and ``train``.
"""

from pathlib import Path
from typing import Final

_PACKAGED: Final = Path(__file__).parent / "data"
_CHECKOUT: Final = Path(__file__).parents[2]


def _folder(name: str, in_checkout: str) -> Path:
    packaged = _PACKAGED / name
    return packaged if packaged.is_dir() else _CHECKOUT / in_checkout


URDF: Final = _folder("urdf", "urdf")
RECIPES: Final = _folder("recipes", "train/recipes")
POLICIES: Final = _folder("policies", "train/policies")
