"""Gradients agree with differences; the recorded lengths and motions keep all limits and gain.

The searches are slow, so their record is tested, and one search of each kind is repeated.
"""

import json
import re
from dataclasses import replace

import draw_gradients
import gymnasium as gym
import numpy as np
import pytest
import torch
from episodes import expert_episode
from figures.skeleton import skeleton
from gradients import lengths, ways
from gradients.descent import minimise
from paths import ROOT

from tpm_gym.analysis.aspects import aspects, largest_box
from tpm_gym.kinematics import ELBOWS_OUT
from tpm_gym.kinematics.geometry import PAPER, WIDE, Geometry
from tpm_gym.kinematics.jacobian import factors_at
from tpm_gym.kinematics.workspace import Region, conditioning_at
from tpm_gym.mechanism import PAPER_TPM, WIDE_TPM, Mount

RECORD = json.loads(draw_gradients.RECORD.read_text(encoding="utf-8"))
DESIGNS = {
    name: lengths.Design(Geometry(*row["lengths"]), Region(row["low"], row["high"]))
    for name, row in RECORD["designs"].items()
}
CARRIES = [
    (carry, torch.tensor(row["commands"], dtype=torch.float64), row)
    for machine in (PAPER_TPM, WIDE_TPM)
    for carry, row in zip(
        ways.draw(machine, draw_gradients.CARRIES),
        [row for row in RECORD["carries"] if row["machine"] == machine.name],
        strict=True,
    )
]
each_design = pytest.mark.parametrize("design", DESIGNS.values(), ids=DESIGNS)


# -- the method ------------------------------------------------------------------------------------


def test_the_least_within_limits_is_found_from_inside_and_only_from_there():
    seen = []

    def limits(at):
        seen.append(at.detach())
        return 1 - (at**2).sum()[None]

    def aim(at):
        assert (at**2).sum() < 1
        return at[0] + 2 * at[1]

    start = torch.tensor([0.3, 0.5], dtype=torch.float64)
    found = minimise(aim, limits, start, (1e-1, 1e-3, 1e-5))
    np.testing.assert_allclose(found, -np.array([1.0, 2.0]) / np.sqrt(5), atol=1e-4)
    assert any((at**2).sum() >= 1 for at in seen)  # what is not allowed was tried, and refused
    with pytest.raises(ValueError, match="breaks a limit"):
        minimise(aim, limits, 3 * start, (1e-1,))


# -- lengths ---------------------------------------------------------------------------------------


@each_design
def test_gradients_by_lengths_and_box_are_those_of_differences(design):
    numbers = [*vars(design.geometry).values(), *design.box.low, *design.box.high]
    at = torch.tensor(numbers).double().requires_grad_()
    assert torch.autograd.gradcheck(lengths.room, (at,), rtol=1e-6, fast_mode=True)


@each_design
def test_boxes_keep_their_limits_between_the_nodes_of_the_search(design):
    low, high = np.array(design.box.low), np.array(design.box.high)
    points = low + lengths.nodes((41, 41, 41)).numpy() * (high - low)
    assert conditioning_at(points, geometry=design.geometry).min() >= lengths.THRESHOLD
    elevation = factors_at(points, geometry=design.geometry).elevation
    assert elevation.min() >= lengths.ELEVATION
    posture = skeleton(points, ELBOWS_OUT, design.geometry)
    joints = [posture.c, posture.d1, posture.e1, posture.f1, posture.d3, posture.a]
    assert max(np.abs(each[..., :2]).max() for each in joints) <= lengths.FOOTPRINT
    assert design.geometry.l1 + design.geometry.l3 <= lengths.FOOTPRINT
    assert design.geometry.l3 + design.geometry.l4 <= lengths.REACH


def test_the_lengths_found_have_the_largest_box_and_all_searches_found_it():
    volumes = {name: design.volume for name, design in DESIGNS.items()}
    assert volumes["found"] > 1.25 * volumes["wide"] > 10 * volumes["paper"]
    assert max(RECORD["volumes"]) == pytest.approx(volumes["found"], rel=1e-12)
    assert min(RECORD["volumes"]) == pytest.approx(volumes["found"], rel=1e-3)
    assert DESIGNS["paper"].geometry == PAPER
    assert DESIGNS["wide"].geometry == WIDE


def test_the_paper_s_box_is_that_of_the_best_grid():
    grid = aspects(shape=(96, 48, 128))
    boxes = [largest_box(a, lengths.THRESHOLD).volume for a in grid[:2]]
    assert 0.9 * DESIGNS["paper"].volume < max(boxes) < DESIGNS["paper"].volume


