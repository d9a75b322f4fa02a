"""Pictures of running episodes from a simulator's own cameras."""

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers import scenario_or_skip

from clbench.base.errors import ClbenchError, InputError, UnknownNameError
from clbench.evaluation.episodes import LANES, Trial
from clbench.evaluation.players import play_chunks
from clbench.evaluation.views import SimulatorCameras
from clbench.spec.registry import load_scenario
from clbench.testing import TOY
from clbench.worlds.lanes import Lanes

TASK = load_scenario("clbench/Fetch-v1").task("push_right")
CAMERAS = ("external_camera_0", "gripper_camera_rgb")


@pytest.fixture
def lanes() -> Iterator[Lanes]:
    """Yield two running episodes of Fetch, with the block in different places."""
    lanes = Lanes(2)
    lanes.reset([0, 1], [3, 4], [TASK, TASK])
    yield lanes
    lanes.close()


@pytest.fixture
def cameras() -> Iterator[SimulatorCameras]:
    cameras = SimulatorCameras(CAMERAS, size=48)
    yield cameras
    cameras.close()


def test_the_pictures_of_a_lane_are_those_that_mujoco_draws_of_it_upright(
    lanes: Lanes, cameras: SimulatorCameras
) -> None:
    drawn = [cameras.draw(lanes, lane, TASK) for lane in (0, 1)]
    world: Any = lanes.world(TASK)
    for lane, pictures in enumerate(drawn):
        model, data, _ = world.drawable(lane)
        assert tuple(pictures) == CAMERAS
        with mujoco.Renderer(model, 48, 48) as renderer:
            for name, picture in pictures.items():
                assert (picture.shape, picture.dtype.name) == ((48, 48, 3), "uint8")
                renderer.update_scene(data, camera=name)
                assert np.array_equal(picture, renderer.render())
    first, second = (pictures["external_camera_0"] for pictures in drawn)
    assert not np.array_equal(first, second)


def test_drawing_changes_no_step(lanes: Lanes, cameras: SimulatorCameras) -> None:
    other = Lanes(2)
    other.reset([0, 1], [3, 4], [TASK, TASK])
    generator = np.random.default_rng(0)
    for _ in range(5):
        actions = generator.uniform(-1, 1, (2, 4)).astype(np.float32)
        for lane in (0, 1):
            cameras.draw(lanes, lane, TASK)
        (found, *_), (expected, *_) = (some.step([0, 1], actions) for some in (lanes, other))
        assert np.array_equal(found, expected)
    other.close()


@pytest.mark.parametrize(
    ("cameras", "size", "error", "message"),
    [
        (
            ["external_camera"],
            48,
            UnknownNameError,
            "camera in the scenes of all tasks .* 'external_camera_0'",
        ),
        (["lidar"], 481, InputError, "draw pictures of at most 480 pixels, not 481"),
    ],
)
def test_a_picture_that_the_scene_does_not_have_is_refused(
    cameras: list[str], size: int, error: type[ClbenchError], message: str
) -> None:
    with pytest.raises(error, match=message):
        SimulatorCameras(cameras, size).check([TASK])


@pytest.mark.parametrize(
    ("cameras", "size", "error", "message"),
    [
        (["lidar", "lidar"], 48, InputError, "each named once"),
        ([1], 48, InputError, "each named once"),
        (["lidar"], 0, InputError, "picture_size must be a whole number"),
        (["lidar"], "48", InputError, "picture_size must be a whole number"),
        (["lidar"], None, InputError, "picture_size must be a whole number from 1, not None"),
    ],
)
def test_cameras_and_sizes_that_mean_nothing_are_refused(
    cameras: Any, size: Any, error: type[ClbenchError], message: str
) -> None:
    with pytest.raises(error, match=message):
        SimulatorCameras(cameras, size)


def test_a_world_that_nobody_can_draw_is_named() -> None:
    task = TOY.target[0]
    message = f"{task.name!r} has no pictures: the vector world of .*ToyWorld has no drawable"
    with pytest.raises(InputError, match=message):
        SimulatorCameras(["front"]).check([task])


def test_a_policy_that_acts_on_a_real_scene_gets_its_pictures() -> None:
    scenario = load_scenario("clbench/Fetch-v1")
    trials = [Trial(TASK, "validation", number) for number in range(2)]
    seen: list[dict[str, Any]] = []

    def act(observations: dict[str, Any]) -> Any:
        seen.append(observations)
        return np.zeros((LANES, TASK.horizon, 4))

    with closing(SimulatorCameras(CAMERAS, 32)) as cameras:
        play_chunks(act, scenario, trials, 0, cameras=cameras)
    (observations,) = seen
    pictures = observations["pictures/external_camera_0"]
    assert (pictures.shape, pictures.dtype.name) == ((LANES, 32, 32, 3), "uint8")
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])  # an unused row


def test_scenes_without_a_common_camera_are_refused() -> None:
    skills = scenario_or_skip("clbench/DMControl-v0").retained
    with pytest.raises(InputError, match="no camera 'fixed': the scenes of the tasks share no camera"):
        SimulatorCameras(["fixed"]).check(skills)


def test_without_a_camera_a_record_keeps_no_setting() -> None:
    assert SimulatorCameras(()).settings == {}
    assert SimulatorCameras(["agentview"]).settings == {"pictures": ["agentview"], "picture_size": 224}
