"""Agents that learn by trial and error: their observations and their records."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from agents import ID, LEARNED, TOY, Knowing, stage_env, trained

from clbench.base.errors import InputError
from clbench.policy.transformer import TransformerPolicy
from clbench.records.reader import read_record
from clbench.records.record import Costs
from clbench.runs.stages import MachineError
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.worlds.scenario_env import Observation
from clbench.worlds.scenario_vector_env import ScenarioVectorEnv


class Looking:
    """An agent that keeps its observations."""

    def __init__(self) -> None:
        self.shown: list[Observation] = []

    def predict(self, observation: Observation, *, deterministic: bool) -> tuple[Any, Any]:
        self.shown.append(observation)
        return np.zeros(2), None


@pytest.mark.long
def test_an_agent_observes_what_the_space_of_its_environment_declares(evaluate: Callable[..., Any]) -> None:
    env = gymnasium.make("clbench.testing.seen_toy:clbench/SeenToy-v0", stage=0)
    agent = Looking()
    evaluate(agent, env)
    assert agent.shown
    assert all(env.observation_space.contains(shown) for shown in agent.shown)
    assert any(shown["image"].any() for shown in agent.shown)


def test_an_agent_leaves_a_record_of_its_success_after_each_stage(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    for stage, known in enumerate(LEARNED):
        record = evaluate(Knowing(*known), trained(stage, 10 * (stage + 1)), settings={"speed": 3})
    path = tmp_path / "records" / "Toy-v0" / "me--knows" / "seed-0.json"
    assert read_record(path) == record
    scores = Scores.from_record(record)
    expected = [[name in known for name in scores.layout.tasks] for known in LEARNED]
    assert np.array_equal(scores.success.mean(axis=-1), np.array(expected, float))
    values = {
        name: measure(name, scores) for name in ("adaptation", "retention", "final_average", "forgetting")
    }
    assert values == {
        "adaptation": 1.0,
        "retention": 0.5,
        "final_average": 0.75,
        "forgetting": pytest.approx(1 / 3),
    }
    for missing in ("question_retention", "forward_transfer", "activation_drift"):
        assert measure(missing, scores, {"from_scratch": scores}) is None
    assert record.costs == Costs(environment_steps=60)
    assert record.diagnostics["1"] == {"environment_steps": 20}
    assert record.run.settings == {"speed": 3}
    assert record.fingerprint["method"]["class"].endswith(":Knowing")
    assert [one["training"] is not None for one in record.timing["stages"]] == [True] * 3


def test_an_agent_has_the_same_initial_states_as_every_method(
    evaluate: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from clbench.evaluation.rollouts import Evaluator
    from clbench.learning.pretraining import policy_config
    from clbench.worlds.lanes import Lanes

    seen: list[tuple[list[int], list[str]]] = []
    reset = Lanes.reset

    def watched(self: Lanes, lanes: Any, seeds: Any, tasks: Any, *perturbed: Any) -> Any:
        seen.append((list(seeds), [task.name for task in tasks]))
        return reset(self, lanes, seeds, tasks, *perturbed)

    monkeypatch.setattr(Lanes, "reset", watched)
    record = evaluate(Knowing(), stage_env(0), seed=5)
    starts = {(name, seed) for seeds, names in seen for seed, name in zip(seeds, names, strict=True)}
    assert len(starts) == len(record.episodes["task"]) == 5 * TOY.budget.test_episodes
    seen.clear()
    policy = TransformerPolicy(policy_config(TOY), seed=0).eval()
    Evaluator(TOY, 5).evaluate(policy, TOY.tasks, "test")
    assert {(name, seed) for seeds, names in seen for seed, name in zip(seeds, names, strict=True)} == starts


def test_an_agent_with_a_tuning_seed_plays_validation_episodes(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    for stage, known in enumerate(LEARNED):
        record = evaluate(Knowing(*known), stage_env(stage), seed=100)
    assert record.run.split == "validation"
    assert set(record.episodes["split"]) == {"validation"}
    assert read_record(tmp_path / "records" / "Toy-v0" / "me--knows" / "seed-100.json") == record
    scores = Scores.from_record(record)
    assert scores.success.shape[-1] == TOY.budget.validation_episodes
    assert measure("adaptation", scores) == 1.0


def test_a_function_is_an_agent_and_observes_what_its_env_returns(evaluate: Callable[..., Any]) -> None:
    env = stage_env(0, instruction="tokens")
    seen: list[bool] = []

    def act(observation: Observation) -> list[float]:
        seen.append(env.observation_space.contains(observation))
        return [-1, 0]

    record = evaluate(act, env)
    assert seen
    assert all(seen)
    scores = Scores.from_record(record, partial=True)  # its stages are still to come
    rates = scores.success[0].mean(axis=-1)
    assert dict(zip(scores.layout.tasks, rates, strict=True))["left"] == 1.0


def test_an_agent_that_overwrites_its_observation_changes_no_later_one(
    evaluate: Callable[..., Any],
) -> None:
    seen: list[Any] = []

    def act(observation: Observation) -> Any:
        seen.append(observation["instruction"].any())
        for values in observation.values():
            values[:] = 0
        return np.zeros(2)

    evaluate(act, stage_env(0, instruction="tokens"))
    assert seen
    assert all(seen)


def test_an_agent_receives_its_memory_except_at_the_first_step_of_an_episode(
    evaluate: Callable[..., Any],
) -> None:
    class Counting:
        longest = 0

        def predict(
            self, observation: Any, state: Any = None, deterministic: bool = False
        ) -> tuple[Any, Any]:
            count = 0 if state is None else state
            self.longest = max(self.longest, count)
            return np.zeros(2), count + 1

    agent = Counting()
    evaluate(agent, stage_env(0))
    assert agent.longest == TOY.tasks[0].horizon - 1


class Linear:
    """An agent without memory, for one observation with tokens or for many."""

    def __init__(self) -> None:
        self.calls = 0

    def predict(self, observation: Observation, *, deterministic: bool) -> tuple[Any, Any]:
        self.calls += 1
        words, state = observation["instruction"], observation["state"]
        return state[..., :2] * np.where(words[..., 1:3] % 2 == 0, -1.0, 1.0), None


def outcomes(record: Any) -> dict[str, list[Any]]:
    return {name: list(values) for name, values in record.episodes.items()}


@pytest.mark.long
def test_an_agent_that_acts_on_batches_has_the_same_outcomes_in_fewer_calls(
    evaluate: Callable[..., Any], tmp_path: Path
) -> None:
    one, many = Linear(), Linear()
    env = stage_env(0, instruction="tokens")
    single = evaluate(one, env, batched=False, records=tmp_path / "single")
    batch = evaluate(many, env, batched=True, records=tmp_path / "batch")
    assert outcomes(batch) == outcomes(single)
    assert 0 < many.calls < one.calls / 10
    function = evaluate(
        lambda observation: many.predict(observation, deterministic=True)[0],
        env,
        batched=True,
        records=tmp_path / "function",
    )
    assert outcomes(function) == outcomes(single)


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        (lambda _: np.zeros(2), r"has the shape \(2,\), not \(40, 2\)"),
        (lambda _: np.zeros((3, 2)), r"has the shape \(3, 2\), not \(40, 2\)"),
        (
            type("Recurrent", (), {"predict": lambda *_, **__: (np.zeros((40, 2)), "memory")})(),
            "has a memory",
        ),
    ],
)
def test_an_agent_that_cannot_act_on_batches_is_refused(
    agent: Any, message: str, evaluate: Callable[..., Any]
) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(agent, stage_env(0, instruction="tokens"), batched=True)


def test_an_agent_that_returns_nan_fails_its_episodes(evaluate: Callable[..., Any]) -> None:
    record = evaluate(lambda _: [float("nan")] * 2, stage_env(0))
    assert not any(record.episodes["success"])
    assert set(record.episodes["length"]) == {12}


@pytest.mark.long
def test_random_draws_of_an_agent_leave_no_trace_and_repeat_themselves(evaluate: Callable[..., Any]) -> None:
    agent = lambda _: np.random.uniform(-1, 1, 2)  # noqa: E731, NPY002 - as agents of other libraries draw
    np.random.seed(3)  # noqa: NPY002
    one = evaluate(agent, stage_env(0)).episodes
    drawn = np.random.uniform()  # noqa: NPY002
    np.random.seed(3)  # noqa: NPY002
    assert drawn == np.random.uniform()  # noqa: NPY002
    assert evaluate(agent, stage_env(0)).episodes == one


@pytest.mark.long
def test_steps_taken_elsewhere_are_recorded_if_given_and_missing_if_unknown(
    evaluate: Callable[..., Any],
) -> None:
    assert evaluate(Knowing(), stage_env(0), steps=500).costs.environment_steps == 500
    record = evaluate(Knowing(), stage_env(0))
    assert record.costs.environment_steps is None
    assert record.diagnostics["0"] == {"environment_steps": None}
    assert record.timing["seconds"] is None


def test_the_steps_of_parallel_environments_are_added_up(evaluate: Callable[..., Any]) -> None:
    env = gymnasium.make_vec(ID, num_envs=3, stage=2)
    _, info = env.reset(seed=0)
    assert list(info["task"]) == ["down"] * 3
    for _ in range(4):
        env.step(np.zeros((3, 2), np.float32))
    assert isinstance(env.unwrapped, ScenarioVectorEnv)
    assert env.unwrapped.steps_taken == 12
    env = gymnasium.make_vec(ID, num_envs=3, stage=0)
    assert evaluate(Knowing(), env).run.scenario == TOY.id


def stages_side_by_side(*stages: int) -> gymnasium.vector.SyncVectorEnv:
    return gymnasium.vector.SyncVectorEnv([partial(stage_env, stage) for stage in stages])


def test_a_plain_vector_of_environments_tells_its_stage_steps_and_seconds(
    evaluate: Callable[..., Any],
) -> None:
    env = stages_side_by_side(0, 0, 0)
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros((3, 2), np.float32))
    record = evaluate(Knowing(), env)
    assert record.costs.environment_steps == 12
    assert record.timing["stages"][0]["training"] is not None


def test_environments_of_different_stages_are_refused(evaluate: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"differ in their stage: \[0, 1\]"):
        evaluate(Knowing(), stages_side_by_side(0, 1))


def test_the_parameters_of_a_network_that_grows_are_those_at_the_end(evaluate: Callable[..., Any]) -> None:
    agent: Any = Knowing()
    agent.policy = torch.nn.ModuleList([torch.nn.Linear(3, 1)])
    assert evaluate(agent, stage_env(0)).costs.parameters == 4
    agent.policy.append(torch.nn.Linear(3, 1))
    assert evaluate(agent, stage_env(1)).costs.parameters == 8


@pytest.mark.parametrize(
    ("agent", "error", "message"),
    [
        (lambda _: [1.0, 2.0, 3.0], ValueError, r"action has the shape \(3,\), not \(2,\)"),
        (lambda _: [[1.0, 2.0]], ValueError, r"action has the shape \(1, 2\), not \(2,\)"),
        (lambda _: None, ValueError, r"action has the shape \(\), not \(2,\)"),
        (lambda _: {"arm": 1}, ValueError, r"must be 2 numbers, not a dict \(.+\)"),
        (lambda _: torch.zeros(2).bfloat16(), ValueError, r"2 numbers, not a Tensor \(.*BFloat16\)"),
        (lambda _: "left", ValueError, "must be 2 numbers, not a str"),
        (lambda _: ["0.5", "1"], ValueError, r"must be 2 numbers, not a list \(of type <U3\)"),
        (lambda _: np.array([1j, 1]), ValueError, r"2 numbers, not a ndarray \(of type complex128\)"),
        (3, TypeError, "int is not an agent"),
    ],
)
def test_an_agent_that_cannot_act_is_refused_and_the_stage_can_be_evaluated_again(
    agent: Any, error: type[Exception], message: str, evaluate: Callable[..., Any]
) -> None:
    with pytest.raises(error, match=message):
        evaluate(agent, stage_env(0))
    evaluate(Knowing(), stage_env(0))


def test_a_stage_may_be_a_number_of_numpy(evaluate: Callable[..., Any]) -> None:
    for stage in np.arange(2):
        evaluate(Knowing(), gymnasium.make(ID, stage=stage))
    with pytest.raises(ValueError, match=r"Stage 2 of .* comes next, not 1"):
        evaluate(Knowing(), gymnasium.make_vec(ID, num_envs=2, stage=np.int64(1)))


def test_a_prediction_without_a_state_is_refused(evaluate: Callable[..., Any]) -> None:
    class Plain:
        def predict(self, observation: Any, deterministic: bool) -> Any:
            return np.zeros(2)

    with pytest.raises(ValueError, match=r"must return \(action, state\)"):
        evaluate(Plain(), stage_env(0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"method": "sft"},
            "'sft' is a method of clbench: give your row its own name, for example 'me/sft'",
        ),
        ({"method": "SFT"}, "would take for 'sft'"),
        ({"method": "../sac"}, "cannot be the name of a method"),
        ({"method": "my_agents:Sac"}, "'my_agents:Sac' is the name of a class that clbench imports"),
        ({"steps": -1}, "steps must be a whole number from 0, not -1"),
        ({"seed": -1}, "seed must be a whole number from 0 to 18446744073709551615, not -1"),
        (
            {"seed": 2**64},
            "seed must be a whole number from 0 to 18446744073709551615, not 18446744073709551616",
        ),
        ({"settings": {"speed": float("nan")}}, "record cannot hold the settings"),
        ({"settings": {"net": object()}}, "record cannot hold the settings"),
    ],
)
def test_invalid_names_seeds_and_settings_are_refused(
    options: dict[str, Any], message: str, evaluate: Callable[..., Any]
) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(Knowing(), stage_env(0), **options)


def test_the_seed_and_the_steps_may_be_numbers_of_numpy(evaluate: Callable[..., Any]) -> None:
    record = evaluate(Knowing(), stage_env(0), seed=np.int64(3), steps=np.uint32(5))
    assert (type(record.run.seed), record.run.seed) == (int, 3)
    assert record.costs.environment_steps == 5
    for wrong in ({"seed": True}, {"seed": 1.0}, {"steps": np.float64(5)}, {"steps": True}):
        with pytest.raises(ValueError, match="must be a whole number from 0"):
            evaluate(Knowing(), stage_env(0), method="me/wrong", **wrong)


def test_targets_in_another_order_are_refused(evaluate: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="in order 1: agents are scored in order 0"):
        evaluate(Knowing(), gymnasium.make("clbench/Toy-v0", stage=0, order=1))


def test_an_environment_without_a_scenario_or_a_stage_is_refused(evaluate: Callable[..., Any]) -> None:
    for env in (gymnasium.make("CartPole-v1"), gymnasium.make_vec("CartPole-v1"), 3):
        with pytest.raises(TypeError, match="does not belong to a scenario"):
            evaluate(Knowing(), env)
    with pytest.raises(ValueError, match=r"is not of a single stage: .*'clbench/Toy-v0', stage=0\)"):
        evaluate(Knowing(), gymnasium.make(ID))


def test_a_record_of_an_agent_that_does_not_fit_on_the_disk_is_named(
    evaluate: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> Any:
        return open("/dev/full", "w")

    monkeypatch.setattr("clbench.records.writer.open", full, raising=False)
    path = tmp_path / "records" / "Toy-v0" / "me--knows" / "seed-0.json.unfinished"
    with pytest.raises(MachineError, match=f"has no room: .*No space left on device: '{path}'"):
        evaluate(Knowing(), stage_env(0))
    assert not path.exists()


@pytest.mark.parametrize("batched", [False, True])
def test_an_agent_whose_actions_are_not_finite_is_named_once(
    batched: bool, evaluate: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    actions = np.full((40, 2) if batched else 2, np.nan)
    agent = type("Diverged", (), {"predict": lambda *_, **__: (actions, None)})()
    evaluate(agent, stage_env(0, instruction="tokens"), batched=batched)
    assert caplog.messages == ["The agent returned NaN or infinities, and NaN counts as 0."]


def test_an_agent_that_returns_nothing_in_a_list_is_refused(evaluate: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match=r"must be 2 numbers, not a list \(of type object\)"):
        evaluate(lambda _: [None] * 2, stage_env(0))
    evaluate(lambda _: np.array([0.1, 0.2], object), stage_env(0))  # a row of a table, for example