def test_a_machine_of_the_lengths_found_picks_and_places():
    box = DESIGNS["found"].box
    machine = replace(
        WIDE_TPM,
        name="found",
        geometry=DESIGNS["found"].geometry,
        mount=Mount(box.high[2] + 0.06),
        region=box,
        goal_region=box,
        home=tuple(np.mean([box.low, box.high], axis=0).tolist()),
    )
    env = gym.make("TPMPickAndPlace-v0", machine=machine)
    for seed in range(3):
        infos = [info for *_, info in expert_episode(env, seed)]
        assert infos[-1]["is_success"]
        assert max(info["closure_error"] for info in infos) < 1e-4
        assert min(info["conditioning"] for info in infos) > 0.99 * lengths.THRESHOLD


@pytest.mark.slow
def test_a_search_from_other_lengths_ends_there_too():
    start = lengths.random_lengths(np.random.default_rng(7))
    found = lengths.largest_box(start, free=True)
    assert found.volume == pytest.approx(DESIGNS["found"].volume, rel=1e-3)


# -- ways ------------------------------------------------------------------------------------------


def test_gradients_by_commands_are_those_of_differences():
    carry, found, _ = CARRIES[2]
    at = found.clone().requires_grad_()
    for function in (lambda way: ways.rms(carry.torque(way)), carry.room):
        assert torch.autograd.gradcheck(function, (at,), rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize(("carry", "found", "row"), CARRIES)
def test_ways_take_less_torque_on_the_expert_s_terms(carry, found, row):
    machine, expert = carry.machine, carry.expert()
    assert found.shape == expert.shape
    for end in (slice(0, 2), slice(-2, None)):  # at rest, in the same places
        np.testing.assert_array_equal(found[end], expert[end])
    assert machine.region.contains(found).all()
    assert (np.abs(np.diff(found, axis=0)) <= machine.step_limit).all()
    path = ways.points(found).numpy()
    assert machine.conditioning_at(path).min() >= machine.safe_conditioning
    height = path[0, 2] - path[:, 2]
    off = np.linalg.norm(path[:, None, :2] - path[[0, -1], :2], axis=-1).min(axis=1)
    assert height.min() >= -1e-12
    assert (height[off > 2.5 * ways.WELL] >= 0.997 * ways.CLEARANCE).all()
    for name, commands in (("expert", expert), ("found", found)):
        assert ways.rms(carry.torque(commands)) == pytest.approx(row[name]["rms"], rel=1e-9)
    assert draw_gradients.less_heat(row, "rms") > 0.1


@pytest.mark.parametrize(("carry", "found", "row"), CARRIES[::4])
def test_ways_take_less_torque_in_pybullet(carry, found, row):
    for name, commands in (("expert", carry.expert()), ("found", found)):
        torque, simulated = carry.torque(commands), carry.simulated(commands)
        # A kink of the acceleration is felt a time step earlier or later.
        gaps = [simulated[1:] - torque[:-2], simulated[1:] - torque[1:-1]]
        assert np.abs(gaps).max(axis=-1).min(axis=0).max() < 0.1
        assert ways.rms(simulated) == pytest.approx(row[name]["rms_pybullet"], rel=1e-3)
    assert draw_gradients.less_heat(row, "rms_pybullet") > 0.1


@pytest.mark.slow
def test_a_way_is_found_again():
    carry, found, _ = CARRIES[2]
    again, once = (ways.rms(carry.torque(way)).item() for way in (carry.least_torque(), found))
    assert again == pytest.approx(once, rel=1e-3)


# -- the page --------------------------------------------------------------------------------------


def test_the_page_has_the_record_s_tables_and_its_code_runs():
    page = (ROOT / "docs/gradients.md").read_text(encoding="utf-8")
    tables = [line for line in draw_gradients.report(RECORD).splitlines() if line.startswith("|")]
    assert [line for line in page.splitlines() if line.startswith("|")] == tables
    names: dict[str, torch.Tensor] = {}
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1), names)
    assert names["lengths"].grad.isfinite().all()
    saved = [
        np.mean([draw_gradients.less_heat(row, kind) for _, _, row in some])
        for kind in ("rms", "rms_pybullet")
        for some in (CARRIES[: draw_gradients.CARRIES], CARRIES[draw_gradients.CARRIES :])
    ]
    stated = re.search(
        r"falls by (\d+)% on .* by (\d+)% on WIDE \(in PyBullet by (\d+) and (\d+)%\)", page
    )
    assert [f"{100 * share:.0f}" for share in saved] == list(stated.groups())
