"""A machine is one value: its kinematics agree, its limits are checked, and it is found by name."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st
from machines import anywhere, each_machine, within
from walk import walk

from tpm_gym.arrays import Vector
from tpm_gym.errors import ConfigurationError, SingularityError, TPMError, UnreachableError
from tpm_gym.kinematics import inverse
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import (
    PAPER_TPM,
    TPM,
    WIDE_TPM,
    Machine,
    Mount,
    Region,
    find_machine,
    register_machine,
    tree,
)
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.cup import CUP

share = st.floats(0.0, 1.0)


@each_machine
@examples(100, st.tuples(share, share, share))
def test_kinematics_agree_all_over_the_region(machine: TPM, shares: Vector) -> None:
    point = within(machine, shares)
    theta = machine.inverse(tuple(point.tolist()))
    position, rows, conditioning = machine.evaluate(theta)
    np.testing.assert_allclose(position, point, rtol=0, atol=1e-9)
    assert machine.forward(theta) == position
    assert machine.mode_left(theta, position) is None
    steps = 1e-6 * np.eye(3)
    ends = [[machine.forward(tuple(theta + by)) for by in (step, -step)] for step in steps]
    jacobian = np.array([np.subtract(*pair) / 2e-6 for pair in ends]).T
    np.testing.assert_allclose(rows, jacobian, rtol=1e-5, atol=1e-5)
    assert conditioning == pytest.approx(1 / np.linalg.cond(rows), rel=1e-9)
    positions = machine.joint_positions(theta)
    assert positions == tree.joint_angles(theta, machine.assembly_mode, machine.geometry)
    assert tuple(positions[name] for name in machine.mechanism.actuated) == theta


@each_machine
def test_batched_conditioning_is_that_of_each_point_and_0_where_p_cannot_be(machine: TPM) -> None:
    points = np.array(anywhere(machine, 12)).reshape(3, 4, 3)
    theta = np.array([machine.inverse(point) for point in anywhere(machine, 12)]).reshape(3, 4, 3)
    points[0, 0, 2] = 3.0
    theta[0, 0] = (0.0, np.pi, -2.0)
    for of_points, of_joints in (
        (machine.conditioning_at, machine.conditioning),
        # The loops of the base class, for machines that have nothing faster.
        (
            lambda at: Machine.conditioning_at(machine, at),
            lambda at: Machine.conditioning(machine, at),
        ),
    ):
        for found in (of_points(points), of_joints(theta)):
            assert found.shape == (3, 4)
            assert found[0, 0] == 0
            expected = [
                machine.evaluate(tuple(row)).conditioning for row in theta.reshape(-1, 3)[1:]
            ]
            np.testing.assert_allclose(found.ravel()[1:], expected, rtol=1e-9)


@each_machine
def test_beyond_a_singularity_the_mode_that_was_left_is_named(machine: TPM) -> None:
    x, y, z = machine.home
    theta = machine.inverse(machine.home)
    assert machine.mode_left(theta, (x, -y, z)) == "assembly"
    assert machine.mode_left(theta, (x, y + 0.02, z)) == "assembly"
    assert machine.mode_left((0.0, np.pi, -2.0), machine.home) == "assembly"
    mode = machine.working_mode
    edge = (x, 0.98 * machine.geometry.l7, 0.65)  # near l7, where the two modes meet
    folded = inverse(edge, replace(mode, cos_beta=-mode.cos_beta), machine.geometry)
    assert machine.mode_left(tuple(folded), edge) == "working"
    with pytest.raises(UnreachableError, match="working mode"):
        machine.forward(tuple(folded))


@each_machine
def test_angles_that_were_changed_in_place_are_assembled_anew(machine: TPM) -> None:
    theta: Any = np.array(machine.inverse(machine.home))
    before = machine.evaluate(theta).position
    theta += 1e-3
    after = machine.evaluate(theta).position
    assert after == machine.evaluate(tuple(theta)).position != before


@each_machine
@pytest.mark.parametrize("place", [0, 1])
def test_boxes_hold_platform_and_cup_and_no_more(machine: TPM, place: int) -> None:
    point = anywhere(machine, 2)[place]
    mechanism = machine.mechanism
    frames = walk(mechanism, machine.joint_positions(machine.inverse(point)))
    boxes = iter(machine.occupied(point))
    for name in (mechanism.platform, mechanism.tool):
        origin, rotation = frames[name]
        for solid in mechanism.link(name).solids:
            low, high = next(boxes)
            at = origin + surface(solid) @ rotation.T
            world = machine.mount.to_world(at)
            np.testing.assert_allclose(world.min(axis=0), low, atol=1e-9)
            np.testing.assert_allclose(world.max(axis=0), high, atol=1e-9)
    assert next(boxes, None) is None


def surface(solid: Any) -> np.ndarray:
    """The corners of a box, points of the rims of a cylinder, in the link's frame, m."""
    signs = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3)
    if solid.kind == "box":
        return np.asarray(solid.centre + signs * np.array(solid.size) / 2)
    radius, length, _ = solid.size
    along = "xyz".index(solid.axis)
    turn = np.arange(8) * np.pi / 4
    rim = np.zeros((2, 8, 3))
    rim[..., along] = np.array([[-length / 2], [length / 2]])
    rim[..., (along + 1) % 3], rim[..., (along + 2) % 3] = (
        radius * np.cos(turn),
        radius * np.sin(turn),
    )
    return np.asarray(rim.reshape(-1, 3) + solid.centre)


