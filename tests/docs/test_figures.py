"""Data of the figures of docs/: zero sets, surfaces, skeletons, volumes. One figure is drawn."""

import numpy as np
import pytest
from paths import ROOT

from tpm_gym.analysis.aspects import aspects
from tpm_gym.analysis.decoupling import LINKS, PLATFORM
from tpm_gym.analysis.singularity import factors_at
from tpm_gym.kinematics import ELBOWS_OUT, WORKING_MODES, inverse_all
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.kinematics.rotated import link3_rotated
from tpm_gym.kinematics.workspace import reachable
from tpm_gym.mechanism import PAPER_TPM

DOCS = ROOT / "docs"

import draw_figures  # noqa: E402
from figures import (  # noqa: E402
    maps,
    modes,
    motors,
    parameters,
    postures,
    regions,
)
from figures.skeleton import skeleton  # noqa: E402
from figures.zero_sets import (  # noqa: E402
    Section,
    parallel_lines,
    reach_margin,
    serial_lines,
    serial_squares,
    sheets,
)

X, Z = np.linspace(-0.92, 1.06, 100), np.linspace(-1.18, 1.22, 121)
OTHER = Geometry(l1=0.25, l2=0.06, l3=0.30, l4=0.65, l5=0.08, l6=0.02, l7=0.12)


@pytest.mark.parametrize("geometry", [PAPER, OTHER])
@pytest.mark.parametrize("mode", [ELBOWS_OUT, WORKING_MODES[3]])
def test_serial_squares_are_the_squares_of_the_factors_and_tell_what_is_reached(geometry, mode):
    high = np.array([geometry.l3 + geometry.l4, geometry.l7, geometry.l3 + geometry.l4])
    points = np.random.default_rng(0).uniform(-high, high, (20_000, 3))
    squares = serial_squares(points, mode.cos_beta, geometry)
    valid = reachable(points, mode, geometry)
    assert 0.2 < valid.mean() < 0.9
    np.testing.assert_array_equal(valid, np.all(squares >= 0, axis=-1))
    np.testing.assert_array_equal(valid, reach_margin(points, mode.cos_beta, geometry) >= 0)
    serial = factors_at(points[valid], mode, geometry).serial
    np.testing.assert_allclose(squares[valid], serial**2, atol=1e-14)


@pytest.mark.parametrize("index", [1, 2, 3])
@pytest.mark.parametrize("y", [1e-5, 0.025, 0.048])
def test_parallel_lines_are_zeros_with_a_change_of_sign(index, y):
    section = Section("y", y)
    lines = parallel_lines(index, ELBOWS_OUT, section, X, Z)
    assert sum(len(line) for line in lines) > 40
    points = section.points(np.concatenate(lines))
    # Near the edge of the reach a factor changes like a square root: hence the tolerance.
    assert np.abs(sheets(points, ELBOWS_OUT)[..., index]).max() < 1e-10


@pytest.mark.parametrize("index", [1, 2, 3])
@pytest.mark.parametrize("sign", [-1, 1])
def test_serial_lines_are_the_edge_of_the_reach(index, sign):
    section = Section("y", 0.025)
    mode = next(m for m in WORKING_MODES if m.cos_beta == sign)
    line = np.concatenate(serial_lines(index, sign, section, X, Z))
    points = section.points(line)
    assert np.abs(serial_squares(points, sign)[:, index]).max() < 1e-14
    # A step to one side of the edge is reached, a step to the other is not.
    steps = 2e-5 * np.array([(np.cos(a), 0, np.sin(a)) for a in np.linspace(0, 2 * np.pi, 16)])
    around = reachable(points[:, None] + steps, mode)
    ends = np.abs(reach_margin(points, sign)) > 1e-12  # where another leg's edge begins
    assert (around.any(axis=1) & ~around.all(axis=1))[~ends].all()


@pytest.mark.parametrize("geometry", [PAPER, OTHER])
def test_drawn_links_have_the_lengths_of_the_geometry(geometry):
    middle = postures.POINT if geometry is PAPER else np.array([0.0, 0.06, 0.6])
    assert inverse_all(middle, geometry).valid.all()
    for mode in WORKING_MODES:
        links = skeleton(middle, mode, geometry).links()
        for name, (start, end, length) in links.items():
            assert np.linalg.norm(end - start) == pytest.approx(length, abs=1e-14), name
    assert set(postures.STROKES) <= set(links)


