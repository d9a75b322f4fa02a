"""The schedule of episodes, and the space of instructions as text in Gymnasium's own vector environments."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from clbench.testing import TOY
from clbench.worlds.scenario_env import ScenarioEnv


def _async(**options: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    return gymnasium.make_vec(
        "clbench.testing:clbench/Toy-v0", num_envs=2, vectorization_mode="async", vector_kwargs=options
    )


def test_texts_in_shared_memory_which_gymnasium_would_show_blank_are_refused_with_what_helps() -> None:
    with pytest.raises(ValueError, match="shared_memory=False") as caught:
        _async()
    assert 'instruction="tokens"' in str(caught.value.__cause__)


def test_asynchronous_environments_show_texts_without_shared_memory() -> None:
    env = _async(shared_memory=False)
    observation, info = env.reset(seed=0)
    assert list(observation["instruction"]) == list(info["instruction"])
    observation, *_, info = env.step(env.action_space.sample())
    assert list(observation["instruction"]) == list(info["instruction"])
    assert {*observation["instruction"]} <= {"go left", "move to the left"}
    env.close()


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda space: pickle.loads(pickle.dumps(space))]
)
def test_the_space_of_texts_is_equal_to_gymnasiums_own_and_so_are_its_copies(
    copied: Callable[[Any], Any],
) -> None:
    env = gymnasium.make("clbench.testing:clbench/Toy-v0")
    space: Any = env.observation_space["instruction"]  # type: ignore[index]
    plain = spaces.Text(min_length=space.min_length, max_length=space.max_length, charset=space.characters)
    assert space == plain == copied(space)
    assert plain == space
    assert repr(space) == repr(plain)
    text = env.reset(seed=0)[0]["instruction"]
    np.testing.assert_array_equal(spaces.flatten(space, text), spaces.flatten(plain, text))
    assert spaces.flatten_space(space) == spaces.flatten_space(plain)
    assert batch_space(space, 3) == batch_space(plain, 3)


@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int64])
def test_small_whole_numbers_of_numpy_choose_the_same_episodes_as_pythons(kind: Callable[[int], Any]) -> None:
    for stage in (0, 2):
        env = ScenarioEnv(TOY)
        _, info = env.reset(seed=0, options={"stage": kind(stage)})
        assert (info["stage"], type(info["stage"])) == (stage, int)
        assert info["task"] == ("left", "right", "down")[stage]
        assert type(ScenarioEnv(TOY, stage=kind(stage)).reset(seed=0)[1]["stage"]) is int
    env = ScenarioEnv(TOY, episodes_per_stage=kind(100))
    assert [env.reset()[1]["stage"] for _ in range(300)] == [0] * 100 + [1] * 100 + [2] * 100