# -- what is refused -------------------------------------------------------------------------------

LOW, HIGH = PAPER_TPM.region.low, PAPER_TPM.region.high


@pytest.mark.parametrize(
    ("name", "value", "valid"),
    [
        ("home", (0.0, 0.1, 0.8), "inside the region"),
        ("home", (0.0, np.nan, 0.8), "three finite numbers"),
        ("home", (0.0, 0.03), "three finite numbers"),
        ("goal_region", Region((-0.3, *LOW[1:]), HIGH), "inside the region"),
        ("goal_region", Region(LOW, (*HIGH[:2], 0.95)), "inside the region"),
        ("step_limit", (0.03, 0.0, 0.03), "positive"),
        ("joint_limit", -0.08, "positive"),
        *(("joint_limit", value, "number") for value in (np.nan, np.inf, "much")),
        ("table", (0.45, 0.0), "positive"),
        *(("table", value, "numbers") for value in ((0.4,), (0.4, 0.3, 0.2), (np.inf, 0.3), None)),
        *((name, 3, "a Region") for name in ("region", "goal_region")),
        ("mount", 0.97, "a Mount"),
        ("geometry", 3, "a tpm_gym.Geometry"),
        ("safe_conditioning", 1.5, "1"),
        ("region", Region((LOW[0], -0.02, LOW[2]), HIGH), "beyond a singularity"),
        ("mount", Mount(height=0.9229), "0.923 m or more"),
    ],
)
def test_a_machine_on_which_no_episode_could_run_is_refused_by_name(
    name: str, value: Any, valid: str
) -> None:
    with pytest.raises(ConfigurationError, match=valid) as caught:
        replace(PAPER_TPM, **{name: value})
    assert caught.value.name == name


def test_a_machine_of_arrays_is_that_of_tuples() -> None:
    region = Region(np.array(LOW), np.array(HIGH))  # type: ignore[arg-type]
    values: Any = {"home": np.array(PAPER_TPM.home), "table": list(PAPER_TPM.table)}
    made = replace(PAPER_TPM, region=region, **values)
    assert made == PAPER_TPM
    assert hash(made) == hash(PAPER_TPM)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 10**400, "high", (1.0,)])
