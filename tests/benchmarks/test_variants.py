"""The variants of the fidelity benchmark are the same mechanism with other cuts.

The default is cut at the base too, because Bullet's direct solver holds loops between multibodies,
and loses them within one.
"""

import fidelity_lab
import gauss_seidel
import numpy as np
import pytest
from fidelity_lab import Config, Rig, measure, random_motion
from fidelity_long import Histogram
from fidelity_sweep import pareto, sweep
from machines import anywhere
from variants import Variant, all_variants, gaps

from tpm_gym.kinematics import inverse
from tpm_gym.mechanism import PAPER_TPM
from tpm_gym.mechanism.tree import build
from tpm_gym.simulation.simulation import CLOSURE_LIMIT

VARIANTS = all_variants()
GAP = 1e-9  # m
each = pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.name)


def postures(count: int) -> np.ndarray:
    return np.array([PAPER_TPM.inverse(point) for point in anywhere(PAPER_TPM, count)])


@each
def test_moving_any_passive_joint_opens_a_loop_unless_it_is_idle(variant: Variant) -> None:
    """So the next test would find a wrong angle."""
    idle = {"Sa_roll", "Sb_roll", "cup_slide"}
    if variant.name in {"three legs", "one body", "rods 4 spherical", "rods 4 cut at arm"}:
        idle |= {"R33"}  # rolls end link 10 about the line through both of its balls
    if variant.name == "rods 11 cut at arm":
        idle |= {"R32"}  # the same for end link 9
    angles = variant.angles(postures(1)[0])
    for name in set(angles) - set(variant.mechanism.actuated):
        moved = gaps(variant.mechanism, {**angles, name: angles[name] + 0.01}).max()
        assert (moved < GAP) == (name in idle), name


@each
def test_loops_close_and_the_platform_stands_as_in_the_default(variant: Variant) -> None:
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
def test_masses_are_those_of_the_default_but_for_new_crosses(variant: Variant) -> None:
    known = {link.name for link in build().links}
    new = [link for link in variant.mechanism.links if link.name not in known]
    mass = sum(link.mass for link in variant.mechanism.links) - sum(link.mass for link in new)
    assert mass == pytest.approx(sum(link.mass for link in build().links), rel=1e-12)
    assert sum(link.mass for link in new) < 0.1


@each
def test_links_have_no_products_of_inertia(variant: Variant) -> None:
    """Products of inertia would make the engine turn the frame of the closures' pivots."""
    for link in variant.mechanism.links[1:]:
        off_diagonal = link.inertia - np.diag(np.diag(link.inertia))
        assert np.abs(off_diagonal).max() < 1e-12, link.name


@each
def test_the_engine_closes_the_same_loops(variant: Variant) -> None:
    rig = Rig(Config("", "", variant=variant.name))
    for theta in postures(5):
        rig.place(theta)
        gap, _, tilt = rig.robot.truth()
        assert gap < 1e-6
        assert tilt < 1e-6
    rig.close()


@pytest.mark.parametrize("name", [v.name for v in VARIANTS if v.name != "one body"])
def test_the_direct_solver_holds_every_cut_between_multibodies(name: str) -> None:
    errors = measure(Rig(Config("", "", variant=name)), random_motion(20))
    assert errors.lost is None
    assert len(errors.gap) == 20 * 10
    assert errors.gap.max() < 1e-4
    assert errors.apart.max() < 2e-4


def test_settings_reach_the_engine() -> None:
    config = Config("", "", time_step=1 / 500, iterations=77, cfm=1e-5, residual=1e-3, erp=0.3)
    rig = Rig(config)
    found = rig.client.getPhysicsEngineParameters()
    rig.close()
    assert found["fixedTimeStep"] == 1 / 500
    assert found["numSolverIterations"] == 77
    assert config.physics.erp == 0.3
    assert config.beyond == {"globalCFM": 1e-5, "solverResidualThreshold": 1e-3}


def mean_gap(**settings: object) -> float:
    errors = measure(Rig(Config("", "", **settings)), random_motion(40))
    assert errors.lost is None
    return float(errors.gap.mean())


def test_the_gap_is_the_error_of_the_time_step_and_nothing_else() -> None:
    """It is proportional to the squared time step over erp, and does not depend on the cut."""
    default = mean_gap(erp=0.8)
    assert default / mean_gap(erp=0.8, time_step=1 / 500) == pytest.approx(4, rel=0.1)
    assert mean_gap(erp=0.4) / default == pytest.approx(2, rel=0.1)
    for variant in VARIANTS[2:]:
        assert mean_gap(erp=0.8, variant=variant.name) == pytest.approx(default, rel=0.01)


