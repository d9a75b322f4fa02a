import contextlib
import dataclasses
import functools
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.spec.registry import load_scenario
from clbench.spec.task import Task
from clbench.testing import ToyWorld
from clbench.worlds.lanes import Lanes, PlainVectorWorld, check_perturbable, vector_world

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
LEFT, UP = TOY.task("left"), TOY.task("up")


class OwnVectorWorld(PlainVectorWorld):
    """A suite's own vector world: it remembers the arguments that made it."""

    perturbable = True

    def __init__(self, lanes: int, threads: int, perturbed: bool = False) -> None:
        super().__init__(functools.partial(ToyWorld, perturbed=perturbed), lanes)
        self.made_with = (lanes, threads)


class OtherToyWorld(ToyWorld):
    """The toy world of another suite, which has its own vector world."""

    vector_world = OwnVectorWorld


class SteadyWorld(ToyWorld):
    """The toy world of a suite without perturbations."""

    perturbable = False

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)


class SteadyVectorWorld(PlainVectorWorld):
    """The same, with a vector world of its own."""

    def __init__(self, lanes: int, threads: int) -> None:
        super().__init__(SteadyWorld, lanes)


@pytest.fixture
def other_task(monkeypatch: pytest.MonkeyPatch) -> Task:
    monkeypatch.setattr("clbench.testing.OtherToyWorld", OtherToyWorld, raising=False)
    return dataclasses.replace(UP, world="clbench.testing:OtherToyWorld")


def test_a_suites_own_vector_world_is_found_by_name_and_others_get_plain_worlds(other_task: Task) -> None:
    own = vector_world(other_task.world, lanes=3, threads=2)
    assert isinstance(own, OwnVectorWorld)
    assert own.made_with == (3, 2)
    assert type(vector_world(LEFT.world, lanes=3, threads=2)) is PlainVectorWorld


def test_each_lane_runs_the_episode_of_the_plain_world_whichever_world_it_is_in(other_task: Task) -> None:
    lanes, tasks, seeds = Lanes(4), [LEFT, other_task, LEFT, other_task], [5, 6, 7, 8]
    worlds = [resolve(task.world)() for task in tasks]
    expected = [
        world.reset(seed=seed, options={"task": task.name})[0]
        for world, seed, task in zip(worlds, seeds, tasks, strict=True)
    ]
    order = [2, 0, 3, 1]
    states = lanes.reset(order, [seeds[lane] for lane in order], [tasks[lane] for lane in order])
    np.testing.assert_array_equal(states, [expected[lane] for lane in order])
    generator = np.random.default_rng(0)
    for moving in ([0, 1, 2, 3], [3, 0], [1], [2, 3, 1]):
        actions = generator.uniform(-1, 1, (len(moving), 2)).astype(np.float32)
        states, rewards, successes = lanes.step(moving, actions)
        outcomes = [worlds[lane].step(action)[:3] for lane, action in zip(moving, actions, strict=True)]
        for row, (state, reward, success) in enumerate(outcomes):
            assert states[row].tobytes() == state.tobytes()
            assert (rewards[row], successes[row]) == (reward, success)
    lanes.close()


def test_two_tasks_of_one_world_run_side_by_side_each_in_its_own_lane() -> None:
    lanes, tasks, worlds = Lanes(3), [LEFT, UP, LEFT], [ToyWorld() for _ in range(3)]
    order = [1, 2, 0]
    lanes.reset(order, order, [tasks[lane] for lane in order])
    for lane, world in enumerate(worlds):
        world.reset(seed=lane, options={"task": tasks[lane].name})
    for moving in ([0, 1, 2], [2, 1], [1], [2, 0]):
        actions = np.array([[-0.5, 0.3 * lane] for lane in moving], np.float32)
        states, rewards, successes = lanes.step(moving, actions)
        outcomes = [worlds[lane].step(action)[:3] for lane, action in zip(moving, actions, strict=True)]
        np.testing.assert_array_equal(states, [state for state, _, _ in outcomes])
        assert [*zip(rewards, successes, strict=True)] == [(reward, done) for _, reward, done in outcomes]


class ImpatientWorld(ToyWorld):
    """A toy world that cuts every episode off after a step."""

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        state, reward, terminated, _, info = super().step(action)
        return state, reward, terminated, True, info


def test_an_episode_that_its_world_cuts_off_is_no_success() -> None:
    world = PlainVectorWorld(ImpatientWorld, lanes=1)
    world.reset([0], [3], ["left"])
    _, _, successes = world.step([0], np.zeros((1, 2), np.float32))
    assert successes.tolist() == [False]


