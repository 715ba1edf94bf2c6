"""MuJoCo as an engine; the only package that imports it."""

try:
    import mujoco as mujoco
except ModuleNotFoundError as error:
    from tpm_gym.errors import MissingPackageError

    raise MissingPackageError("mujoco", "mujoco") from error
