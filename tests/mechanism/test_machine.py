"""A machine is one value: its kinematics agree, its limits are checked, and it is found by name."""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pytest
from machines import anywhere, each_machine, within
from walk import walk

from tpm_gym.errors import (
    ConfigurationError,
    JointLimitError,
    SingularityError,
    TPMError,
    UnreachableError,
)
from tpm_gym.kinematics import DEFAULT_ASSEMBLY, inverse
from tpm_gym.kinematics.geometry import PAPER, Geometry
from tpm_gym.mechanism import (
    PAPER_TPM,
    TPM,
    WIDE_TPM,
    Mount,
    Region,
    find_machine,
    register_machine,
)
from tpm_gym.mechanism.bodies import Mechanism
from tpm_gym.mechanism.cup import CUP
from tpm_gym.mechanism.machine import MODES
from tpm_gym.mechanism.tpm.bodies import build, joint_angles


@each_machine
def test_kinematics_agree_all_over_the_region(machine):
    points = np.array(anywhere(machine, 100))
    theta = machine.require_inverse(points)
    position, rows, conditioning, working = machine.require_evaluate(theta)
    np.testing.assert_allclose(position, points, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(machine.forward(theta), position)
    assert working.all()
    assert machine.same_side(points).all()
    assert not machine.mode_left(theta, position).any()
    steps = 1e-6 * np.eye(3)
    columns = [(machine.forward(theta + s) - machine.forward(theta - s)) / 2e-6 for s in steps]
    np.testing.assert_allclose(rows, np.stack(columns, axis=-1), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(conditioning, 1 / np.linalg.cond(rows), rtol=1e-9)
    one = tuple(theta[0].tolist())
    positions = machine.joint_positions(one)
    assert positions == joint_angles(one, machine.assembly_mode, machine.geometry)
    assert tuple(positions[name] for name in machine.mechanism.actuated) == one


@each_machine
def test_conditioning_is_0_where_p_cannot_be(machine):
    points = np.array(anywhere(machine, 12)).reshape(3, 4, 3)
    theta = machine.inverse(points)
    expected = machine.evaluate(theta).conditioning
    expected[0, 0] = 0.0
    points[0, 0, 2] = 3.0
    theta[0, 0] = (0.0, np.pi, -2.0)
    for found in (machine.conditioning_at(points), machine.conditioning(theta)):
        np.testing.assert_allclose(found, expected, rtol=1e-9)


@each_machine
def test_beyond_a_singularity_the_mode_that_was_left_is_named(machine):
    x, y, z = machine.home
    theta, mode = machine.inverse(machine.home), machine.working_mode
    edge = (x, 0.98 * machine.geometry.l7, 0.65)  # near l7, where the two modes meet
    folded = inverse(edge, replace(mode, cos_beta=-mode.cos_beta), machine.geometry)
    cases: list[tuple[Any, Any, str | None]] = [
        (theta, machine.home, None),
        (theta, (x, -y, z), "assembly"),
        (theta, (x, y + 0.02, z), "assembly"),
        ((0.0, np.pi, -2.0), machine.home, "assembly"),
        (theta, (np.nan, y, z), "assembly"),
        (folded, edge, "working"),
    ]
    joints, points, modes = zip(*cases, strict=True)
    left = machine.mode_left(np.array(joints), np.array(points))
    assert [MODES[k] for k in left] == list(modes)
    assert machine.same_side([machine.home, (x, -y, z)]).tolist() == [True, False]
    assert np.isnan(machine.forward(folded)).all()
    assert "working mode" in str(machine.unassembled(folded))


@each_machine
@pytest.mark.parametrize("place", [0, 1])
def test_boxes_hold_platform_and_cup_and_no_more(machine, place):
    point = anywhere(machine, 2)[place]
    mechanism = machine.mechanism
    frames = walk(mechanism, machine.joint_positions(tuple(machine.inverse(point))))
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
        ("working_mode", DEFAULT_ASSEMBLY, "a tpm_gym.kinematics.WorkingMode"),
        ("assembly_mode", (-1, 1), "a tpm_gym.kinematics.AssemblyMode"),
        ("safe_conditioning", 1.5, "1"),
        ("region", Region((LOW[0], -0.02, LOW[2]), HIGH), "beyond a singularity"),
        ("mount", Mount(height=0.9229), "0.923 m or more"),
    ],
)
def test_a_machine_on_which_no_episode_could_run_is_refused_by_name(name, value, valid):
    with pytest.raises(ConfigurationError, match=valid) as caught:
        replace(PAPER_TPM, **{name: value})
    assert caught.value.name == name


def test_a_machine_of_arrays_is_that_of_tuples():
    region = Region(np.array(LOW), np.array(HIGH))
    values = {"home": np.array(PAPER_TPM.home), "table": list(PAPER_TPM.table)}
    made = replace(PAPER_TPM, region=region, **values)
    assert made == PAPER_TPM
    assert hash(made) == hash(PAPER_TPM)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 10**400, "high", (1.0,)])
def test_a_height_that_cannot_be_is_refused(value):
    with pytest.raises(ConfigurationError) as caught:
        Mount(value)
    assert caught.value.name == "height"


@pytest.mark.parametrize(("name", "value"), [("", PAPER_TPM), (3, PAPER_TPM), ("mine", "paper")])
def test_what_is_no_machine_is_not_registered(name, value):
    with pytest.raises(ConfigurationError) as caught:
        register_machine(name, value)
    assert caught.value.name == ("machine" if name == "mine" else "name")


