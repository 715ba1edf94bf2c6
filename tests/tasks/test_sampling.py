"""Sampled ends are safe, apart and spread; tempting ones lie at the threshold and lure beyond."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from machines import each_machine

from tpm_gym.arrays import FloatArray
from tpm_gym.errors import ConfigurationError, ResetOptionError
from tpm_gym.kinematics.workspace import Region
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.tpm import PAPER_TPM, WIDE_TPM
from tpm_gym.tasks import PickAndPlace, Reach, Task
from tpm_gym.tasks.conveyor import Conveyor
from tpm_gym.tasks.push import Push
from tpm_gym.tasks.sampling import APART, BAND, line_in_joints, safe_points
from tpm_gym.tasks.stack import Stack

SAFE = PAPER_TPM.safe_conditioning
BLOCK = PickAndPlace.block
KINDS = [Reach, PickAndPlace]


@cache
def ends(
    kind: type[Task], machine: Machine = PAPER_TPM, goals: str = "tempting", count: int = 100
) -> tuple[FloatArray, FloatArray]:
    """Starts and goals of point P, machine's frame, each (count, 3); legal ones."""
    task = kind(machine, goals=goals)
    raised = (0.0, 0.0, CUP.length + BLOCK.height / 2 if task.scene.objects else 0.0)
    drawn = task.start([np.random.default_rng(seed) for seed in range(count)])
    for row in range(0, count, 10):  # what is drawn may be chosen
        chosen = {name: places[row] for name, places in drawn.items()}
        kind(machine).start([np.random.default_rng(0)], chosen)
    home = np.tile(machine.mount.to_world(machine.home), (count, 1))
    to_paper = machine.mount.to_paper
    return to_paper(drawn.get("object", home - raised) + raised), to_paper(drawn["goal"] + raised)


@each_machine
@pytest.mark.parametrize("kind", KINDS)
def test_sampled_ends_are_safe_apart_and_spread(kind, machine):
    starts, goals = ends(kind, machine, "sampled", 200)
    for points in (starts, goals):
        assert machine.region.contains(points).all()
        assert (machine.conditioning_at(points) >= machine.safe_conditioning).all()
    assert np.linalg.norm(starts - goals, axis=-1).min() >= APART - 1e-12
    edges = np.subtract(machine.goal_region.high, machine.goal_region.low)
    assert (np.ptp(goals, axis=0) > 0.8 * edges).all()
    if kind is PickAndPlace:  # half on the table, half in the air
        np.testing.assert_allclose(starts[:, 2], starts[0, 2], rtol=0, atol=1e-12)
        height = machine.mount.to_world(goals)[:, 2] - CUP.length - BLOCK.height
        on_table = np.isclose(height, 0.0)
        assert 0.4 < on_table.mean() < 0.6
        assert height[~on_table].min() > 0.02
        assert (np.ptp(starts[:, :2], axis=0) > 0.8 * edges[:2]).all()


def test_a_region_is_a_list_of_one() -> None:
    region, found = PAPER_TPM.goal_region, []
    for part in (region, [region]):
        rngs = [np.random.default_rng(0)]
        found.append(safe_points(rngs, PAPER_TPM, {"goal": part}, {})["goal"])
    np.testing.assert_array_equal(*found)


def test_points_are_drawn_by_the_rows_own_generator_and_apart_from_all_others() -> None:
    regions = {name: [PAPER_TPM.region, PAPER_TPM.goal_region] for name in "abc"}
    low, high = PAPER_TPM.region.low, PAPER_TPM.region.high
    known = {"b": np.random.default_rng(1).uniform(low, high, (100, 3))}

    def drawn(seeds: range) -> dict[str, FloatArray]:
        rngs = [np.random.default_rng(seed) for seed in seeds]
        own = {name: points[seeds] for name, points in known.items()}
        return safe_points(rngs, PAPER_TPM, regions, own, 0.1)

    together = drawn(range(100))
    np.testing.assert_array_equal(together["b"], known["b"])
    for first, second in combinations(together.values(), 2):
        assert np.linalg.norm(first - second, axis=1).min() >= 0.1
    for row in range(100):
        for name, points in drawn(range(row, row + 1)).items():
            np.testing.assert_array_equal(points[0], together[name][row])


