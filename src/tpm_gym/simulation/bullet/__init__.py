"""PyBullet as an engine; the only package that imports it."""

from tpm_gym.errors import MissingPackageError

try:
    import pybullet as pybullet
except ModuleNotFoundError as error:
    hint = (
        " (compiled for some minutes, except for Linux x86-64 with Python 3.10 and 3.11), or ask "
        "for engine='mujoco' or engine='analytic'"
    )
    raise MissingPackageError("pybullet", "pybullet", hint) from error
