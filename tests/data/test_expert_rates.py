"""The measurement of experts."""

from clbench.data import expert_rates as experts
from clbench.spec.registry import load_scenario

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
