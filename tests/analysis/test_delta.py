"""Solutions, counts and singularities of the Delta and the Orthoglide of docs/delta.py."""

import re

import numpy as np
import oracle
import pytest
from delta import DELTA, ORTHOGLIDE, Leg, Tripod
from paths import ROOT
from screws import common, projector, twists

from tpm_gym.analysis.decoupling import motors, over
from tpm_gym.analysis.poc import Chain, analyse
from tpm_gym.analysis.topology import analyse as analyse_ours
from tpm_gym.analysis.topology import describe
from tpm_gym.arrays import FloatArray
from tpm_gym.errors import InputError
from tpm_gym.kinematics import WORKING_MODES, inverse, inverse_all
from tpm_gym.kinematics.geometry import PAPER
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism import PAPER_TPM

BOXES = {
    "Delta": (DELTA, Region((-0.18, -0.18, 0.66), (0.18, 0.18, 0.90))),
    "Orthoglide": (ORTHOGLIDE, Region((-0.15, -0.15, -0.15), (0.15, 0.15, 0.15))),
}
TEXT = (ROOT / "docs" / "mechanisms.md").read_text(encoding="utf-8")
both = pytest.mark.parametrize("name", list(BOXES))


def sample(name: str, count: int, seed: int) -> tuple[Tripod, FloatArray]:
    tripod, box = BOXES[name]
    return tripod, np.random.default_rng(seed).uniform(box.low, box.high, (count, 3))


def gaps(tripod: Tripod, position: FloatArray, q: FloatArray) -> FloatArray:
    """Return the errors of the rods' lengths, from the legs alone."""
    found = []
    for i, leg in enumerate(tripod.legs):
        turn, axis = q[..., i, None], np.array(leg.axis)
        if leg.arm is None:
            b = np.array(leg.pivot) + turn * axis
        else:  # Rodrigues
            arm = np.array(leg.arm)
            b = leg.pivot + arm * np.cos(turn) + np.cross(axis, arm) * np.sin(turn)
        found.append(np.linalg.norm(position + leg.tip - b, axis=-1) - leg.rod)
    return np.stack(found, axis=-1)


@both
def test_the_solutions_close_differ_and_lead_back(name):
    tripod, points = sample(name, 200, 1)
    q = tripod.inverse_all(points)
    assert q.shape == (200, 8, 3)
    assert np.abs(gaps(tripod, points[:, None], q)).max() < 1e-12
    assert all(len(np.unique(some.round(9), axis=0)) == 8 for some in q)
    back = tripod.forward_all(q)
    assert back.shape == (200, 8, 2, 3)
    off = np.abs(back - points[:, None, None]).max(axis=-1)
    assert off.min(axis=-1).max() < 1e-9
    assert np.abs(gaps(tripod, back, q[:, :, None])).max() < 1e-9


@both
def test_each_leg_has_two_solutions_and_no_more(name):
    """So there are 8 in all, half of our 16. Changes of sign along the motor count them."""
    tripod, points = sample(name, 100, 2)
    turns = np.linspace(-np.pi, np.pi, 1440, endpoint=False)[:, None]  # m of a slider
    for leg in range(3):
        q = np.zeros((1440, 100, 3))
        q[..., leg] = turns
        inside = gaps(tripod, points, q)[..., leg] < 0
        assert (np.count_nonzero(inside != np.roll(inside, 1, axis=0), axis=0) == 2).all()
    assert len(WORKING_MODES) == 2 * 2**3
    assert inverse_all([-0.04, 0.028, 0.80]).valid.all()


@both
def test_velocity_is_the_derivative_of_the_forward_kinematics(name):
    tripod, points = sample(name, 50, 3)
    step = 1e-6
    for q in np.moveaxis(tripod.inverse_all(points), 1, 0):
        j = tripod.velocity(points, q)
        for motor in range(3):
            moved = []
            for sign in (1, -1):
                found = tripod.forward_all(q + sign * step * np.eye(3)[motor])
                nearest = np.linalg.norm(found - points[:, None], axis=-1).argmin(axis=-1)
                moved.append(found[np.arange(50), nearest])
            slope = (moved[0] - moved[1]) / (2 * step)
            size = np.abs(j).max(axis=(-2, -1), initial=1.0)[:, None]
            assert (np.abs(j[..., motor] - slope) / size**2).max() < 1e-6


def test_the_orthoglide_is_isotropic_at_its_home():
    q = ORTHOGLIDE.inverse_all([0, 0, 0])
    np.testing.assert_allclose(np.abs(q), PAPER.l4, atol=1e-15)
    np.testing.assert_allclose(ORTHOGLIDE.velocity([0, 0, 0], q[0]), np.eye(3), atol=1e-15)


# Topology


def freedoms(chains: list[Chain], point: FloatArray) -> tuple[int, int]:
    """Return the dimensions of the chains' common twists and rotations, by screw theory."""
    shared = common(*(projector(twists(chain, point)) for chain in chains))
    return round(np.trace(shared)), int(np.linalg.matrix_rank(shared[:, 3:], tol=1e-9))


@both
@pytest.mark.parametrize(
    ("balls", "equations", "degrees", "kappa"),
    [(False, [5, 4], [1, -1], 1), (True, [6, 6], [2, -2], 2)],
)
def test_counts(name, balls, equations, degrees, kappa):
    tripod, points = sample(name, 5, 4)
    for point in points:
        for q in tripod.inverse_all(point):
            chains = tripod.chains(point, q, balls)
            found = analyse(chains, point)
            assert str(found.platform) == "t^3 r^0"
            assert found.dof() == 3
            assert [loop.equations for loop in found.loops] == equations
            assert [loop.constraint for loop in found.loops] == degrees
            assert found.coupling == (kappa,)
            assert freedoms(chains, point) == (3, 0)


