"""Tests of an engine are skipped where its package is not installed."""

import os
from importlib.util import find_spec

# The suite has a process per core, so that the threads of a library would wait for each other.
# PyTorch and NumPy read this once, when they are imported; tests' own processes inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import pytest
from registries import registries_put_back

from tpm_gym.errors import MissingPackageError

# How long an example takes depends on what else the machine does.
hypothesis.settings.register_profile("tpm_gym", deadline=None)
hypothesis.settings.load_profile("tpm_gym")

# These import PyBullet at their top.
collect_ignore_glob = (
    [] if find_spec("pybullet") else ["simulation/bullet/*", "benchmarks/test_variants.py"]
)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """Skip a test that asks for PyBullet where PyBullet has no wheel."""
    try:
        return (yield)
    except MissingPackageError as error:
        if error.package == "pybullet":
            pytest.skip(str(error))
        raise


pytest_runtest_setup = pytest_runtest_call  # fixtures may ask for PyBullet too


@pytest.fixture(scope="session")
def needs_pybullet():
    """Skip a test that uses PyBullet in another process."""
    pytest.importorskip("pybullet")


@pytest.fixture
def registries():
    """Forget after a test what it registers."""
    with registries_put_back():
        yield
