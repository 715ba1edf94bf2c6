"""Engines that can draw on this computer."""

import pytest
from drawing import ENGINES, drawn

from tpm_gym.errors import ConfigurationError


@pytest.fixture(params=ENGINES)
def engine(request):
    """Name of an engine that can draw here."""
    name: str = request.param
    if name != "analytic":
        pytest.importorskip(name)
    try:
        drawn(name, width=16, height=16)
    except ConfigurationError:
        pytest.skip("needs OpenGL")
    return name
