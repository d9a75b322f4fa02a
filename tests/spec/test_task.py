import dataclasses
import importlib.metadata
import math
import platform
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from helpers import scenario_or_skip

from clbench.base.dependencies import require_packages
from clbench.base.entry_points import resolve
from clbench.spec.budget import Budget
from clbench.spec.identifiers import scenario_ids
from clbench.spec.limits import Limits
from clbench.spec.registry import load_scenario, registered_scenario
from clbench.spec.scenario import MOST_ORDERS, target_order

FETCH = "clbench/Fetch-v1"
PUBLISHED = "clbench/DMControl-v0"
"""A scenario in which all seeds learn the targets in their published order."""
TOY = load_scenario("clbench.testing:clbench/Toy-v0")


def test_an_unknown_scenario_is_answered_with_the_nearest() -> None:
    with pytest.raises(
        LookupError, match=r"No scenario is called 'clbench/Fecth-v1'. Did you mean 'clbench/Fetch-v1'"
    ):
        load_scenario("clbench/Fecth-v1")


def test_an_environment_that_is_no_scenario_is_refused() -> None:
    with pytest.raises(LookupError, match="No scenario is called 'CartPole-v1'"):
        load_scenario("CartPole-v1")


def test_a_module_that_cannot_be_imported_is_named() -> None:
    with pytest.raises(LookupError, match="No module 'no_such_module' can be imported"):
        load_scenario("no_such_module:x/Y-v0")


def test_the_module_before_the_colon_is_imported() -> None:
    assert load_scenario("clbench.testing:clbench/Toy-v0").id == "clbench/Toy-v0"


def test_an_unknown_task_is_answered_with_the_nearest() -> None:
    with pytest.raises(LookupError, match=r"is called 'pres'\. Did you mean 'press'"):
        load_scenario(FETCH).task("pres")


@pytest.mark.parametrize("scenario_id", scenario_ids())
def test_a_scenario_has_distinct_tasks_whose_entry_points_resolve(scenario_id: str) -> None:
    scenario = scenario_or_skip(scenario_id)
    names = [task.name for task in scenario.tasks]
    assert len(set(names)) == len(names)
    assert scenario.scene_tasks
    assert scenario.target
    for task in scenario.tasks:
        assert callable(resolve(task.world))
        assert callable(resolve(task.expert)(task.name))
        assert scenario.task(task.name) is task
        assert task in getattr(scenario, scenario.group(task.name))


@pytest.fixture(params=["target", "scenes"])
def unusable(request: pytest.FixtureRequest) -> Iterator[str]:
    """Register the toy as if a part of it needed a simulator that nobody has, and return its id."""
    name = "clbench/Unusable-v0"
    tasks = tuple(dataclasses.replace(task, packages=("no-simulator",)) for task in TOY.target)
    part: dict[str, Any] = {request.param: tasks}
    scenario = dataclasses.replace(TOY, id=name, **part)
    spec = gymnasium.envs.registration.EnvSpec(
        name, "clbench.worlds.scenario_env:ScenarioEnv", kwargs={"scenario": "clbench.testing:UNUSABLE"}
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clbench.testing.UNUSABLE", scenario, raising=False)
        patch.setitem(gymnasium.registry, name, spec)
        yield name


def test_a_scenario_without_its_simulator_is_data_and_names_the_package_to_install(unusable: str) -> None:
    scenario = registered_scenario(unusable)
    assert ("no-simulator",) in {task.packages for task in scenario.target + scenario.scenes}
    for use in (load_scenario, gymnasium.make):
        with pytest.raises(LookupError, match=f"{unusable} needs the package no-simulator: pip install no-"):
            use(unusable)


def test_a_package_of_an_extra_is_installed_as_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def version(package: str) -> str:
        raise importlib.metadata.PackageNotFoundError(package)

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(LookupError, match=r"A film needs the package pillow: pip install 'clbench\[film\]'"):
        require_packages(["pillow"], "A film")


def test_a_package_for_other_versions_of_python_is_not_to_be_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wanted = ["numpy>=2", "no-simulator==1; python_version < '3'", "no-game==2; python_version > '3'"]
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: wanted)
    reason = f'which clbench uses only where python_version < "3": this is Python {platform.python_version()}'
    with pytest.raises(LookupError, match=f"me/World-v0 needs the package no-simulator, {reason}$"):
        require_packages(["no-simulator"], "me/World-v0")
    with pytest.raises(LookupError, match=r"me/World-v0 needs the package no-game: pip install no-game$"):
        require_packages(["no-game"], "me/World-v0")


