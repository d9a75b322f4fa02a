"""The table over scenarios: means of rows that are in all of them, and their intervals."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import NO_ESTIMATE, Estimate
from clbench.scoring.metrics import METRICS

RowSummary = resolve("clbench.leaderboard.board.summary:RowSummary")
mean_estimate = resolve("clbench.leaderboard.board.overall:mean_estimate")
overall = resolve("clbench.leaderboard.board.overall:overall")


def _row(scenario: str, method: str, final: float | None = 0.5, **fields: Any) -> Any:
    """Return a row whose metrics all have the same value."""
    one = NO_ESTIMATE if final is None else Estimate(final, final - 0.1, final + 0.1)
    row = RowSummary(
        scenario=scenario,
        method=method,
        division="prior-data-free",
        letters="a",
        tier="self-reported",
        seeds=(0,),
        to_criterion=True,
        estimates=dict.fromkeys(METRICS, one),
        costs={},
        order_sensitivity=None,
    )
    return dataclasses.replace(row, **fields)


def test_the_interval_of_a_mean_of_scenarios_has_the_error_of_independent_ones() -> None:
    parts = [Estimate(0.2, 0.1, 0.4), Estimate(0.6, 0.5, 0.7), Estimate(0.7, 0.3, 0.9)]
    found = mean_estimate(parts)
    assert found.value == pytest.approx(0.5)
    # errors of independent numbers add up in squares, and the mean has a third of the error of the sum
    assert found.low == pytest.approx(0.5 - math.sqrt(0.1**2 + 0.1**2 + 0.4**2) / 3)
    assert found.high == pytest.approx(0.5 + math.sqrt(0.2**2 + 0.1**2 + 0.2**2) / 3)


def test_the_mean_of_simulated_scenarios_is_in_its_interval_as_often_as_each_in_its_own() -> None:
    generator, held = np.random.default_rng(0), 0
    for _ in range(2000):
        values, errors = generator.normal(0, (0.1, 0.3)), (0.1, 0.3)
        parts = [
            Estimate(value, value - 1.96 * error, value + 1.96 * error)
            for value, error in zip(values, errors, strict=True)
        ]
        found = mean_estimate(parts)
        held += found.low <= 0 <= found.high
    assert held / 2000 == pytest.approx(0.95, abs=0.015)


def test_a_missing_value_leaves_no_mean_and_a_missing_interval_leaves_the_mean_alone() -> None:
    whole, alone = Estimate(0.2, 0.1, 0.3), Estimate(0.4, None, None)
    assert mean_estimate([whole, NO_ESTIMATE]) == NO_ESTIMATE
    found = mean_estimate([whole, alone])
    assert (found.value, found.low, found.high) == (pytest.approx(0.3), None, None)


def test_the_mean_of_ratios_is_geometric_and_so_is_its_interval() -> None:
    parts = [Estimate(2.0, 1.0, 4.0), Estimate(0.5, 0.25, 1.0)]
    found = mean_estimate(parts, ratio=True)
    reach = 2 ** math.sqrt(0.5)  # each interval ends a factor of 2 away
    assert (found.value, found.low, found.high) == pytest.approx((1.0, 1 / reach, reach))
    assert mean_estimate([*parts, Estimate(0.0, None, None)], ratio=True).value == pytest.approx(2.5 / 3)
    names = "clbench/One-v0", "clbench/Two-v0"
    pairs = zip(names, (2.0, 0.5), strict=True)
    (row,) = overall([_row(name, "sft", ratio, seeds=(0, 1)) for name, ratio in pairs])
    assert row.estimates["speed"].value == pytest.approx(1.0)
    assert row.estimates["kept"].value == pytest.approx(1.25)


def test_a_mean_over_a_scenario_with_one_seed_says_nothing_about_other_seeds() -> None:
    of_seeds, of_episodes = Estimate(0.4, 0.3, 0.5), Estimate(0.4, 0.3, 0.5, of_seeds=False)
    assert mean_estimate([of_seeds, of_seeds]).of_seeds
    assert not mean_estimate([of_seeds, of_episodes]).of_seeds


def test_only_methods_with_a_row_in_every_scenario_are_listed_the_best_first() -> None:
    names = one, two, three = "clbench/One-v0", "clbench/Two-v0", "clbench/Three-v0"
    finals = {"good": (0.8, 0.4, 0.6), "missing": (0.9, None, 0.9), "better": (0.8, 0.6, 0.7)}
    rows = [
        _row(name, method, final, letters="b" if name == two else "a")
        for method, values in finals.items()
        for name, final in zip(names, values, strict=True)
    ]
    rows += [_row(name, "reference", 0.9, division="reference") for name in names]
    rows += [_row(name, "two of three", 1.0) for name in (one, two)]
    rows += [_row(f"{three}+discrete_diffusion", "two of three", 1.0)]  # another policy is no scenario
    rows[-6] = dataclasses.replace(rows[-6], to_criterion=False)  # the reference, in the first scenario
    found = overall(rows)
    assert [row.method for row in found] == ["better", "good", "missing", "reference"]
    assert [row.to_criterion for row in found] == [True, True, True, False]
    good = found[1]
    assert good.estimates["retention"].value == pytest.approx(0.6)
    assert (good.scenarios, good.letters) == (names, ("a", "b", "a"))
    assert overall([row for row in rows if row.scenario == one]) == ()


def test_a_method_without_a_rival_in_a_scenario_has_no_letter_there() -> None:
    one, two = "clbench/One-v0", "clbench/Two-v0"
    (row,) = overall([_row(one, "sft", 0.5), _row(two, "sft", 0.5), _row(two, "lora", 0.4)])
    assert row.letters == (None, "a")


def test_a_method_of_two_divisions_has_no_mean_over_both() -> None:
    one, two = "clbench/One-v0", "clbench/Two-v0"
    rows = [_row(name, "sft", 0.5) for name in (one, two)]
    rows += [_row(one, "mine", 0.6), _row(two, "mine", 0.6, division="prior demonstrations")]
    assert [row.method for row in overall(rows)] == ["sft"]
