"""Orders of the targets: the rows of Latin squares."""

import dataclasses
from collections import Counter
from itertools import pairwise

import pytest

from clbench.base.errors import InputError, UnknownNameError
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import balanced_order
from clbench.testing.toy import TOY


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6])
def test_each_square_of_seeds_learns_every_target_once_in_every_position(count: int) -> None:
    for square in range(3):
        orders = [balanced_order(count, seed) for seed in range(square * count, (square + 1) * count)]
        for position in range(count):
            assert sorted(order[position] for order in orders) == list(range(count))
        for order in orders:
            assert sorted(order) == list(range(count))


@pytest.mark.parametrize("count", [2, 4, 6])
def test_with_an_even_number_every_target_follows_every_other_once_in_a_square(count: int) -> None:
    for square in range(3):
        orders = [balanced_order(count, seed) for seed in range(square * count, (square + 1) * count)]
        follows = Counter(pair for order in orders for pair in pairwise(order))
        assert len(follows) == count * (count - 1)
        assert set(follows.values()) == {1}


def test_the_first_seed_has_the_published_order_and_later_squares_differ() -> None:
    assert balanced_order(4, 0) == (0, 1, 2, 3)
    assert {balanced_order(4, seed) for seed in range(4)} != {balanced_order(4, seed) for seed in range(4, 8)}


def test_without_targets_there_is_nothing_to_order() -> None:
    assert balanced_order(0, 5) == ()


def test_only_a_balanced_scenario_has_an_order_for_each_seed() -> None:
    balanced = dataclasses.replace(TOY, balanced=True)
    assert [task.name for task in balanced.for_seed(1).target] == ["down", "right"]
    assert balanced.for_seed(1).retained == TOY.retained
    assert TOY.for_seed(1) is TOY


def test_a_wrong_name_of_a_task_is_told_the_nearest_task_also_of_the_background() -> None:
    fetch = load_scenario("clbench/Fetch-v1")
    with pytest.raises(UnknownNameError, match="Did you mean 'push'"):
        fetch.task("pusch")
    assert fetch.group("push") == "background"  # it is trained, but not scored
    with pytest.raises(UnknownNameError, match="Did you mean 'push'"):
        fetch.group("pusch")


def test_a_scenario_whose_seeds_have_their_own_orders_says_so_when_another_order_is_asked_for() -> None:
    with pytest.raises(InputError, match=r"has no order 1: each seed .* Leave out --order \(order="):
        load_scenario("clbench/Fetch-v1").in_order(1)