def test_the_fetch_scenario_has_the_promised_parts() -> None:
    scenario = load_scenario(FETCH)
    assert len(scenario.retained) >= 3
    assert len(scenario.target) >= 4
    assert len(scenario.held_out) >= 2
    assert len(resolve(scenario.questions)) >= 8
    assert all(len(task.instructions) >= 3 for task in scenario.tasks)


@pytest.mark.parametrize(
    ("steps", "points", "expected"),
    [(300, 4, (37, 75, 150, 300)), (8, 3, (2, 4, 8)), (2, 5, (1, 2)), (7, 1, (7,))],
)
def test_evaluation_points_double_and_end_with_the_stage(
    steps: int, points: int, expected: tuple[int, ...]
) -> None:
    assert Budget(adaptation_steps=steps, evaluation_points=points).evaluation_steps == expected


def test_a_budget_cannot_have_more_episodes_on_the_way_than_at_the_end() -> None:
    with pytest.raises(
        ValueError, match=r"Budget\.curve_episodes must be from 0 to test_episodes \(5\), not 6"
    ):
        Budget(test_episodes=5, curve_episodes=6)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"demonstrations": 0}, ValueError, "Budget.demonstrations must be at least 1, not 0"),
        ({"adaptation_steps": -5}, ValueError, "Budget.adaptation_steps must be at least 1, not -5"),
        ({"batch_size": 1}, ValueError, "Budget.batch_size must be at least 2, not 1"),
        ({"batch_size": 2.5}, TypeError, r"Budget.batch_size must be a whole number, not 2\.5"),
        ({"batch_size": True}, TypeError, "Budget.batch_size must be a whole number, not True"),
        ({"policy_width": 97}, ValueError, "Budget.policy_width must be a multiple of 4, .* not 97"),
        ({"noisy_demonstrations": 2}, ValueError, "Budget.noisy_demonstrations must be from 0 to 1, not 2"),
        ({"learning_rate": 0.0}, ValueError, "Budget.learning_rate must be above 0, not 0"),
        ({"learning_rate": math.inf}, ValueError, "Budget.learning_rate must be finite, not inf"),
        ({"learning_rate": math.nan}, ValueError, "Budget.learning_rate must be above 0, not nan"),
        ({"learning_rate": "fast"}, TypeError, "Budget.learning_rate must be a number, not 'fast'"),
    ],
)
def test_an_impossible_budget_is_refused_where_it_is_built(
    changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Budget(**changes)


def test_whole_numbers_of_numpy_become_pythons() -> None:
    budget = Budget(demonstrations=np.int64(5))  # type: ignore[arg-type]
    assert (budget.demonstrations, type(budget.demonstrations)) == (5, int)
    assert budget == Budget(demonstrations=5)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"seconds": -1}, ValueError, "Limits.seconds must be above 0, not -1"),
        ({"memory": "x"}, TypeError, "Limits.memory must be a whole number, not 'x'"),
        ({"written": 0}, ValueError, "Limits.written must be at least 1, not 0"),
    ],
)
def test_impossible_limits_are_refused_where_they_are_built(
    changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Limits(**changes)


@pytest.mark.parametrize(("count", "orders"), [(1, 1), (2, 2), (4, 24), (10, 1 + MOST_ORDERS)])
def test_all_orders_are_different_permutations_and_the_first_is_the_published_one(
    count: int, orders: int
) -> None:
    found = [target_order(count, order) for order in range(orders)]
    assert found[0] == tuple(range(count))
    assert len(set(found)) == orders
    assert all(sorted(one) == list(range(count)) for one in found)


@pytest.mark.parametrize("order", [-1, 24])
def test_an_unknown_order_is_refused_with_the_known_ones(order: int) -> None:
    with pytest.raises(ValueError, match=rf"{PUBLISHED}: 4 targets have orders 0 to 23, not {order}"):
        registered_scenario(PUBLISHED).in_order(order)


def test_an_order_never_changes() -> None:
    # published records may have these orders: a change of this line makes them false
    assert [target_order(4, order) for order in range(1, 4)] == [(3, 2, 1, 0), (3, 1, 0, 2), (0, 3, 1, 2)]


def test_in_another_order_nothing_but_the_targets_differs() -> None:
    published = registered_scenario(PUBLISHED)
    other = published.in_order(1)
    assert [task.name for task in other.target] == [published.target[index].name for index in (3, 2, 1, 0)]
    assert dataclasses.replace(other, target=published.target) == published
    assert published.in_order(0) is published


def test_a_task_is_shown_in_one_line() -> None:
    assert repr(TOY.task("left")) == "<Task toy/left: go left>"