def test_one_chain_is_no_parallel_mechanism():
    with pytest.raises(InputError):
        analyse(DELTA.chains([0, 0, 0.8], DELTA.inverse_all([0, 0, 0.8])[0])[:1], [0, 0, 0.8])


# Singularities beside ours


def as_delta(p: dict[str, FloatArray], row: int) -> Tripod:
    """Return our legs as those of a Delta: the platform is rigid, with C1, C2 and C3 in place."""
    axes = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, -1.0, 0.0))
    arms = ((0.0, PAPER.l3, 0.0), (PAPER.l3, 0.0, 0.0), (PAPER.l3, 0.0, 0.0))
    one, two, three = (
        Leg(tuple(p[f"A{i + 1}"]), axes[i], axes[i], tuple((p[f"C{i + 1}"] - p["P"])[row]),
            PAPER.l4, arms[i])
        for i in range(3)
    )  # fmt: skip
    return Tripod((one, two, three))


def test_text_on_singularities_three_serial_factors_are_a_delta_s_and_no_parallel_one_is():
    s = oracle.reachable_postures(np.random.default_rng(5), 60, PAPER)
    parallel, serial = oracle.factors(s.theta, s.x_c, s.z_c, s.beta, PAPER)
    legs, determinants = [], []
    for row, (position, theta) in enumerate(zip(s.position, s.theta, strict=True)):
        tripod = as_delta(s.p, row)
        legs.append(tripod.serial(position, theta))
        determinants.append(np.linalg.det(tripod.parallel(position, theta)))
    np.testing.assert_allclose(legs, serial[:, 1:], rtol=0, atol=1e-12)
    # The rods of a Delta are singular elsewhere: no factor tells the sign of their determinant.
    sign = np.sign(determinants)
    for combination in (*parallel.T, parallel.prod(axis=-1), parallel[:, 1:].prod(axis=-1)):
        agree = (np.sign(combination) == sign).mean()
        assert 0.1 < agree < 0.9


@both
def test_the_platform_may_turn_where_the_planes_of_parallelograms_of_balls_share_a_direction(name):
    """A constraint singularity, which parallelograms of revolutes do not have."""
    tripod, rng = BOXES[name][0], np.random.default_rng(6)
    hinges = np.array([leg.hinge for leg in tripod.legs])

    def volume(points):
        """Return the volume of the normals of three planes, 0 if the planes share a direction."""
        rods = tripod.parallel(points, tripod.inverse_all(points)[:, 0])
        return np.linalg.det(np.cross(hinges, rods))

    one = rng.uniform(-1.0, 1.0, (3000, 3))
    other = one + rng.normal(0.0, 0.02, one.shape)
    reached = [np.isfinite(tripod.inverse_all(ends)).all(axis=(1, 2)) for ends in (one, other)]
    one, other = (ends[reached[0] & reached[1]] for ends in (one, other))
    across = volume(one) * volume(other) < 0
    one, other = one[across], other[across]
    assert len(one) > 5
    for _ in range(60):
        middle = (one + other) / 2
        same = (volume(middle) * volume(one) > 0)[:, None]
        one, other = np.where(same, middle, one), np.where(same, other, middle)
    for point, q in zip(one, tripod.inverse_all(one)[:, 0], strict=True):
        assert freedoms(tripod.chains(point, q, balls=True), point) == (4, 1)
        assert freedoms(tripod.chains(point, q), point) == (3, 0)


# What the page says


def test_the_page_s_numbers_are_computed():
    theta = inverse([-0.04, 0.028, 0.80])
    found = [analyse_ours(describe(theta))]
    counts = [over(PAPER_TPM.region).motors]
    for tripod, box in BOXES.values():
        cells = np.stack(np.meshgrid(*[(np.arange(9) + 0.5) / 9] * 3), axis=-1).reshape(-1, 3)
        points = box.low + cells * np.subtract(box.high, box.low)
        q = tripod.inverse_all(points)[:, 0]
        found.append(analyse(tripod.chains(points[0], q[0]), points[0]))
        counts.append(motors(tripod.velocity(points, q)).mean(axis=0))
    plain = re.sub(r"\[(.+?)\]\(.+?\)", r"\1", TEXT)  # without links
    lines = re.findall(r"^\| (.+?) \|$", plain, flags=re.MULTILINE)
    rows = {cells[0]: cells[1:] for cells in (line.split(" | ") for line in lines)}
    assert rows["POC set of the platform"] == [str(f.platform) for f in found]
    for label, name in (("equations", "xi of the loops"), ("constraint", "Delta of the loops")):
        printed = [[int(v) for v in cell.split(", ")] for cell in rows[name]]
        assert printed == [[getattr(loop, label) for loop in f.loops] for f in found]
    kappa = [", ".join(f"{k:g}" for k in f.coupling) for f in found]
    assert rows["coupling degree kappa"] == kappa
    assert rows["inverse solutions"] == ["16", "8", "8"]
    assert rows["forward solutions"] == ["4", "2", "2"]
    printed = [[float(v) for v in cell.split(", ")] for cell in rows["motors that count, x, y, z"]]
    np.testing.assert_allclose(printed, counts, atol=0.05)
    assert f'"motors that count" is {counts[2].mean():.2f} on average' in TEXT


def test_the_page_s_code_runs():
    (block,) = re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL)
    namespace: dict[str, object] = {}
    exec(block, namespace)
    printed = re.findall(r"# (\S.*)$", block, flags=re.MULTILINE)
    assert str(namespace["found"].platform) in printed[-1]
    assert str(namespace["found"].coupling) in printed[-1]
