"""Screw theory, as a check of POC sets: spaces of twists (linear and angular velocity)."""

import numpy as np

from tpm_gym.analysis.poc import Chain
from tpm_gym.arrays import FloatArray


def twists(chain: Chain, base_point: FloatArray) -> FloatArray:
    """Return the twists (n, 6) of all joints of a chain."""
    rows = []
    for unit in chain.units:
        rows += [np.concatenate([t, np.zeros(3)]) for t in unit.translations]
        rows += [np.concatenate([np.cross(s, base_point - unit.point), s]) for s in unit.rotations]
    return np.array(rows)


def projector(rows: FloatArray) -> FloatArray:
    """Return the projection (n, n) onto the span of rows (k, n)."""
    _, values, right = np.linalg.svd(rows)
    basis = right[: int((values > 1e-9).sum())]
    return np.asarray(basis.T @ basis)


def common(*projectors: FloatArray) -> FloatArray:
    """Return the projection (6, 6) onto the twists that all projections keep."""
    eye = np.eye(6)
    return np.asarray(eye - projector(np.concatenate([eye - p for p in projectors])))
