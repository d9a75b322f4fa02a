"""The pixel scenario: its world, its camera and its questions."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers import back_end_or_skip
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.language import spelled_words
from clbench.spec.registry import load_scenario
from clbench.worlds.observation import Observer
from clbench.worlds.scenario_env import ScenarioEnv

SCENARIO = load_scenario("clbench:clbench/FetchPixels-v0")
FETCH = load_scenario("clbench:clbench/Fetch-v1")
QUESTIONS = {kind.name: kind for kind in resolve(SCENARIO.questions)}
WORLD, CAMERA = SCENARIO.tasks[0].world, SCENARIO.tasks[0].camera
World = resolve(WORLD)

State = NDArray[np.float32]
Images = NDArray[np.uint8]

BLOCK, TARGET, JOINTS, THINGS = slice(3, 6), slice(25, 28), slice(28, 50), slice(50, 56)
OWN = np.r_[0:3, 9:11, 20:25, 28:43]
"""The part of a state that is the robot's: its gripper, its fingers, their velocities and its joints."""
COLOURS = ("green", "blue", "yellow", "purple")


@pytest.fixture(scope="module")
def observer() -> Iterator[Observer]:
    """Return the observer of the pixel world, or skip without graphics."""
    back_end_or_skip()
    observer = Observer(WORLD, CAMERA)
    yield observer
    observer.close()


def _start(seed: int, task: str = "push") -> State:
    state, _ = World().reset(seed=seed, options={"task": task})
    return np.asarray(state)


