"""Tests of an engine are skipped where its package is not installed."""

from collections.abc import Generator

import pytest

from tpm_gym.errors import MissingPackageError


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, None, None]:
    """Skip a test that asked for PyBullet where PyBullet has no wheel."""
    try:
        return (yield)
    except MissingPackageError as error:
        if error.package == "pybullet":
            pytest.skip(str(error))
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Generator[None, None, None]:
    """Skip a test whose fixture asked for it."""
    try:
        return (yield)
    except MissingPackageError as error:
        if error.package == "pybullet":
            pytest.skip(str(error))
        raise
