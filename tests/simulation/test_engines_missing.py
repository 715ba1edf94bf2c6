"""Without PyBullet: the default says what to do, the other engines work and draw."""

import subprocess
import sys
from textwrap import dedent

HIDDEN = """
    import sys
    sys.modules["pybullet"] = None
    import gymnasium as gym
    import tpm_gym
"""


def run(code: str) -> str:
    """Run code in a process that cannot import PyBullet; return what it prints."""
    script = dedent(HIDDEN) + dedent(code)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_default_engine_says_what_to_install_and_others_work_without():
    said, imported = run(
        """
        try:
            gym.make("TPMReach-v0")
        except tpm_gym.errors.MissingPackageError as error:
            print(error)
        for engine in ("mujoco", "analytic"):
            env = gym.make("TPMPickAndPlace-v0", engine=engine)
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()
        print(sys.modules["pybullet"])
        """
    ).splitlines()
    assert "pip install 'tpm-gym[pybullet]'" in said
    assert "engine='mujoco' or engine='analytic'" in said
    assert imported == "None"
