"""Engine that uses PyBullet. No other package imports pybullet."""

from tpm_gym.errors import MissingPackageError

try:
    import pybullet as pybullet
except ModuleNotFoundError as error:
    hint = (
        " (pip compiles it for minutes, except on Linux x86-64 with Python 3.10 or 3.11), or use "
        "engine='mujoco' or engine='analytic'"
    )
    raise MissingPackageError("pybullet", "pybullet", hint) from error
