import dataclasses

import gymnasium
import numpy as np
import pytest

from clbench.task import Task, load_scenario, resolve
from clbench.testing import ToyWorld
from clbench.world import Lanes, PlainVectorWorld, vector_world

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
LEFT, UP = TOY.task("left"), TOY.task("up")


class OwnVectorWorld(PlainVectorWorld):
    """A suite's own vector world: it remembers what it was made with."""

    def __init__(self, lanes: int, threads: int) -> None:
        super().__init__(ToyWorld, lanes)
        self.made_with = (lanes, threads)


class OtherToyWorld(ToyWorld):
    """The toy world of another suite, which has its own vector world."""

    vector_world = OwnVectorWorld


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