@pytest.mark.parametrize("solver", ["direct", "lcp pgs"])
def test_the_matrix_solvers_lose_loops_within_one_multibody(solver: str) -> None:
    config = Config("", "", variant="one body", solver=solver, iterations=200)
    errors = measure(Rig(config), random_motion(20))
    assert errors.lost is not None
    assert errors.lost < 20
    assert errors.gap.max(initial=0.0) <= CLOSURE_LIMIT


def test_one_step_tells_the_wrong_matrix_from_the_right_one() -> None:
    """Two algorithms on Bullet's matrix agree on a wrong answer; without the matrix it is right."""
    point = np.array((-0.04, 0.028, 0.80))

    def left(variant: str, solver: str) -> float:
        config = Config("", "", variant, solver, iterations=3000, residual=0.0)
        return gauss_seidel.left_over(config, point)

    direct, pgs = left("one body", "direct"), left("one body", "lcp pgs")
    assert direct > 0.01
    assert pgs == pytest.approx(direct, rel=1e-6)
    assert left("one body", "iterative") < 1e-6
    for solver in ("direct", "lcp pgs", "iterative"):
        assert left("three legs", solver) < 1e-6


def test_gauss_seidel_slows_down_towards_the_singularity() -> None:
    rig = Rig(Config("", "", variant="one body"))
    counts = []
    for y in (0.006, 0.012, 0.024):
        rig.place(inverse((-0.04, y, 0.80)))
        rows, mass = gauss_seidel.constraint_rows(rig)
        assert np.linalg.matrix_rank(rows, tol=1e-6) == len(rows) - 1  # one redundant combination
        counts.append(gauss_seidel.iterations_per_decade(rows @ np.linalg.solve(mass, rows.T)))
    rig.close()
    assert counts[0] > 3 * counts[1] > 9 * counts[2]


def test_iterations_per_decade_of_a_known_matrix() -> None:
    # Gauss-Seidel on [[1, c], [c, 1]] shrinks the error by c^2 a sweep, forwards or backwards, and
    # by c^2 a double sweep too: the second starts with the row that the first has just solved.
    c = 0.9
    found = gauss_seidel.iterations_per_decade(np.array([[1.0, c], [c, 1.0]]))
    assert found == pytest.approx(2 / -np.log10(c**2))


def test_torque_control_applies_what_is_fed_forward() -> None:
    """With torques that balance gravity it hardly moves; with less it falls."""
    theta = inverse(np.array([-0.1, 0.03, 0.75]))
    torques = PAPER_TPM.dynamics.gravity(theta)
    speeds = []
    for share in (1.0, 0.9):
        rig = Rig(Config("", "", motor="torque"))
        rig.place(theta)
        rig.drive([*theta, 0.0, 0.0, 0.0, *(share * torques)])  # gains are zero
        rig.step()
        speeds.append(np.abs(rig.robot.motors()[1]).max())
        rig.close()
    assert speeds[0] < 1e-3 * speeds[1]


def test_motions_start_at_rest_and_stay_in_the_region() -> None:
    for motion in (random_motion(30), fidelity_lab.fast_motion(40)):
        for points in motion.points(1 / 250):
            np.testing.assert_allclose(points, PAPER_TPM.region.project(points), rtol=0, atol=1e-9)
            first, second = np.linalg.norm(np.diff(points[:3], axis=0), axis=1)
            assert first < second + 1e-12


def test_a_histogram_streams_what_numpy_sorts() -> None:
    values = np.random.default_rng(0).lognormal(-9.0, 2.0, 100_000)
    histogram = Histogram()
    for part in np.array_split(values, 7):
        histogram.add(part)
    assert histogram.maximum == values.max()
    assert histogram.count == len(values)
    assert histogram.mean == pytest.approx(values.mean())
    for share in (0.5, 0.999):
        assert histogram.quantile(share) == pytest.approx(np.quantile(values, share), rel=0.02)


def test_pareto_front() -> None:
    costs = np.array([3.0, 1.0, 2.0, 2.0, np.nan, 4.0])
    errors = np.array([1.0, 9.0, 5.0, 4.0, 0.1, 2.0])
    assert pareto(costs, errors) == [1, 3, 0]


def test_sweep_starts_with_the_default_and_has_distinct_rows() -> None:
    configs = sweep()
    assert configs[0] == Config("default", "default")
    assert len({config.name for config in configs}) == len(configs)
    settings = [vars(config) | {"name": "", "family": ""} for config in configs]
    assert all(settings[i] not in settings[:i] for i in range(len(settings)))
