"""Engine that uses PyBullet. No other package imports pybullet."""

from tpm_gym.errors import MissingPackageError
from tpm_gym.simulation.bullet.silence import silence

try:
    with silence(2):  # PyBullet prints the time of its compilation
        import pybullet as pybullet
except ModuleNotFoundError as error:
    hint = (
        " (pip compiles it for minutes, except on Linux x86-64 with Python 3.10 or 3.11), or use "
        "engine='mujoco' or engine='analytic'"
    )
    raise MissingPackageError("pybullet", "pybullet", hint) from error
