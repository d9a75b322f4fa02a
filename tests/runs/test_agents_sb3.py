"""Agents of Stable-Baselines3: their environments side by side, their batches, and their wrappers."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from agents import ID, stage_env

from clbench.runs.agents import evaluate_agent

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

WORDS = partial(stage_env, 0, instruction="tokens")
"""Makes an environment that Stable-Baselines3 can observe."""


@pytest.fixture
def evaluate(tmp_path: Path, empty_caches: Path) -> Callable[..., Any]:
    """Return `evaluate_agent` for the method me/ppo, with separate records and caches for the test."""
    return partial(evaluate_agent, method="me/ppo", records=tmp_path / "records")


def ppo(env: Any, policy: str = "MultiInputPolicy", **options: Any) -> PPO:
    return PPO(policy, env, n_steps=8, batch_size=8, seed=0, device="cpu", **options)


def test_agents_of_stable_baselines3_act_on_batches_by_themselves(
    evaluate: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = WORDS()
    agent = ppo(env)
    predict, shapes = agent.predict, []

    def watch(observation: dict[str, Any], **options: Any) -> Any:
        shapes.append(observation["state"].shape)
        return predict(observation, **options)

    monkeypatch.setattr(agent, "predict", watch)
    evaluate(agent, env)
    assert {shape[0] for shape in shapes} == {40}


@pytest.mark.long
def test_environments_side_by_side_tell_their_stage_steps_and_seconds(evaluate: Callable[..., Any]) -> None:
    envs = make_vec_env(ID, n_envs=3, seed=0, env_kwargs={"instruction": "tokens", "stage": 0})
    agent = ppo(envs)
    agent.learn(48)
    for env in (envs, agent.get_env(), VecNormalize(envs)):
        record = evaluate(agent, env)
        assert record.costs.environment_steps == agent.num_timesteps == 48
        assert record.timing["stages"][0]["training"] is not None


@pytest.mark.slow
def test_environments_in_other_processes_tell_them_too(evaluate: Callable[..., Any]) -> None:
    envs = SubprocVecEnv([WORDS, WORDS])
    agent = ppo(envs)
    agent.learn(32)
    record = evaluate(agent, envs)
    envs.close()
    assert record.costs.environment_steps == 32
    assert record.timing["stages"][0]["training"] is not None


def side_by_side(wrapper: Callable[..., Any], **options: Any) -> Any:
    return wrapper(DummyVecEnv([WORDS]), **options)


@pytest.mark.parametrize(
    ("env", "policy", "other"),
    [
        (lambda: side_by_side(VecNormalize, norm_obs_keys=["state"]), "MultiInputPolicy", "observations"),
        (lambda: side_by_side(VecFrameStack, n_stack=2), "MultiInputPolicy", "observations"),
        (
            lambda: gymnasium.wrappers.FilterObservation(WORDS(), ["state"]),
            "MultiInputPolicy",
            "observations",
        ),
        (lambda: gymnasium.wrappers.FlattenObservation(WORDS()), "MlpPolicy", "observations"),
        (
            lambda: gymnasium.wrappers.RescaleAction(WORDS(), np.float32(-0.5), np.float32(0.5)),
            "MultiInputPolicy",
            "actions",
        ),
    ],
)
def test_an_agent_that_learned_behind_a_wrapper_is_refused(
    env: Callable[[], Any], policy: str, other: str, evaluate: Callable[..., Any]
) -> None:
    agent = ppo(env(), policy)
    with pytest.raises(ValueError, match=f"trained with {other} that differ from those of clbench/Toy-v0"):
        evaluate(agent, WORDS())


def test_an_agent_that_learned_from_words_is_refused_where_instructions_are_text(
    evaluate: Callable[..., Any],
) -> None:
    with pytest.raises(ValueError, match="with instruction='text'"):
        evaluate(ppo(WORDS()), stage_env(0))


@pytest.mark.long
def test_an_agent_that_undoes_its_wrapper_is_evaluated(evaluate: Callable[..., Any]) -> None:
    envs = side_by_side(VecNormalize, norm_obs_keys=["state"])
    agent = ppo(envs)
    agent.learn(32)

    class Normalised:
        def predict(self, observation: Any, deterministic: bool) -> Any:
            return agent.predict(envs.normalize_obs(observation), deterministic=deterministic)

    single, batch = (evaluate(Normalised(), envs, batched=batched) for batched in (False, True))
    assert batch.episodes["length"] == single.episodes["length"]


def test_wrappers_that_change_rewards_alone_are_accepted(evaluate: Callable[..., Any]) -> None:
    evaluate(ppo(side_by_side(VecNormalize, norm_obs=False)), WORDS())


class State(BaseFeaturesExtractor):
    """Features: the state alone, since the toy's pictures are too small for the usual network."""

    def __init__(self, space: gymnasium.spaces.Dict) -> None:
        super().__init__(space, gymnasium.spaces.flatdim(space["state"]))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        return observations["state"]


@pytest.mark.long
def test_pictures_whose_colours_the_library_puts_first_are_no_wrapper(evaluate: Callable[..., Any]) -> None:
    env = gymnasium.make("clbench.testing.seen_toy:clbench/SeenToy-v0", instruction="tokens", stage=0)
    agent = ppo(env, policy_kwargs={"features_extractor_class": State})
    observed: Any = agent.observation_space
    assert observed["image"].shape == (3, 16, 16)
    evaluate(agent, env)
