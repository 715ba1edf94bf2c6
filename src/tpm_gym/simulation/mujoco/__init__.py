"""Engine that uses MuJoCo."""

from tpm_gym.errors import MissingPackageError

try:
    import mujoco as mujoco
except ModuleNotFoundError as error:
    raise MissingPackageError("mujoco", "mujoco") from error