@pytest.mark.parametrize("kind", KINDS)
def test_tempting_ends_are_safe_and_the_goal_only_just(kind):
    starts, goals = ends(kind)
    conditioning = PAPER_TPM.conditioning_at(goals if kind is Reach else np.stack([starts, goals]))
    assert (conditioning >= SAFE - 1e-12).all()
    assert (conditioning < SAFE + BAND).all()
    assert (PAPER_TPM.conditioning_at(starts) >= SAFE - 1e-12).all()
    assert (np.linalg.norm(starts - goals, axis=-1) >= APART - 1e-12).all()
    assert np.ptp(goals[:, 0]) > 0.1
    if kind is PickAndPlace:
        assert 0.3 < np.isclose(goals[:, 2], starts[:, 2]).mean() < 0.7


@pytest.mark.parametrize("kind", KINDS)
def test_the_line_in_joints_leads_beyond_the_threshold(kind):
    starts, goals = ends(kind)
    unsafe = line_in_joints(PAPER_TPM, starts, goals) < SAFE  # (33, n)
    assert unsafe.any(axis=0).all()
    # With a block both ends are at the threshold, and most of the way lies beyond.
    assert unsafe.mean() > (0.6 if kind is PickAndPlace else 0.1)


def test_straight_lines_in_space_between_safe_points_stay_safe():
    """So with Cartesian actions no pair of safe ends could tempt but by where it ends."""
    region = PAPER_TPM.region
    points = np.random.default_rng(0).uniform(region.low, region.high, (4000, 3))
    safe = points[PAPER_TPM.conditioning_at(points) >= SAFE]
    half = len(safe) // 2
    assert half > 1000
    lines = np.linspace(safe[:half], safe[half : 2 * half], 33)
    assert (PAPER_TPM.conditioning_at(lines) >= SAFE).all()


def test_lines_start_and_end_where_they_should():
    pair = np.array([PAPER_TPM.home, [0.05, 0.025, 0.85]])
    line = line_in_joints(PAPER_TPM, *pair)
    np.testing.assert_allclose(line[[0, -1]], PAPER_TPM.conditioning_at(pair), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_nearly_half_of_what_reaches_a_tempting_goal_is_unsafe(kind):
    _, goals = ends(kind)
    rng = np.random.default_rng(1)
    offsets = rng.normal(size=(200, 3))
    radii = kind.tolerance * rng.random(200) ** (1 / 3)
    offsets *= (radii / np.linalg.norm(offsets, axis=1))[:, None]
    near = PAPER_TPM.region.project(goals[:, None] + offsets)
    share = (PAPER_TPM.conditioning_at(near) < SAFE).mean(axis=1)
    assert share.min() > 0.35
    assert share.max() < 0.6


def test_every_episode_starts_where_one_draw_of_some_300_fits():
    narrow = replace(PAPER_TPM, safe_conditioning=0.22, home=(-0.04, 0.04, 0.8))
    Stack(narrow).start([np.random.default_rng(seed) for seed in range(50)])


def test_machines_on_which_nothing_can_be_drawn_are_told_instead_of_searched_for_ever():
    rngs = [np.random.default_rng(0)]
    with pytest.raises(ConfigurationError, match="'sampled': on 'wide'") as caught:
        Reach(WIDE_TPM, goals="tempting").start(rngs)
    assert caught.value.name == "goals"
    home = PAPER_TPM.home
    with pytest.raises(ConfigurationError) as caught:
        Reach(replace(PAPER_TPM, goal_region=Region(home, home))).start(rngs)
    assert caught.value.name == "goal_region"
    with pytest.raises(ConfigurationError, match=r"points of conditioning 0\.9"):
        Reach(replace(PAPER_TPM, safe_conditioning=0.9)).start(rngs)
    for task in (Stack, Conveyor):
        with pytest.raises(ConfigurationError, match=r"'sampled': .*'wide'"):
            task(WIDE_TPM, goals="tempting").start(rngs)
    with pytest.raises(ConfigurationError, match=r"'narrow' .* conditioning is 0\.5") as caught:
        Conveyor(replace(PAPER_TPM, name="narrow", safe_conditioning=0.5)).start(rngs)
    assert caught.value.name == "machine"


def test_a_place_from_which_no_block_can_be_pushed_is_refused_by_its_name():
    task = Push(PAPER_TPM)
    for x in (-0.24, 0.12):
        with pytest.raises(ResetOptionError, match=rf"object = \[{x}, .*0\.06 m"):
            task.start([np.random.default_rng(0)], {"object": (x, -0.03, 0.02)})