@pytest.mark.parametrize("sign", [-1, 1])
def test_volume_agrees_with_random_points(sign):
    mode = next(m for m in WORKING_MODES if m.cos_beta == sign)
    low, high = np.array([-1.2, -PAPER.l7, -1.3]), np.array([1.2, PAPER.l7, 1.3])
    points = np.random.default_rng(1).uniform(low, high, (40_000, 3))
    share = reachable(points, mode).mean()
    box = np.prod(high - low)
    sigma = box * np.sqrt(share * (1 - share) / len(points))
    volume = maps.volume(sign, step=0.01, slices=16)
    assert volume == pytest.approx(share * box, abs=4 * sigma)
    assert volume == pytest.approx(maps.volume(sign, step=0.02, slices=8), rel=5e-3)


def test_signs_tell_the_aspects_of_a_half_apart_but_for_two():
    """The figure of the aspects colours by signs, but the smaller of these two by its place."""
    found = aspects(ELBOWS_OUT, shape=(128, 8, 192))
    for sin_beta in (-1, 1):
        half = [regions.signs_of(a) for a in found if a.assembly.sin_beta == sin_beta]
        assert {signs[:2] for signs in half} == set(regions.COLOURS)
        assert len(half) == len(set(half)) + 1
        assert half.count(regions.SHARED) == 2
        colours = [regions.colour(signs) for signs in set(half)]
        assert len({*map(tuple, (*colours, regions.colour(regions.SHARED, True)))}) == len(half)


def test_the_smaller_of_two_aspects_with_equal_signs_is_found_by_its_place():
    found = aspects(ELBOWS_OUT, shape=(128, 8, 192))
    half = [aspect for aspect in found if aspect.assembly.sin_beta > 0]
    shared = [aspect.cells for aspect in half if regions.signs_of(aspect) == regions.SHARED]
    large, little = sorted(shared, key=lambda cells: -cells.volume)
    small = regions.smaller(half)
    for sign in (1, -1):
        assert small(little.centres() * (1, sign, 1)).all()
        assert not small(large.centres() * (1, sign, 1)).any()


def test_drawn_postures_of_both_modes_close_within_the_motors_stops():
    motors = PAPER_TPM.mechanism.motors
    meeting = modes.meeting_posture(modes.THETA[0], 0.6)
    for posture in (modes.level_posture(modes.THETA), meeting, modes.turned_posture(modes.THETA)):
        np.testing.assert_allclose(np.linalg.norm(posture.rods, axis=-1), PAPER.l4, atol=1e-12)
        assert all(m.lower < t < m.upper for m, t in zip(motors, posture.theta, strict=True))


def test_both_modes_meet_where_the_figure_draws_it():
    theta_2 = np.linspace(0.0, 2 * np.pi, 2881)
    theta = np.stack(np.broadcast_arrays(modes.THETA[0], theta_2, 0.0), axis=-1)
    meets, _ = modes.meeting_terms(np.asarray(modes.THETA[0]), theta_2)
    crossed = np.flatnonzero(np.sign(meets[:-1]) != np.sign(meets[1:]))
    least = np.nanmin(np.abs(link3_rotated(theta)[1]), axis=-1)
    assert len(crossed) == 4
    assert least[crossed].max() < 0.2  # next to one of them the tilt changes fast
    nearest = np.abs(np.flatnonzero(least < 0.01)[:, None] - crossed).min(axis=1)
    assert nearest.max() < 20  # of 2881 samples


def test_a_figure_is_drawn_twice_with_the_same_bytes(tmp_path):
    first = draw_figures.draw("postures", tmp_path).read_bytes()
    assert first.startswith(b"\x89PNG")
    assert b"matplotlib" not in first
    assert draw_figures.draw("postures", tmp_path).read_bytes() == first


def test_unknown_name_is_refused_and_every_figure_has_a_caption():
    with pytest.raises(SystemExit, match="no figure nonsense"):
        draw_figures.main(["nonsense"])
    text = (DOCS / "figures.md").read_text(encoding="utf-8")
    for name in draw_figures.FIGURES:
        assert f"(images/{name}.png)" in text
        assert f"draw_figures.py {name}`" in text


@pytest.mark.parametrize("motor", [0, 1, 2])
def test_one_motor_is_turned_at_a_time_and_the_table_has_the_patterns(motor):
    before = skeleton(parameters.POINT, ELBOWS_OUT, parameters.DRAWN)
    change = motors.turned(motor).theta - before.theta
    np.testing.assert_allclose(change, motors.TURNS[motor], atol=1e-9)
    values, _ = motors.table()
    np.testing.assert_array_equal(values > 0, np.concatenate([LINKS, PLATFORM]))
