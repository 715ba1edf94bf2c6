"""Pictures in every engine: cameras, goal markers, depth, segmentation, and many environments."""

import contextlib
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drawing import ENGINES, STARTS, drawn
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from tpm_gym import TPMEnv, TPMVectorEnv
from tpm_gym.errors import ConfigurationError, EpisodeError
from tpm_gym.simulation import Camera
from tpm_gym.simulation.imaging import BACKGROUND, CUP, OBJECTS, ROBOT, TABLETOP

FROM_ABOVE = {"target": (0.35, -0.2, 0.0), "distance": 0.5, "pitch": -90.0, "opening": 10.0}
"""The table beside the robot."""


def is_green(image: NDArray[Any]) -> Any:
    """Where the goal marker shines."""
    return image[..., 1].astype(int) - image[..., [0, 2]].max(axis=-1) > 40


def is_red(image: NDArray[Any]) -> Any:
    """Where the block is."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red > 100) & (green < 0.35 * red) & (blue < 0.6 * red)


# -- what one sees ---------------------------------------------------------------------------------


def test_the_default_picture_shows_block_cup_and_goal_from_close_by(engine):
    image = drawn(engine)
    assert (image.shape, image.dtype) == ((480, 640, 3), np.uint8)
    for marked, least in ((is_red(image), 32), (is_green(image), 16)):
        assert np.ptp(np.flatnonzero(marked.any(axis=0))) > least
    ids = drawn(engine, mode="segmentation")
    assert (ids == CUP).sum() > 0.0003 * ids.size
    assert (ids == OBJECTS).sum() > 0.002 * ids.size


@pytest.mark.parametrize("machine", ["paper", "wide"])
def test_cameras_show_the_whole_robot_the_region_and_the_cup(engine, machine):
    options = {"machine": machine, "mode": "segmentation", "width": 160, "height": 120}
    shares = {}
    for camera in ("overview", "table", "cup"):
        ids = drawn(engine, None, camera=camera, **options)
        shares[camera] = [(ids == kind).mean() for kind in (CUP, OBJECTS)]
        edges = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
        if camera == "overview":
            assert not np.isin(edges, (ROBOT, CUP, TABLETOP, OBJECTS)).any()
    assert shares["table"][1] > 3 * shares["overview"][1] > 0
    assert shares["cup"][0] > 3 * shares["table"][0] > 0


def test_the_cup_camera_follows_the_cup(engine):
    env = gym.make(
        "TPMReach-v0", engine=engine, render_mode="segmentation", camera="cup", width=64, height=64
    )
    env.reset(seed=0)
    seen = []
    for _ in range(2):
        frame = env.render()
        seen.append(np.argwhere(frame == CUP).mean(axis=0))
        for _ in range(5):
            env.step(np.array([1.0, 0.0, -1.0]))
    assert np.abs(seen[0] - seen[1]).max() < 1.0  # the cup moves by 0.15 m, 40 pixels


def test_goal_markers_are_as_large_as_the_tolerance_and_seen_through(engine):
    goal = np.array(STARTS["goal"])
    camera = Camera(tuple(goal.tolist()), 0.5, yaw=0.0, pitch=0.0, opening=26.0)
    apart = drawn(engine, camera=camera, width=240, height=240)
    metre = 180 / (2 * 0.5 * np.tan(np.radians(13)))  # pixels; a square picture is widened
    columns = np.flatnonzero(is_green(apart)[120])
    assert np.ptp(columns) + 1 == pytest.approx(0.020 * metre, abs=2)
    assert columns.mean() == pytest.approx(119.5, abs=1)
    behind = {"object": goal + (0.0, 0.005, -0.002), "goal": goal}  # the block, about the marker
    inside = drawn(engine, behind, camera=camera, width=240, height=240)
    centre, beside = inside[120, 120].astype(int), inside[120, 131].astype(int)
    assert is_red(inside)[120, 131]
    assert centre[1] > beside[1] + 30  # green shines through
    assert centre[0] > 60  # and the block is still seen


def test_depth_is_the_distance_along_the_axis_in_metres(engine):
    options = {"camera": FROM_ABOVE, "width": 64, "height": 48}
    depth = drawn(engine, mode="depth_array", **options)
    assert (depth.shape, depth.dtype) == ((48, 64), np.float32)
    np.testing.assert_allclose(depth, 0.5, atol=0.002)  # the table, level with the image
    ids = drawn(engine, mode="segmentation", **options)
    assert (ids == TABLETOP).all()
    level = {**FROM_ABOVE, "target": (0.0, -2.0, 3.0), "pitch": 0.0, "yaw": 180.0}
    assert np.isinf(drawn(engine, mode="depth_array", **{**options, "camera": level})).all()
    colour, also = drawn(engine, mode="rgbd_tuple", **options)
    assert np.array_equal(also, depth)
    assert np.array_equal(colour, drawn(engine, **options))


def test_segmentation_tells_bodies_apart(engine):
    ids = drawn(engine, mode="segmentation")
    assert (ids.shape, ids.dtype) == ((480, 640), np.int32)
    assert set(np.unique(ids)) == {BACKGROUND, TABLETOP, ROBOT, CUP, OBJECTS}
    (_, depth), image = drawn(engine, mode="rgbd_tuple"), drawn(engine)
    assert np.array_equal(depth, drawn(engine, mode="depth_array"))
    assert np.isfinite(depth[ids != BACKGROUND]).all()  # up to the edges
    block = ids == OBJECTS
    assert (is_red(image) & block).sum() > 0.9 * block.sum()


def test_the_table_of_two_blocks_has_one_colour(engine):
    env = gym.make(
        "TPMStack-v0", engine=engine, render_mode="rgb_array", camera=Camera(**FROM_ABOVE)
    )
    env.reset(seed=0)
    image = env.render()
    assert np.ptp(image.reshape(-1, 3), axis=0).max() <= 8


def test_engines_draw_the_same_picture():
    pytest.importorskip("pybullet")
    pytest.importorskip("mujoco")
    images = {}
    with contextlib.suppress(ConfigurationError):  # no OpenGL
        images = {engine: drawn(engine).astype(int) for engine in ENGINES}
    for image in images.values():
        assert np.abs(image - images["pybullet"]).mean() < 8.0  # of 255


def test_bodies_on_the_table_cast_a_shadow_below_them(engine):
    above = {"target": (-0.1, -0.034, 0.0), "distance": 0.6, "pitch": -20.0}
    ids, image = (drawn(engine, mode=mode, camera=above) for mode in ("segmentation", "rgb_array"))
    rows, columns = np.nonzero(ids == OBJECTS)
    row, below = int(rows.max()) + 2, int(columns.mean())  # in front of the block's foot
    assert ids[row, below] == ids[row, below + 150] == TABLETOP
    assert image[row, below].sum() < int(image[row, below + 150].sum()) - 15


def test_pictures_change_nothing(engine):
    ends = []
    for mode in (None, "rgb_array"):
        env = gym.make("TPMPickAndPlace-v0", engine=engine, render_mode=mode, width=32, height=32)
        env.reset(seed=1)
        rng = np.random.default_rng(0)
        for _ in range(20):
            observation, *_ = env.step(rng.uniform(-1, 1, 4))
            env.render()
        ends.append(observation["observation"].tobytes())
    assert ends[0] == ends[1]


def test_a_window_shows_each_step_in_real_time_and_makes_up_for_no_delay(monkeypatch):
    clock, shown = [100.0], list[float]()

    def later(seconds):
        clock[0] += seconds

    def show():
        later(0.01)  # drawing takes a while
        shown.append(clock[0])

    time = SimpleNamespace(perf_counter=lambda: clock[0], sleep=later)
    monkeypatch.setattr("tpm_gym.envs.single.time", time)
    env = TPMEnv(engine="analytic")
    monkeypatch.setattr(env, "render_mode", "human")
    monkeypatch.setattr(env._core, "show", show)
    env.reset(seed=0)
    for step in range(6):
        later(1.0 if step == 3 else 0.01)
        env.step(np.zeros(3))
    np.testing.assert_allclose(np.diff(shown), [0.02, 0.04, 0.04, 1.03, 0.02, 0.04], atol=1e-9)


# -- many environments -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["rgb_array", "depth_array", "rgbd_tuple", "segmentation"])
def test_vector_environments_draw_each_environment(engine, mode):
    options = {"engine": engine, "render_mode": mode, "width": 48, "height": 32}
    envs = gym.make_vec("TPMPickAndPlace-v0", num_envs=3, **options)
    envs.reset(seed=5)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 4))
    for _ in range(3):
        envs.step(actions)
    frames = envs.render()
    assert isinstance(frames, tuple)
    assert len(frames) == 3
    for row, frame in enumerate(frames):
        env = gym.make("TPMPickAndPlace-v0", **options)
        env.reset(seed=5 + row)
        for _ in range(3):
            env.step(actions[row])
        alone = env.render()
        pairs = zip(frame, alone, strict=True)  # of colours and depth, or of rows of pixels
        assert all(np.array_equal(*pair) for pair in pairs)
    envs.close()


def test_a_tile_is_one_picture_of_the_first_environments(engine):
    options = {"engine": engine, "render_mode": "rgb_array", "width": 48, "height": 32}
    envs = TPMVectorEnv("pick_and_place", num_envs=5, **options)
    envs.reset(seed=0)
    frames = envs.render()
    whole = envs.render_tile()
    assert whole.shape == (64, 144, 3)
    for place, frame in enumerate(frames):
        row, column = divmod(place, 3)
        part = whole[32 * row : 32 * (row + 1), 48 * column : 48 * (column + 1)]
        assert np.array_equal(part, frame)
    assert not whole[32:, 96:].any()
    assert envs.render_tile(2, columns=1).shape == (64, 48, 3)
    for wrong in ({"count": 0}, {"columns": 1.5}):
        with pytest.raises(ConfigurationError, match="1 or more"):
            envs.render_tile(**wrong)
    envs.close()
    with pytest.raises(EpisodeError, match="closed"):
        envs.render_tile()
    for mode in (None, "rgbd_tuple"):
        with pytest.raises(ConfigurationError, match=f"render_mode = {mode!r}"):
            TPMVectorEnv(engine=engine, render_mode=mode).render_tile()


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "side"}, r"camera = 'side' .*'table', 'overview', 'cup'"),
        ({"camera": None}, "camera = None"),
        ({"camera": {"distance": 1.0}}, "camera = .*target"),
        ({"camera": {"target": (0, 0), "distance": 1.0}}, "target"),
        ({"camera": {"target": (1e300, 0, 0), "distance": 1.0}}, "target .*10.0 m"),
        ({"camera": {"target": (0, 0, 0), "distance": 0.0}}, "distance = 0.0 .*0.05 to 7.0"),
        ({"camera": {"target": (0, 0, 0), "distance": 1, "pitch": 91}}, "pitch"),
        ({"camera": {"target": (0, 0, 0), "distance": 1, "roll": 0}}, "camera = .*keys among"),
        *(({"width": value}, f"width = {value!r}") for value in (8, 15, 5000, 64.0, "64")),
        ({"height": 2.5}, "height = 2.5"),
        ({"render_mode": "depth"}, "render_mode = 'depth' .*'depth_array', 'rgbd_tuple'"),
        ({"observations": "images"}, "observations = 'images' .*'state' or 'pixels'"),
        ({"observations": "pixels", "pixel_size": 8}, "pixel_size = 8 .*16 to 1024"),
        ({"observations": "pixels", "pixel_size": 84.0}, "pixel_size"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options, message):
    for make in (TPMEnv, TPMVectorEnv):
        with pytest.raises(ConfigurationError, match=message):
            make(**{"engine": "analytic", **options})


def test_there_is_nothing_to_draw_before_the_first_episode(engine):
    env = TPMEnv(engine=engine, render_mode="rgb_array")
    with pytest.raises(EpisodeError, match="reset"):
        env.render()


def test_gymnasium_accepts_all_render_modes(engine):
    env = gym.make("TPMPickAndPlace-v0", engine=engine, width=32, height=24)
    check_env(env.unwrapped)
