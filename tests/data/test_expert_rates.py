"""The measurement of experts."""

import pytest

from clbench.base.seeding import derive_seed
from clbench.data import expert_rates as experts
from clbench.data.demonstrations import demonstrate
from clbench.spec.registry import load_scenario
from clbench.testing import ToyWorld

TOY = load_scenario("clbench.testing:clbench/Toy-v0")


def test_the_experts_of_any_scenario_are_measured_and_the_same_each_time() -> None:
    rows = experts.measure(TOY, TOY.tasks, episodes=5)
    assert rows == experts.measure(TOY, TOY.tasks, episodes=5)
    assert [row.task for row in rows] == [task.name for task in TOY.tasks]
    assert {row.success for row in rows} == {1.0}
    assert all(experts.complaint(task, row) is None for task, row in zip(TOY.tasks, rows, strict=True))


def test_an_expert_that_fails_more_than_it_succeeds_is_named_with_the_way_out() -> None:
    row = experts.Measurement("left", "retained", 0.4, 1.0, 0.0, 10.0)
    said = experts.complaint(TOY.tasks[0], row)
    assert said is not None
    assert "succeeds in 40% of its episodes" in said
    assert TOY.tasks[0].name in said
    assert TOY.tasks[0].expert in said


def test_an_expert_has_the_mean_and_the_least_of_its_returns_and_its_mean_length() -> None:
    (row,) = experts.measure(TOY, TOY.tasks[:1], episodes=5)
    task, world = TOY.tasks[0], ToyWorld()
    seeds = [derive_seed("expert measure", task.seed_suite, task.name, number) for number in range(5)]
    played = [demonstrate(world, task, seed, noisy=False) for seed in seeds]
    returns = [float(episode.reward.sum()) for episode in played]
    assert row.lowest_return == min(returns) < row.mean_return  # those of the toy differ in their last bits
    assert row.mean_return == pytest.approx(sum(returns) / 5)
    assert row.mean_steps == sum(len(episode.executed) for episode in played) / 5