@pytest.mark.parametrize(
    ("high", "leg"), [((0.12, 0.07, 0.903), "beta"), ((0.12, 0.046, 1.5), "leg")]
)
def test_a_region_out_of_reach_is_refused_with_what_fails_where(high, leg):
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
        whole = build(self.geometry)
        links = [
            replace(link, joint=replace(link.joint, upper=self.stop))
            if link.joint and link.joint.name == "R21"
            else link
            for link in whole.links
        ]
        return replace(whole, links=tuple(links))


def test_a_region_or_home_beyond_a_stop_is_refused_and_the_stop_is_named():
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
def test_the_whole_region_is_between_the_stops(machine):
    shares = list(product(np.linspace(0, 1, 9), repeat=3))
    theta = machine.inverse(within(machine, shares))
    machine.require_within_stops(theta)
    theta[500, 1] = 7.0
    with pytest.raises(JointLimitError, match="R21 cannot be at 7 rad"):
        machine.require_within_stops(theta)


def test_the_first_row_without_a_solution_is_explained():
    apart, flat = (0.0, np.pi, -2.0), PAPER_TPM.inverse((0.0, 0.0, 0.8))
    home = PAPER_TPM.inverse(PAPER_TPM.home)
    with pytest.raises(UnreachableError, match="leg") as caught:
        PAPER_TPM.require_inverse([PAPER_TPM.home, (0.0, 0.03, 3.0), (0.0, 1.0, 0.8)])
    assert caught.value.point == (0.0, 0.03, 3.0)
    assert caught.value.index == (1,)
    with pytest.raises(UnreachableError, match="loop") as caught:
        PAPER_TPM.require_evaluate([[home, apart], [flat, home]])
    assert caught.value.point == apart
    assert caught.value.index == (0, 1)
    with pytest.raises((SingularityError, UnreachableError), match="beta"):
        PAPER_TPM.require_evaluate([home, flat])
    with pytest.raises(UnreachableError):
        PAPER_TPM.joint_positions(apart)


def test_a_machine_that_is_defined_again_replaces_the_old_one():
    """As in a notebook whose cell runs a second time; register_task does the same."""
    values = {field.name: getattr(PAPER_TPM, field.name) for field in fields(PAPER_TPM)}
    for attribute in (1, 2):
        anew = type("Mine", (TPM,), {"__module__": __name__, "number": attribute})(**values)
        register_machine("again", anew)
        assert find_machine("again").number == attribute
    with pytest.raises(ConfigurationError, match="a name other than"):
        register_machine("again", replace(anew, payload=1.0))
    for number in (1, 2):

        def make(number=number):
            return replace(PAPER_TPM, payload=float(number))

        register_machine("made again", make)
        assert find_machine("made again").payload == number
    with pytest.raises(ConfigurationError, match="a name other than"):
        register_machine("made again", anew)


# -- other machines --------------------------------------------------------------------------------


def scaled(factor: float) -> TPM:
    """A user's own: the paper's, larger."""

    def times(*values):
        return tuple(factor * value for value in values)

    return TPM(
        name="mine",
        geometry=Geometry(*times(*PAPER.lengths)),
        mount=Mount(height=factor * PAPER_TPM.mount.height),
        region=Region(times(*LOW), times(*HIGH)),
        goal_region=Region(times(*PAPER_TPM.goal_region.low), times(*PAPER_TPM.goal_region.high)),
        home=times(*PAPER_TPM.home),
    )


def test_lengths_of_a_user_s_own_make_a_machine():
    mine = scaled(1.25)
    points = np.array(anywhere(PAPER_TPM, 10))
    theta = PAPER_TPM.inverse(points)
    np.testing.assert_allclose(mine.inverse(1.25 * points), theta, atol=1e-12)
    np.testing.assert_allclose(mine.forward(theta), 1.25 * points, atol=1e-12)
    conditioning = PAPER_TPM.evaluate(theta).conditioning
    np.testing.assert_allclose(mine.evaluate(theta).conditioning, conditioning)
    longer = tuple(length + 1e-3 for length in mine.lengths)
    assert mine.with_lengths(longer) == replace(mine, geometry=Geometry(*longer))
    with pytest.raises(TPMError, match="l4"):
        mine.with_lengths((0.3, 0.07, 0.35, -0.8, 0.1, 0.01, 0.05))


def test_at_the_least_height_the_cup_is_pushed_in_as_far_as_it_goes():
    mount = Mount(height=0.923)
    lip = replace(PAPER_TPM, mount=mount).mount.to_world(HIGH) - np.array(CUP.lip)
    assert lip[2] == pytest.approx(-CUP.stroke)


def test_machines_are_found_by_name():
    assert find_machine("paper") is find_machine(PAPER_TPM) is PAPER_TPM
    assert find_machine("wide") is WIDE_TPM
    made: list[TPM] = []
    register_machine("larger", lambda: made.append(scaled(1.1)) or made[-1])
    assert not made  # until it is asked for
    assert find_machine("larger") is made[-1]
    assert find_machine("larger") is made[0]  # it is called once
    assert len(made) == 1
    with pytest.raises(ConfigurationError, match="paper"):
        register_machine("wide", PAPER_TPM)
    register_machine("wide", replace(WIDE_TPM))  # equal
    for unknown in ("Paper", "", None, 3, PAPER):
        with pytest.raises(ConfigurationError, match="'paper', 'wide'") as caught:
            find_machine(unknown)
        assert (caught.value.name, caught.value.value) == ("machine", unknown)
        assert ("replace(tpm_gym.PAPER_TPM, geometry=" in caught.value.valid) == (unknown is PAPER)