def _shown(colour: str, image: Images) -> NDArray[np.bool_]:
    """Return the pixels of an image (64, 64, 3) with a colour: red, green, blue, yellow or purple."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    others = {
        "red": red - np.maximum(green, blue),
        "green": green - np.maximum(red, blue),
        "blue": blue - np.maximum(red, green),
        "yellow": np.minimum(red, green) - blue,
        "purple": np.minimum(red, blue) - green,
    }
    return np.asarray(others[colour] > 50)


def _place(images: Images) -> NDArray[np.float64]:
    """Return the rows and columns of the target in all images, (2, N)."""
    return np.array([np.mean(np.nonzero(_shown("red", image)), axis=1) for image in images]).T


def test_every_target_is_on_the_table_and_no_demonstrations_are_fetchs() -> None:
    assert not {task.dataset_id for task in SCENARIO.tasks} & {task.dataset_id for task in FETCH.tasks}
    heights = [_start(seed, task.name)[TARGET][2] for seed in range(5) for task in SCENARIO.tasks]
    assert np.ptp(heights) < 1e-3


def test_an_episode_equals_fetchs_bit_for_bit() -> None:
    plain, expert = resolve(FETCH.tasks[0].world)(), resolve(FETCH.tasks[0].expert)("push")
    world, success = World(), False
    state, other = (one.reset(seed=6, options={"task": "push"})[0] for one in (plain, world))
    first = other
    while not success:
        assert np.array_equal(other[:28], state)
        assert np.array_equal(other[THINGS], first[THINGS])
        action = expert(state)
        (state, reward, success, *_), (other, *its) = plain.step(action), world.step(action)
        assert its[:2] == [reward, success]
    assert np.array_equal(other[:28], state)
    assert np.abs(other[BLOCK] - first[BLOCK]).max() > 0.1  # it was pushed


def test_things_are_apart_in_two_colours_and_follow_from_the_seed() -> None:
    starts = np.stack([_start(seed) for seed in range(40)])
    assert np.array_equal(starts[7], _start(7))
    things = starts[:, THINGS].reshape(-1, 2, 3)
    fixed = [starts[:, None, thing][..., :2] for thing in (BLOCK, TARGET)]
    places = np.concatenate([things[:, :, :2], *fixed], axis=1)
    ways = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)[:, :2]
    assert (ways[ways > 0] >= 0.0999).all()
    assert (things[:, 0, 2] != things[:, 1, 2]).all()
    assert set(things[:, :, 2].ravel()) == {0, 1, 2, 3}


def test_a_picture_shows_the_target_and_both_things_and_no_other_colour(observer: Observer) -> None:
    starts = np.stack([_start(seed) for seed in range(12)])
    numbers, images = observer.observe(starts)
    assert numbers.shape == (12, 10)
    assert images.shape == (12, 64, 64, 3)
    for state, image in zip(starts, images, strict=True):
        there = {COLOURS[int(number)] for number in state[THINGS][2::3]}
        assert _shown("red", image).sum() >= 3
        assert {colour for colour in COLOURS if _shown(colour, image).sum() >= 3} == there


def test_eyes_learn_the_places_of_block_target_and_things() -> None:
    state = _start(3)[None]
    swapped = state.copy()
    swapped[0, THINGS] = state[0, THINGS].reshape(2, 3)[::-1].ravel()
    camera = resolve(str(CAMERA))
    (places_seen,), (again,) = camera.pictured(state), camera.pictured(swapped)
    assert np.array_equal(places_seen, again)  # the things differ only in their places
    places = state[0, THINGS].reshape(2, 3)[:, :2]
    right, left = places[places[:, 1].argsort()]
    np.testing.assert_array_equal(places_seen, [*state[0, BLOCK], *state[0, TARGET][:2], *right, *left])


def test_the_numbers_of_a_policy_depend_on_the_robot_alone() -> None:
    state = _start(3)
    moved = state + np.float32(0.05)
    moved[OWN] = state[OWN]
    numbers, its_numbers = resolve(str(CAMERA)).proprioception(np.stack([state, moved]))
    assert np.array_equal(numbers, its_numbers)


def test_a_picture_follows_the_block_and_the_target(observer: Observer) -> None:
    state = _start(3)
    block, target = state.copy(), state.copy()
    block[JOINTS][15] += 0.04  # x of the block's joint
    target[TARGET][1] += 0.04
    _, (image, block_moved, target_moved) = observer.observe(np.stack([state, block, target]))
    assert (image != block_moved).any()
    columns = [np.nonzero(_shown("red", one))[1].mean() for one in (image, target_moved)]
    assert columns[1] - columns[0] > 1.5


@pytest.mark.long
def test_a_picture_depends_on_its_state_alone(observer: Observer) -> None:
    starts = np.stack([_start(seed) for seed in range(4)])
    together, backwards = observer.observe(starts)[1], observer.observe(starts[::-1])[1]
    other = Observer(WORLD, CAMERA, processes=2)
    assert np.array_equal(together, backwards[::-1])
    assert np.array_equal(together, other.observe(starts)[1])
    other.close()


def test_a_perturbed_view_moves_the_target_by_pixels_and_changes_the_light(observer: Observer) -> None:
    states = np.stack([_start(seed) for seed in range(6)])
    whole = np.eye(4, dtype=np.float32)
    _, plain = observer.observe(states)
    for view in (*whole[:3], *-whole[:3]):
        _, images = observer.observe(states, np.tile(view, (6, 1)))
        moved = np.hypot(*(_place(images) - _place(plain)))
        assert 0.3 < moved.max() < 3.5
    darker, lighter = (observer.observe(states, np.tile(sign * whole[3], (6, 1)))[1] for sign in (-1, 1))
    assert (darker <= plain).all()
    assert (plain <= lighter).all()
    assert darker.mean() < 0.97 * plain.mean() < 0.97 * lighter.mean()
    assert np.array_equal(observer.observe(states)[1], plain)


@pytest.mark.long
def test_an_agent_of_the_scenario_sees_the_picture(observer: Observer) -> None:
    env = ScenarioEnv(SCENARIO)
    observation, _ = env.reset(seed=1, options={"task": "lift"})
    assert observation["state"].shape == (10,)
    observation, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert _shown("red", observation["image"]).any()
    env.close()


# ---- questions ---------------------------------------------------------------------------------------------


def _scene(left: int, right: int, left_y: float = 0.80, right_y: float = 0.70) -> State:
    """Return a state (1, 56) with two things; the block is on the left, the target on the right."""
    state = np.zeros((1, 56), np.float32)
    state[0, BLOCK], state[0, TARGET] = (1.30, 0.90, 0.425), (1.30, 0.60, 0.425)
    state[0, THINGS] = (1.30, right_y, right, 1.30, left_y, left)
    return state


def _answer(name: str, state: State) -> str | None:
    kind = QUESTIONS[name]
    (index,) = kind.answer(state)
    return None if index < 0 else kind.answers[index]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("colour_left", "yellow"),
        ("colour_right", "blue"),
        ("colour_near_block", "yellow"),
        ("colour_near_target", "blue"),
    ],
)
def test_questions_name_colours_by_place(name: str, expected: str) -> None:
    assert _answer(name, _scene(COLOURS.index("yellow"), COLOURS.index("blue"))) == expected
    assert _answer(name, _scene(2, 1, left_y=0.76, right_y=0.74)) is None


def test_no_question_can_be_answered_from_the_robots_own_measurements() -> None:
    starts = np.stack([_start(seed, "reach") for seed in range(40)])
    starts[::2, BLOCK.start + 2] += 0.1  # every second block is in the air
    measured = resolve(str(CAMERA)).proprioception(starts)
    assert np.ptp(measured, axis=0).tolist() == [0.0] * 10
    for kind in QUESTIONS.values():  # from equal measurements, each answer is right at times
        assert {*kind.answer(starts).tolist()} - {-1} == {*range(len(kind.answers))}, kind.name


def test_all_words_are_in_the_vocabulary() -> None:
    texts: list[Any] = [wording for kind in QUESTIONS.values() for wording in kind.wordings]
    answers = [answer for kind in QUESTIONS.values() for answer in kind.answers]
    assert spelled_words(texts + answers) == []