def test_a_height_that_cannot_be_is_refused(value: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        Mount(value)
    assert caught.value.name == "height"


@pytest.mark.parametrize(("name", "value"), [("", PAPER_TPM), (3, PAPER_TPM), ("mine", "paper")])
def test_what_is_no_machine_is_not_registered(name: Any, value: Any) -> None:
    with pytest.raises(ConfigurationError) as caught:
        register_machine(name, value)
    assert caught.value.name == ("machine" if name == "mine" else "name")


@pytest.mark.parametrize(
    ("high", "leg"), [((0.12, 0.07, 0.903), "beta"), ((0.12, 0.046, 1.5), "leg")]
)
def test_a_region_out_of_reach_is_refused_with_what_fails_where(high: Vector, leg: str) -> None:
    with pytest.raises(UnreachableError, match=leg) as caught:
        replace(PAPER_TPM, region=Region(LOW, high))
    assert caught.value.point[1:] in {(high[1], z) for z in (LOW[2], high[2])} | {(LOW[1], high[2])}
    assert caught.value.margin < 0
    assert "the machine's region" in str(caught.value)


@dataclass(frozen=True, kw_only=True)
class Stopped(TPM):
    """With another stop for the lifted arm 5."""

    stop: float

    @cached_property
    def mechanism(self) -> Mechanism:
        whole = tree.build(self.geometry)
        links = [
            replace(link, joint=replace(link.joint, upper=self.stop))
            if link.joint and link.joint.name == "R21"
            else link
            for link in whole.links
        ]
        return replace(whole, links=tuple(links))


def test_a_region_or_home_beyond_a_stop_is_refused_and_the_stop_is_named() -> None:
    region = WIDE_TPM.region
    farthest = max(WIDE_TPM.inverse(corner)[1] for corner in region.corners())
    grid = [
        tuple(within(WIDE_TPM, shares).tolist()) for shares in product((0, 0.25, 0.5, 1), repeat=3)
    ]
    inside = max(grid, key=lambda point: WIDE_TPM.inverse(point)[1])
    assert WIDE_TPM.inverse(inside)[1] > farthest + 1e-3  # the corners are not all
    values = {field.name: getattr(WIDE_TPM, field.name) for field in fields(WIDE_TPM)}
    Stopped(**values, stop=farthest)
    for name, stop, home in (
        ("region", farthest - 1e-6, WIDE_TPM.home),
        ("home", farthest, inside),
    ):
        with pytest.raises(ConfigurationError, match="R21 cannot be at") as caught:
            Stopped(**{**values, "home": home}, stop=stop)
        assert caught.value.name == name


@each_machine
def test_the_whole_region_is_between_the_stops(machine: TPM) -> None:
    for shares in product(np.linspace(0, 1, 9), repeat=3):
        machine.require_within_stops(machine.inverse(tuple(within(machine, shares).tolist())))


def test_where_there_is_no_posture_the_errors_say_so() -> None:
    with pytest.raises(UnreachableError):
        PAPER_TPM.inverse((0.0, 0.03, 3.0))
    for ask in (PAPER_TPM.evaluate, PAPER_TPM.forward, PAPER_TPM.joint_positions):
        with pytest.raises(UnreachableError):
            ask((0.0, np.pi, -2.0))
    with pytest.raises((SingularityError, UnreachableError)):
        PAPER_TPM.evaluate(PAPER_TPM.inverse((0.0, 0.0, 0.8)))


def test_sampling_keeps_to_the_safe_part_and_says_where_there_is_none() -> None:
    rng = np.random.default_rng(0)
    points = [PAPER_TPM.sample(rng, PAPER_TPM.region) for _ in range(100)]
    assert PAPER_TPM.region.contains(points).all()
    assert PAPER_TPM.conditioning_at(points).min() >= PAPER_TPM.safe_conditioning
    strict = replace(PAPER_TPM, safe_conditioning=0.9)
    with pytest.raises(ConfigurationError, match="safe_conditioning"):
        strict.sample(rng, strict.region)


# -- other machines --------------------------------------------------------------------------------


def scaled(factor: float) -> TPM:
    """A user's own: the paper's, larger."""

    def times(*values: float) -> Any:
        return tuple(factor * value for value in values)

    return TPM(
        name="mine",
        geometry=Geometry(*times(*vars(PAPER).values())),
        mount=Mount(height=factor * PAPER_TPM.mount.height),
        region=Region(times(*LOW), times(*HIGH)),
        goal_region=Region(times(*PAPER_TPM.goal_region.low), times(*PAPER_TPM.goal_region.high)),
        home=times(*PAPER_TPM.home),
    )


def test_lengths_of_a_user_s_own_make_a_machine() -> None:
    mine = scaled(1.25)
    for point in anywhere(PAPER_TPM, 10):
        theta = PAPER_TPM.inverse(point)
        larger = (1.25 * point[0], 1.25 * point[1], 1.25 * point[2])
        np.testing.assert_allclose(mine.inverse(larger), theta, atol=1e-12)
        np.testing.assert_allclose(mine.forward(theta), larger, atol=1e-12)
        conditioning = PAPER_TPM.evaluate(theta).conditioning
        assert mine.evaluate(theta).conditioning == pytest.approx(conditioning)
    longer = tuple(length + 1e-3 for length in mine.lengths)
    assert mine.with_lengths(longer) == replace(mine, geometry=Geometry(*longer))
    with pytest.raises(TPMError, match="l4"):
        mine.with_lengths((0.3, 0.07, 0.35, -0.8, 0.1, 0.01, 0.05))


def test_at_the_least_height_the_cup_is_pushed_in_as_far_as_it_goes() -> None:
    mount = Mount(height=0.923)
    lip = replace(PAPER_TPM, mount=mount).mount.to_world(HIGH) - np.array(CUP.lip)
    assert lip[2] == pytest.approx(-CUP.stroke)


def test_machines_are_found_by_name() -> None:
    assert find_machine("paper") is find_machine(PAPER_TPM) is PAPER_TPM
    assert find_machine("wide") is WIDE_TPM
    made: list[TPM] = []
    register_machine("larger", lambda: made.append(scaled(1.1)) or made[-1])
    assert not made  # until it is asked for
    assert find_machine("larger") is made[-1]
    with pytest.raises(ConfigurationError, match="paper"):
        register_machine("wide", PAPER_TPM)
    register_machine("wide", WIDE_TPM)
    for unknown in ("Paper", "", None, 3, PAPER):
        with pytest.raises(ConfigurationError, match="'paper', 'wide'") as caught:
            find_machine(unknown)
        assert (caught.value.name, caught.value.value) == ("machine", unknown)
        assert ("replace(tpm_gym.PAPER_TPM, geometry=" in caught.value.valid) == (unknown is PAPER)
