"""Both modes meet on the computed surface, and the numbers of docs/operation-modes.md hold."""

import numpy as np
import oracle
import pytest
from figures.modes import transition
from paths import ROOT

from tpm_gym.analysis.topology import mobility, mobility_at
from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics import (
    ASSEMBLY_MODES,
    ROTATED_MODES,
    forward_all,
    forward_rotated,
    inverse_all,
    inverse_rotated,
    jacobian,
    rotated,
)
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.mechanism import PAPER_TPM, TPM, WIDE_TPM
from tpm_gym.mechanism.tpm.bodies import build, rotated_joint_angles

PAGE = ROOT / "docs" / "operation-modes.md"


def on_the_surface(side: int) -> tuple[FloatArray, FloatArray]:
    """Return points P on which both modes meet, and angles of postures there."""
    theta_1, beta = np.meshgrid(np.linspace(0.4, 1.4, 11), np.linspace(0.3, 2.8, 7))
    points = transition(theta_1, beta, side)
    found = inverse_all(points)
    turned = np.abs(np.exp(1j * found.theta[..., 0]) - np.exp(1j * theta_1[..., None])) < 1e-9
    folded = np.sign(np.cos(found.beta)) == np.sign(np.cos(beta))[..., None]
    here = found.valid & turned & folded
    assert here.sum() > 50
    return np.broadcast_to(points[..., None, :], found.theta.shape)[here], found.theta[here]


@pytest.mark.parametrize("side", [-1, 1])
def test_both_modes_meet_on_the_surface(side):
    points, theta = on_the_surface(side)
    for found, near in ((forward_all(theta), 1e-9), (forward_rotated(theta), 1e-7)):
        apart = np.linalg.norm(found.position - points[:, None], axis=-1)
        best = np.where(found.valid, apart, np.inf).argmin(axis=-1)
        row = np.arange(len(theta))
        assert apart[row, best].max() < near
        if near > 1e-9:
            assert np.abs(found.tilt[row, best]).max() < 1e-7
            assert np.abs(rotated.factors(found).elevation[row, best]).max() < 1e-7
        else:
            z_b = PAPER.l3 * np.sin(theta[:, 0])
            assert np.abs(found.link3[row, best, 1] - z_b).max() < 1e-9


def test_from_there_the_platform_turns_either_way_without_a_jump():
    points, theta = on_the_surface(-1)
    steps = np.linspace(-1e-3, 1e-3, 21)
    path = forward_rotated(theta[:, None] + steps[:, None] * [1.0, 0.0, 0.0])
    near = np.linalg.norm(path.position - points[:, None, None], axis=-1)
    near = np.where(path.valid & (np.abs(path.tilt) < 0.1), near, np.inf)
    tilt = np.take_along_axis(path.tilt, near.argmin(axis=-1)[..., None], axis=-1)[..., 0]
    steady = np.isfinite(near.min(axis=-1)).all(axis=-1)
    assert steady.sum() > 20
    assert np.abs(np.diff(tilt[steady], axis=-1)).max() < 0.05
    assert (tilt[steady][:, 0] * tilt[steady][:, -1] < 0).all()


def test_where_they_meet_mobility_by_rank_is_4():
    for theta in on_the_surface(-1)[1][:10]:
        found = forward_all(theta)
        level = np.abs(found.link3[:, 1] - PAPER.l3 * np.sin(theta[0])) < 1e-9
        for branch in (mode for mode in ASSEMBLY_MODES if level[mode.index]):
            met = mobility(theta, branch)
            assert (met.dof, met.rank, str(met.platform)) == (4, 10, "t^3 r^1")


def test_mobility_by_rank_is_3_and_the_tilt_no_freedom_of_its_own():
    counted = 0
    for theta in np.random.default_rng(0).uniform(-np.pi, np.pi, (200, 3)):
        found = forward_rotated(theta)
        factors = rotated.factors(found)
        for branch in ROTATED_MODES:
            clear = np.abs(factors.parallel[branch.index] / [1, PAPER.l4, PAPER.l4**2]).min()
            if found.valid[branch.index] and clear > 1e-2:
                mobility = mobility_at(build(), rotated_joint_angles(theta, branch))
                assert (mobility.dof, mobility.idle, mobility.rank) == (3, 1, 11)
                assert str(mobility.platform) == "t^3 r^1"
                turned = mobility.platform.rotations.basis[0]
                np.testing.assert_allclose(np.abs(turned), [0, 1, 0], atol=1e-9)
                counted += 1
    assert counted > 30


def said(name: str, *values: object) -> None:
    """Check that the page has a row."""
    row = " | ".join([f"| {name}", *map(str, values)]) + " |"
    print(row)
    assert row in PAGE.read_text(encoding="utf-8")


def shares(g: Geometry) -> tuple[str, str, str]:
    theta = np.random.default_rng(0).uniform(-np.pi, np.pi, (100_000, 3))
    link3 = np.isfinite(rotated.link3_rotated(theta, g)[1]).sum(axis=-1)
    found = forward_rotated(theta, g)
    platform = found.valid.sum(axis=-1)
    counts = ", ".join(f"{100 * (link3 == n).mean():.1f}%" for n in (0, 2, 4))
    values = np.linalg.svd(rotated.velocity(found)[found.valid][:, :3], compute_uv=False)
    conditioning = f"{(values[:, 2] / values[:, 0]).max():.2f}"
    return counts, f"{100 * (platform > 0).mean():.1f}% ({platform.max()} at most)", conditioning


def volumes(machine: TPM) -> tuple[str, ...]:
    """Return volumes, dm^3, by random points, postures of one point, tilts in the task region."""
    g, rng = machine.geometry, np.random.default_rng(1)
    reach = g.l3 + g.l4 + 0.4
    low, high = np.array([-reach, -g.l7, -reach]), np.array([reach, g.l7, reach])
    points = rng.uniform(low, high, (200_000, 3))
    back = inverse_rotated(points, g)
    turned, level = back.valid.any(axis=-1), inverse_all(points, g).valid.any(axis=-1)
    litres = 1e3 * float(np.prod(high - low))
    found = [f"{litres * part.mean():.0f}" for part in (level, turned, level & turned)]
    region = rng.uniform(machine.region.low, machine.region.high, (20_000, 3))
    there = inverse_rotated(region, g)
    share, least = there.valid.any(axis=-1).mean(), np.degrees(np.nanmin(np.abs(there.tilt)))
    grid = oracle.grid(machine.region.low, machine.region.high, (17, 17, 17))
    height = jacobian.factors_at(grid, machine.working_mode, g).elevation.min()
    tilts = f"{100 * share:.0f}%, from {least:.0f}°"
    return (*found, str(back.valid.sum(axis=-1).max()), tilts, f"{1e3 * height:.0f}")


@pytest.mark.slow
def test_numbers_of_the_page():
    names = ("postures of link 3' turned: 0, 2, 4", "motor angles with a rotated assembly",
             "1/cond of the rates of P, largest")  # fmt: skip
    for row in zip(names, *map(shares, (PAPER, WIDE)), strict=True):  # fmt: skip
        said(*row)
    names = ("reachable, translating (dm³)", "reachable, rotated (dm³)", "reachable in both (dm³)",
             "rotated postures of a point, most", "task region: reached rotated, tilt",
             "task region: least z_C1 - z_B1 (mm)")  # fmt: skip
    for row in zip(names, *map(volumes, (PAPER_TPM, WIDE_TPM)), strict=True):
        said(*row)
