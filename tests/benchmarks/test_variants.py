"""The variants of the fidelity benchmark are the same mechanism with other cuts.

The default is cut at the base too, because Bullet's direct solver holds loops between multibodies,
and loses them within one.
"""

import gauss_seidel
import numpy as np
import pytest
from fidelity_lab import Config, Rig, measure, random_motion
from machines import anywhere
from variants import all_variants, gaps

from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.simulation.simulation import CLOSURE_LIMIT

VARIANTS = all_variants()
GAP = 1e-9  # m
each = pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.name)


def postures(count: int) -> np.ndarray:
    return np.array([PAPER_TPM.inverse(point) for point in anywhere(PAPER_TPM, count)])


@each
def test_loops_close_and_the_platform_stands_as_in_the_default(variant):
    for theta in postures(30):
        angles = variant.angles(theta)
        assert set(angles) == {link.joint.name for link in variant.mechanism.links[1:]}
        assert gaps(variant.mechanism, angles).max() < GAP
        frames = variant.mechanism.places(angles)
        default = VARIANTS[0].mechanism.places(VARIANTS[0].angles(theta))
        for link in ("platform", "cup", "link_3p", "arm_2", "arm_5", "arm_12"):
            for found, expected in zip(frames[link], default[link], strict=True):
                np.testing.assert_allclose(found, expected, rtol=0, atol=GAP)
        for rod in ("rod_4a", "rod_4b", "rod_11a", "rod_11b"):
            centres = [
                f[rod].point(m.link(rod).centre_of_mass)
                for f, m in ((frames, variant.mechanism), (default, VARIANTS[0].mechanism))
            ]
            np.testing.assert_allclose(*centres, rtol=0, atol=GAP)


@each
def test_the_engine_closes_the_same_loops(variant):
    rig = Rig(Config("", "", variant=variant.name))
    for theta in postures(5):
        rig.place(theta)
        gap, _, tilt = rig.robot.truth()
        assert gap < 1e-6
        assert tilt < 1e-6
    rig.close()


@pytest.mark.parametrize("name", [v.name for v in VARIANTS if v.name != "one body"])
def test_the_direct_solver_holds_every_cut_between_multibodies(name):
    errors = measure(Rig(Config("", "", variant=name)), random_motion(20))
    assert errors.lost is None
    assert len(errors.gap) == 20 * 10
    assert errors.gap.max() < 1e-4
    assert errors.apart.max() < 2e-4


def mean_gap(**settings: object) -> float:
    errors = measure(Rig(Config("", "", **settings)), random_motion(40))
    assert errors.lost is None
    return float(errors.gap.mean())


def test_the_gap_is_the_error_of_the_time_step_and_nothing_else():
    """It is proportional to the squared time step over erp, and does not depend on the cut."""
    default = mean_gap(erp=0.8)
    assert default / mean_gap(erp=0.8, time_step=1 / 500) == pytest.approx(4, rel=0.1)
    assert mean_gap(erp=0.4) / default == pytest.approx(2, rel=0.1)
    for variant in VARIANTS[2:]:
        assert mean_gap(erp=0.8, variant=variant.name) == pytest.approx(default, rel=0.01)


@pytest.mark.parametrize("solver", ["direct", "lcp pgs"])
def test_the_matrix_solvers_lose_loops_within_one_multibody(solver):
    config = Config("", "", variant="one body", solver=solver, iterations=200)
    errors = measure(Rig(config), random_motion(20))
    assert errors.lost is not None
    assert errors.lost < 20
    assert errors.gap.max(initial=0.0) <= CLOSURE_LIMIT


def test_one_step_tells_the_wrong_matrix_from_the_right_one():
    """Two algorithms on Bullet's matrix agree on a wrong answer; without the matrix it is right."""
    point = np.array((-0.04, 0.028, 0.80))

    def left(variant, solver):
        config = Config("", "", variant, solver, iterations=3000, residual=0.0)
        return gauss_seidel.left_over(config, point)

    direct, pgs = left("one body", "direct"), left("one body", "lcp pgs")
    assert direct > 0.01
    assert pgs == pytest.approx(direct, rel=1e-6)
    assert left("one body", "iterative") < 1e-6
    for solver in ("direct", "lcp pgs", "iterative"):
        assert left("three legs", solver) < 1e-6
