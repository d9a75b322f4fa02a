import dataclasses
import itertools
import threading
from contextlib import closing
from typing import Any

import numpy as np
import pytest
import torch

from clbench.base.entry_points import resolve
from clbench.base.errors import UnknownNameError, WrongTypeError
from clbench.base.seeding import derive_seed, torch_generator
from clbench.data.questions import load_questions, scored_questions
from clbench.evaluation.answers import answer
from clbench.evaluation.episodes import LANES, Episode, Trial, start_of
from clbench.evaluation.probes import activations
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.optimise import deterministic
from clbench.learning.pretraining import policy_config, pretrained_policy
from clbench.policy.policy import Policy
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.language import encode
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.threads import share_cores

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
FETCH = load_scenario("clbench/Fetch-v1")


@pytest.fixture(scope="module")
def fetch_policy() -> Policy:
    """An untrained policy for Fetch: it waves the arm about."""
    return TransformerPolicy(policy_config(FETCH), seed=3).eval()


def _with_episodes(**numbers: int) -> Scenario:
    """Return Fetch with other numbers of episodes, which end after 16 steps."""

    def short(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
        return tuple(dataclasses.replace(task, horizon=16) for task in tasks)

    return dataclasses.replace(
        FETCH,
        retained=short(FETCH.retained),
        target=short(FETCH.target),
        held_out=short(FETCH.held_out),
        budget=dataclasses.replace(FETCH.budget, **numbers),
    )


@pytest.mark.long
def test_an_outcome_does_not_depend_on_other_episodes(fetch_policy: Policy) -> None:
    scenario = _with_episodes(validation_episodes=5)
    evaluator = Evaluator(scenario, seed=0)
    with deterministic():
        together = evaluator.evaluate(fetch_policy, scenario.tasks)  # 50 episodes: more than lanes
        alone = Evaluator(scenario, seed=0).evaluate(fetch_policy, [scenario.tasks[5]])
        again = evaluator.evaluate(fetch_policy, reversed(scenario.tasks))
    assert len(together) > LANES
    assert alone == together[25:30]
    assert again == [episode for start in range(45, -5, -5) for episode in together[start : start + 5]]


def _played_alone(policy: Policy, task: Task, number: int, seed: int) -> Episode:
    """Run one validation episode in the plain world, with nothing else in the forward."""
    config, world = policy.config, resolve(task.world)()
    start = derive_seed("episode", seed, task.name, "selection", number)
    state, _ = world.reset(seed=start, options={"task": task.name})
    words = torch.ones(LANES, 12, dtype=torch.int64)
    words[0] = encode([task.instructions[number % len(task.instructions)]])[0]
    forwards = -(-task.horizon // config.executed)
    draws = torch.randn(forwards, config.chunk, config.action_size, generator=torch_generator("noise", start))
    states, noise = torch.zeros(LANES, config.state_size), torch.zeros(LANES, *draws.shape[1:])
    total_reward = 0.0
    for step in range(task.horizon):
        if step % config.executed == 0:
            states[0], noise[0] = torch.from_numpy(state), draws[step // config.executed]
            chunk = policy.act(states, words, noise)[0].clamp(-1.0, 1.0).numpy()
        state, reward, success, _, _ = world.step(chunk[step % config.executed])
        total_reward += reward
        if success:
            break
    return Episode(task.name, "validation", number, success, total_reward, step + 1)


@pytest.mark.long
def test_an_outcome_equals_the_outcome_in_the_plain_world_bit_for_bit(fetch_policy: Policy) -> None:
    trained, _ = pretrained_policy(TOY, 0)
    cases = [(FETCH, fetch_policy, ["push", "press"]), (TOY, trained, ["left", "right", "up_left"])]
    for scenario, policy, names in cases:
        trials = [Trial(scenario.task(name), "validation", number) for name in names for number in (0, 3)]
        with deterministic():
            alone = [_played_alone(policy, task, number, seed=4) for task, _, number in trials]
            for threads in (1, 2):
                assert Evaluator(scenario, seed=4, threads=threads).play(policy, trials) == alone


def test_an_outcome_does_not_depend_on_a_share_of_the_cores_that_changes(
    fetch_policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = _with_episodes(validation_episodes=4)
    tasks, shares, threads = scenario.target[:2], itertools.cycle([1, 3, 2]), set[int]()

    def evaluate() -> list[Episode]:
        with closing(Evaluator(scenario, seed=0)) as evaluator, deterministic():
            found = evaluator.evaluate(fetch_policy, tasks)
            threads.add(threading.active_count())
            return found

    alone = evaluate()
    monkeypatch.setattr("clbench.worlds.threads.cores", lambda: 3)
    share_cores(lambda: next(shares))
    try:
        shared = evaluate()
    finally:
        share_cores(None)
    assert shared == alone
    assert max(threads) - min(threads) == 2  # besides the calling one


def test_an_evaluator_asks_for_scenarios_tasks_and_splits_by_kind_and_name(fetch_policy: Policy) -> None:
    with pytest.raises(WrongTypeError, match="A Scenario is needed, not 'clbench/Fetch-v1'"):
        Evaluator("clbench/Fetch-v1", 0)  # type: ignore[arg-type]
    evaluator, task = Evaluator(FETCH, 0), FETCH.task("reach")
    with pytest.raises(WrongTypeError, match="Give a list of tasks, not the task 'reach' alone"):
        evaluator.evaluate(fetch_policy, task)  # type: ignore[arg-type]
    with pytest.raises(WrongTypeError, match="A Task is needed, not 'reach'"):
        evaluator.evaluate(fetch_policy, ["reach"])  # type: ignore[list-item]
    with pytest.raises(UnknownNameError, match="there are validation, test and perturbed"):
        evaluator.evaluate(fetch_policy, [task], "val")  # type: ignore[arg-type]


def test_a_row_of_a_forward_pass_does_not_depend_on_its_place_or_its_neighbours(fetch_policy: Policy) -> None:
    generator = torch.Generator().manual_seed(0)
    config = fetch_policy.config
    state = torch.randn(LANES, config.state_size, generator=generator)
    words = torch.randint(0, 300, (LANES, 12), generator=generator)
    noise = torch.randn(LANES, config.chunk, config.action_size, generator=generator)
    order = torch.randperm(LANES, generator=generator)
    with deterministic():
        straight = fetch_policy.act(state, words, noise)
        shuffled = fetch_policy.act(state[order], words[order], noise[order])
        assert shuffled.equal(straight[order])
        state[7:], noise[7:] = 0, 0
        assert fetch_policy.act(state, words, noise)[:7].equal(straight[:7])


@pytest.mark.long
def test_validation_and_test_episodes_and_seeds_have_different_initial_states(fetch_policy: Policy) -> None:
    task = FETCH.task("reach")
    scenario = _with_episodes(validation_episodes=2, test_episodes=3, curve_episodes=1)
    runs = [
        [episode.total_reward for episode in Evaluator(scenario, seed).evaluate(fetch_policy, [task], split)]  # type: ignore[arg-type]
        for seed, split in ((0, "validation"), (0, "test"), (1, "test"))
    ]
    assert [len(run) for run in runs] == [2, 3, 3]
    values = [value for run in runs for value in run]
    assert len(set(values)) == len(values)


def test_a_perturbed_episode_begins_with_the_seed_and_the_words_of_the_test_episode() -> None:
    task = FETCH.task("push")
    for number in range(3):
        assert start_of(Trial(task, "perturbed", number), 5) == start_of(Trial(task, "test", number), 5)
    assert FETCH.budget.episodes("perturbed") == FETCH.budget.test_episodes


@pytest.mark.long
def test_perturbed_outcomes_neither_depend_on_other_episodes_nor_change_them(
    fetch_policy: Policy,
) -> None:
    tasks = [FETCH.task("push"), FETCH.task("reach")]
    plain = [Trial(task, "test", number) for task in tasks for number in range(3)]
    perturbed = [Trial(task, "perturbed", number) for task, _, number in plain]
    with deterministic():
        alone = (
            Evaluator(FETCH, 0).play(fetch_policy, plain),
            Evaluator(FETCH, 0).play(fetch_policy, perturbed),
        )
        evaluator = Evaluator(FETCH, 0, threads=2)
        together = evaluator.play(fetch_policy, [*perturbed[::-1], *plain])
        again = evaluator.play(fetch_policy, perturbed)
    assert together == [*alone[1][::-1], *alone[0]]
    assert again == alone[1]
    assert all(one.total_reward != other.total_reward for one, other in zip(*alone, strict=True))


def test_a_pretrained_toy_policy_masters_its_skills_and_not_the_targets() -> None:
    policy, _ = pretrained_policy(TOY, 0)
    with deterministic():
        episodes = Evaluator(TOY, 0).evaluate(policy, TOY.tasks)
    rates = {task.name: np.mean([e.success for e in episodes if e.task == task.name]) for task in TOY.tasks}
    assert rates["left"] == rates["up"] == 1.0
    assert rates["right"] == rates["down"] == 0.0


def test_a_policy_that_returns_nan_fails_its_episodes_and_stops_nothing(
    fetch_policy: Policy, caplog: pytest.LogCaptureFixture
) -> None:
    broken = TransformerPolicy(fetch_policy.config)
    next(broken.head.parameters()).data.fill_(float("nan"))
    episodes = Evaluator(_with_episodes(validation_episodes=2), 0).evaluate(broken, [FETCH.task("press")])
    assert not any(episode.success for episode in episodes)
    assert {episode.length for episode in episodes} == {FETCH.task("press").horizon}
    (warning,) = [entry.getMessage() for entry in caplog.records]
    assert warning == "TransformerPolicy: act() returned NaN or infinities, and NaN counts as 0."


def test_answers_are_counted_by_kind() -> None:
    policy, _ = pretrained_policy(TOY, 0)
    _, test = load_questions(TOY)
    kind, questions = scored_questions(test, 90)
    counts = answer(policy, test.kinds, kind, questions)
    assert [(name, asked) for name, asked, _ in counts] == [("side", 45), ("height", 45)]
    assert sum(correct for _, _, correct in counts) > 75
    swapped = dataclasses.replace(questions, answer=questions.answer.roll(1))
    assert sum(c for _, _, c in answer(policy, test.kinds, kind, swapped)) < 75


def test_nothing_is_measured_of_a_policy_in_training_mode() -> None:
    class Watched(TransformerPolicy):
        def hidden_states(self, *arguments: Any) -> list[torch.Tensor]:
            modes.append(self.training)
            return super().hidden_states(*arguments)

    modes: list[bool] = []
    policy = Watched(policy_config(TOY)).train()
    _, test = load_questions(TOY)
    kind, questions = scored_questions(test, 10)
    for measure in (
        lambda: answer(policy, test.kinds, kind, questions),
        lambda: activations(policy, questions),
        lambda: Evaluator(TOY, 0).evaluate(policy, [TOY.task("left")]),
    ):
        modes.clear()
        measure()
        assert modes
        assert not any(modes)
        assert policy.training


class Narrow(TransformerPolicy):
    """Its actions have one number, which NumPy would repeat."""

    def act(self, *observed: Any) -> Any:
        return super().act(*observed)[..., :1]


class Flat(TransformerPolicy):
    """It returns one action for each episode, and no chunk of actions."""

    def act(self, *observed: Any) -> Any:
        return super().act(*observed)[:, 0]


class Converted(TransformerPolicy):
    """It returns an array."""

    def act(self, *observed: Any) -> Any:
        return super().act(*observed).numpy()


@pytest.mark.parametrize("cls", [Narrow, Flat, Converted])
def test_actions_of_another_shape_are_refused_with_both_shapes(cls: type[TransformerPolicy]) -> None:
    policy = cls(policy_config(TOY), seed=0).eval()
    wanted = f"act\\(\\) of {cls.__name__} must return a tensor \\(B, H, A\\), here \\(40, .*, 2\\), not "
    with pytest.raises(WrongTypeError, match=wanted):
        Evaluator(TOY, 0).evaluate(policy, TOY.target[:1])


class Halved(TransformerPolicy):
    """It acts with half the digits."""

    def act(self, *observed: Any) -> Any:
        return super().act(*observed).bfloat16()


class Learning(TransformerPolicy):
    """Its actions have a gradient."""

    def act(self, *observed: Any) -> Any:
        return super().act(*observed).clone().requires_grad_()


@pytest.mark.parametrize(
    ("cls", "fault"),
    [
        (Halved, r"not one of type bfloat16 instead of float32\."),
        (Learning, r"not one with a gradient: use @torch\.inference_mode\(\)\."),
    ],
)
def test_actions_that_numpy_cannot_hold_are_refused_in_words_of_the_policy(
    cls: type[TransformerPolicy], fault: str
) -> None:
    policy = cls(policy_config(TOY), seed=0).eval()
    with pytest.raises(WrongTypeError, match=fault):
        Evaluator(TOY, 0).evaluate(policy, TOY.target[:1])


def test_the_episodes_of_a_split_stay_those_of_the_published_records() -> None:
    left = TOY.task("left")
    assert start_of(Trial(left, "test", 3), 5) == (1785073415, "move to the left")
    assert start_of(Trial(left, "validation", 3), 5) == (370372521, "move to the left")


def test_actions_are_clipped_before_a_world_gets_them(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = TransformerPolicy(policy_config(TOY))
    signs = torch.tensor([3.0, -7.0])
    monkeypatch.setattr(policy, "act", lambda state, words, noise, image: signs.expand_as(noise).clone())
    taken: list[Any] = []
    evaluator = Evaluator(TOY, seed=0)
    evaluator.play(policy, [Trial(TOY.task("left"), "validation", 0)], watch=lambda _, one: taken.append(one))
    evaluator.close()
    np.testing.assert_array_equal(taken, [[1.0, -1.0]] * len(taken))


def test_an_episode_ends_with_its_success_also_in_the_middle_of_a_chunk(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy, task = TransformerPolicy(policy_config(TOY)), TOY.task("left")
    to_the_left = torch.tensor([-0.7, 0.0])
    monkeypatch.setattr(
        policy, "act", lambda state, words, noise, image: to_the_left.expand_as(noise).clone()
    )
    trials = [Trial(task, "validation", number) for number in range(8)]
    episodes = Evaluator(TOY, seed=0).play(policy, trials)
    for trial, episode in zip(trials, episodes, strict=True):
        world, (start, _) = resolve(task.world)(), start_of(trial, 0)
        world.reset(seed=start, options={"task": task.name})
        outcomes = [world.step(to_the_left.numpy())[1:3] for _ in range(episode.length)]
        assert [success for _, success in outcomes] == [False] * (episode.length - 1) + [True]
        assert episode.total_reward == pytest.approx(sum(reward for reward, _ in outcomes))
        assert episode.success
    assert any(episode.length % policy.config.executed for episode in episodes)