def test_closed_lanes_have_no_episode_until_they_are_reset() -> None:
    lanes = Lanes(1)
    first, world = episode(lanes, 0, 3, LEFT, perturbed=False), lanes.world(LEFT)
    lanes.close()
    with pytest.raises(gymnasium.error.ResetNeeded, match="Lane 0 has no episode"):
        lanes.step([0], np.zeros((1, 2), np.float32))
    assert episode(lanes, 0, 3, LEFT, perturbed=False) == first
    assert lanes.world(LEFT) is not world


def test_a_lane_goes_from_one_world_to_another(other_task: Task) -> None:
    lanes = Lanes(1)
    for task in (LEFT, other_task, LEFT):
        expected, _ = resolve(task.world)().reset(seed=3, options={"task": task.name})
        np.testing.assert_array_equal(lanes.reset([0], [3], [task]), [expected])


def test_a_lane_without_an_episode_cannot_be_stepped() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="Lane 1 has no episode"):
        Lanes(2).step([1], np.zeros((1, 2), np.float32))
    world = vector_world(LEFT.world, lanes=2)
    with pytest.raises(gymnasium.error.ResetNeeded, match="Lane 1 has no episode"):
        world.step([1], np.zeros((1, 2), np.float32))


def episode(lanes: Lanes, lane: int, seed: int, task: Task, perturbed: bool) -> bytes:
    """Return the states of an episode of five steps in a lane."""
    states = [lanes.reset([lane], [seed], [task], [perturbed])]
    states += [lanes.step([lane], np.full((1, 2), 0.7, np.float32))[0] for _ in range(5)]
    return np.concatenate(states).tobytes()


def test_perturbed_episodes_run_together_with_plain_ones_and_do_not_change_them(other_task: Task) -> None:
    for task in (LEFT, other_task):
        plain = episode(Lanes(1), 0, 3, task, perturbed=False)
        changed = episode(Lanes(1), 0, 3, task, perturbed=True)
        assert plain != changed
        lanes = Lanes(3)
        for lane, perturbed in ((0, True), (1, False), (1, True), (0, False), (2, True)):
            assert episode(lanes, lane, 3, task, perturbed) == (changed if perturbed else plain)
        seeds, flags = [3, 3, 3], [False, True, False]
        first = [np.frombuffer(one, np.float32)[:4] for one in (plain, changed, plain)]
        np.testing.assert_array_equal(lanes.reset([0, 1, 2], seeds, [task] * 3, flags), first)


@pytest.mark.parametrize(
    ("world", "own", "message"),
    [
        ("SteadyWorld", None, "clbench.testing:SteadyWorld does not declare `perturbable = True`"),
        (
            "SteadyWorld",
            SteadyVectorWorld,
            "the vector world of clbench.testing:SteadyWorld does not declare `perturbable = True`",
        ),
    ],
)
def test_an_error_names_the_task_whose_world_cannot_be_perturbed_and_the_way_out(
    world: str, own: object, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    steady = type(world, (SteadyWorld,), {} if own is None else {"vector_world": own})
    monkeypatch.setattr(f"clbench.testing.{world}", steady, raising=False)
    task = dataclasses.replace(UP, world=f"clbench.testing:{world}")
    check_perturbable([LEFT, UP])
    with pytest.raises(ValueError, match="The task 'up' cannot be perturbed: ") as raised:
        check_perturbable([LEFT, task])
    assert message in str(raised.value)
    assert "Run without --perturb, or perturb its episodes as docs/guide/your_scenario.md shows." in str(
        raised.value
    )
    assert Lanes(1).reset([0], [3], [task]).shape == (1, 4)


@pytest.mark.parametrize(("plain", "own", "can"), [(False, True, True), (True, False, False)])
def test_of_a_world_with_a_vector_world_the_vector_world_says_whether_it_can_be_perturbed(
    plain: bool, own: bool, can: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    vector = type("Vector", (OwnVectorWorld,), {"perturbable": own})
    world = type("World", (ToyWorld,), {"perturbable": plain, "vector_world": vector})
    monkeypatch.setattr("clbench.testing.EitherWorld", world, raising=False)
    task = dataclasses.replace(UP, world="clbench.testing:EitherWorld")
    with contextlib.nullcontext() if can else pytest.raises(ValueError, match="cannot be perturbed"):
        check_perturbable([task])
