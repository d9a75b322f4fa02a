"""Figures of the claims against the records that they are computed from, by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from claims_bench import Bench
from helpers import reverse_targets, set_in
from scipy import stats

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.scoring.intervals import Estimate, interval_of_seeds
from clbench.testing import TOY

figures = {
    name: resolve(f"clbench.leaderboard.claims.figures:{name}")
    for name in (
        "anchor_distance",
        "drift_ratio",
        "early_success",
        "learning_curve",
        "median_stage",
        "perturbation_gain",
        "perturbation_loss",
        "retention_difference",
        "share_afterwards",
        "share_between",
        "share_of_steps",
    )
}
Figure = resolve("clbench.leaderboard.claims.evidence:Figure")
best_first = resolve("clbench.leaderboard.claims.claim:best_first")
deciding = resolve("clbench.leaderboard.claims.claim:deciding")
what_would_change = resolve("clbench.leaderboard.claims.claim:what_would_change")


@pytest.fixture
def add(bench: Bench, make_record: Callable[..., Record]) -> Callable[..., None]:
    """Return a function that adds a record of two skills and two targets, of the published order."""

    def add(method: str, seed: int, success: Any, **options: Any) -> None:
        record = make_record(success, groups=(2, 2, 1), method=method, seed=seed, **options)
        write_record(record, record_path(bench.folder / "records", TOY.id, method, seed))

    return add


def test_the_ratio_of_steps_is_a_geometric_mean_in_which_no_step_counts_as_one(bench: Bench) -> None:
    bench.add("fast_dvla", took=(0, 8))  # seed 0 takes a check longer: 2 steps
    bench.add("sft", took=(4, 8))  # seed 1: 6 steps
    evidence = bench.evidence()
    found = figures["share_of_steps"](evidence, "fast_dvla", "sft")
    ratios = [(2 / 4) * (8 / 8), (1 / 6) * (8 / 8), (1 / 4) * (8 / 8)]
    assert found.value == pytest.approx(np.prod(ratios) ** (1 / 6))  # two targets, three seeds
    assert figures["median_stage"](evidence, "sft").value == 7  # of 4, 4, 6, 8, 8 and 8


def test_stages_of_a_fixed_length_have_no_median_of_the_steps_to_the_criterion(bench: Bench) -> None:
    bench.add("sft")
    found = figures["median_stage"](bench.evidence(), "sft")
    assert (found.estimate.value, found.note) == (None, "not in these records")
    absent = figures["median_stage"](bench.evidence(), "lora")
    assert (absent.estimate.value, absent.missing) == (None, ("lora",))


def test_the_distance_to_the_anchor_is_that_of_the_first_stage_and_of_no_other(bench: Bench) -> None:
    distances = {"anchor_distance": [100.0, 25.0]}  # they are squared
    bench.add("aegis", diagnostics={"1": distances, "2": {"anchor_distance": [9.0, 1.0]}})
    bench.add("lora", diagnostics={"2": distances})
    bench.add("consft", diagnostics={"1": None, "2": distances})
    evidence = bench.evidence()
    for end, distance in (("before the first step", 10.0), ("at the end of the first stage", 5.0)):
        assert figures["anchor_distance"](evidence, "aegis", end).value == distance
        for method in ("lora", "consft"):
            assert figures["anchor_distance"](evidence, method, end).estimate.value is None


def test_the_share_of_weights_leaves_out_both_ends_and_the_last_tenth(bench: Bench) -> None:
    tables = {"1": [[1, 2, 3, 4, 90], [0, 50, 0, 0, 0]], "2": [[40, 0, 10, 0, 50], [0, 0, 0, 0, 9]]}
    bench.add("consft", diagnostics={stage: {"omega_counts": table} for stage, table in tables.items()})
    found = figures["share_between"](bench.evidence(), "consft")
    assert found.value == pytest.approx((2 + 3 + 4 + 10) / 200)
    later = figures["share_between"](bench.evidence(), "consft", afterwards=True)
    assert later.value == pytest.approx(50 / 59)
    assert figures["share_afterwards"](bench.evidence(), "consft").value == pytest.approx(59 / 259)


def test_the_curve_of_a_target_is_the_mean_of_the_seeds(bench: Bench, add: Callable[..., None]) -> None:
    success = [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 0]]
    for seed, first in enumerate((0.2, 0.6)):
        add("sft", seed, success, curves=[[first], [0.9]], steps=(50, 100))
    steps, curve = figures["learning_curve"](bench.evidence(), "sft")
    assert (steps, curve) == ((50, 100), pytest.approx([0.4, 1.0]))


def test_early_success_is_the_mean_over_the_points_of_all_stages(
    bench: Bench, add: Callable[..., None]
) -> None:
    success = [[1, 1, 0, 0, 0], [1, 1, 0.8, 0, 0], [1, 1, 1, 0.6, 0]]
    for seed in range(2):
        add("sft", seed, success, curves=[[0.4], [0.2]], steps=(50, 100))
        add("stop_gradient", seed, success, curves=[[0.1], [0.1]], steps=(50, 100))
    found = figures["early_success"](bench.evidence(), "stop_gradient", "sft")
    assert found.value == pytest.approx((0.1 + 0.8 + 0.1 + 0.6) / 4 - (0.4 + 0.8 + 0.2 + 0.6) / 4)


def test_the_loss_by_perturbation_is_that_from_what_was_learned(
    bench: Bench, add: Callable[..., None]
) -> None:
    def success(learned: float) -> list[list[float]]:
        return [[1, 1, 0, 0, 0], [1, 1, learned, 0, 0], [1, 1, 0, learned, 0]]

    for seed in range(2):
        for method, learned, displaced in (("sft", 1.0, (0.7, 0.6)), ("consft", 0.8, (0.6, 0.7))):
            perturbed = {"perturbed": np.ones((3, 2)), "perturbed_learned": displaced}
            add(method, seed, success(learned), **perturbed)
    evidence = bench.evidence()
    assert figures["perturbation_loss"](evidence, "sft").value == pytest.approx(1.0 - 0.65)
    gain = figures["perturbation_gain"](evidence, "consft", "sft")
    assert gain.value == pytest.approx((1.0 - 0.65) - (0.8 - 0.65))


def test_sparsity_and_drift_are_those_after_the_last_target(bench: Bench, add: Callable[..., None]) -> None:
    success = [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 0]]
    moved = {
        "sft": {"sparsity": [[0.8, 0.7], [0.6, 0.5]], "drift": [[1.0, 2.0], [3.0, 4.0]]},
        "consft": {"sparsity": [[0.9, 0.9], [0.9, 0.8]], "drift": [[1.0, 1.0], [1.0, 0.5]]},
    }
    for seed in range(2):
        for method, values in moved.items():
            add(method, seed, success, steps=(50, 100), **values)
    evidence = bench.evidence()
    assert evidence.difference("update_sparsity", "consft", "sft").value == pytest.approx(0.8 - 0.5)
    assert figures["drift_ratio"](evidence, "consft").value == pytest.approx((0.5 / 4.0) ** 0.5)


def test_a_target_that_no_policy_can_do_when_perturbed_costs_no_method_anything(
    bench: Bench, add: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    success = [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 0, 0.9, 0]]
    for seed in range(2):
        for method, displaced in (("sft", (0.5, 0.7)), ("consft", (0.4, 0.8))):
            add(method, seed, success, perturbed=np.ones((3, 2)), perturbed_learned=displaced)
    run = bench.evidence().runs["sft"][0]
    impossible = frozenset({run.scores.layout.target[0]})
    monkeypatch.setattr("clbench.leaderboard.claims.figures.IMPOSSIBLE", impossible)
    evidence = bench.evidence()
    assert figures["perturbation_loss"](evidence, "sft").value == pytest.approx(0.9 - 0.7)
    assert figures["perturbation_gain"](evidence, "consft", "sft").value == pytest.approx(0.2 - 0.1)


def test_a_difference_of_a_metric_may_be_twice_as_large_as_the_metric(
    bench: Bench, add: Callable[..., None]
) -> None:
    # backward transfer 0, -0.5 and 0 against -1
    for seed, earlier in enumerate((1.0, 0.5, 1.0)):
        for method, kept in (("consft", earlier), ("sft", 0.0)):
            add(method, seed, [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, kept, 1, 0]])
    found = bench.evidence().difference("backward_transfer", "consft", "sft")
    expected = interval_of_seeds(5 / 6, stats.sem([1.0, 0.5, 1.0]), 2, (-2.0, 2.0))
    assert (found.low, found.high) == pytest.approx(expected)


def test_methods_without_a_common_seed_have_no_difference_and_a_note_that_says_why(
    bench: Bench, add: Callable[..., None]
) -> None:
    for method, seeds in (("sft", (0, 1)), ("consft", (2, 3))):
        for seed in seeds:
            add(method, seed, [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 0]])
    found = bench.evidence().difference("retention", "consft", "sft")
    assert (found.estimate.value, found.seeds, found.missing) == (None, (), ())
    assert found.note == "the methods have no seed in common"


def test_a_preparation_is_a_share_of_all_steps(bench: Bench) -> None:
    bench.add("fast_dvla", costs={"optimiser_steps": 400, "preparation_steps": 100})
    assert bench.evidence().share_of_preparation("fast_dvla").value == 0.25


def test_a_note_tells_the_settings_in_which_methods_differ(bench: Bench) -> None:
    settings = {"replay": 0.9, "step_factor": 0.3, "other": 5}, {"tau_start": 0.03, "loss_scale": 0.01}
    for method, values in zip(("stranger", "other"), settings, strict=True):
        bench.add(method, edit=set_in("run", "settings", values))
    found = figures["retention_difference"](bench.evidence(), "stranger", "other")
    assert found.note == "stranger: replay 0.9, step_factor 0.3; other: tau_start 0.03, loss_scale 0.01"


def test_controls_of_another_simulator_than_the_boards_are_left_out(bench: Bench) -> None:
    bench.add("aegis")
    other = {"toy:world": "4567"}
    bench.add("aegis+direction=random", edit=lambda record: record.fingerprint.update(rollouts=other))
    evidence = bench.evidence()
    assert list(evidence.runs) == ["aegis"]
    assert {entry.reason for entry in evidence.not_used} == {
        "it cannot be compared with the board: rollouts differ."
    }


def test_the_largest_figure_comes_first_and_a_missing_one_never_does() -> None:
    small, large, missing = (
        Figure(name, (), Estimate(value, None, None))
        for name, value in (("small", -0.5), ("large", 0.5), ("missing", None))
    )
    assert best_first([missing, small, large]) == (large, missing, small)
    assert best_first([missing, small]) == (small, missing)


@pytest.mark.parametrize(
    ("verdict", "which"),
    [("does not hold", "near"), ("holds", "high"), ("holds in part", "high"), ("undecided", "missing")],
)
def test_the_figure_that_decides_is_the_first_that_would_change_the_verdict(verdict: str, which: str) -> None:
    ends = {"low": (-0.3, -0.2), "near": (-0.1, 0.19), "missing": (None, None), "high": (0.2, 0.3)}
    given = {name: Figure(name, (), Estimate(0.0, *both), (0, 1)) for name, both in ends.items()}
    of_verdict = [figure for name, figure in given.items() if verdict != "does not hold" or name != "high"]
    assert deciding(verdict, of_verdict, 0.20).what == which


@pytest.mark.parametrize("distance", [0.15, 0.1, 0.05, 0.026, 0.0245])
def test_the_seeds_that_would_decide_are_those_whose_interval_ends_at_the_bar(distance: float) -> None:
    figure = Figure("a gain", (), Estimate(0.05 + distance, distance - 0.15, distance + 0.25), (0, 1, 2, 3))
    deviation = 0.2 / stats.t.ppf(0.975, 3) * 2  # half of the width with 4 seeds is 0.2
    halves = {n: stats.t.ppf(0.975, n - 1) * deviation / n**0.5 for n in range(4, 101)}
    needed = next((f"about {n}" for n, half in halves.items() if half <= distance), "more than 100")
    assert f"At this spread, {needed} seeds would be needed: " in what_would_change(figure, 0.05)


def test_the_seeds_that_would_decide_a_share_near_0_are_those_of_its_own_interval() -> None:
    error = 0.00766  # of 12 seeds; the interval reaches far above the value, and not far below it
    ends = interval_of_seeds(0.0151, error, 11, (0.0, 1.0))
    figure = Figure("a share", (), Estimate(0.0151, *ends), tuple(range(12)), span=(0.0, 1.0))
    lows = {
        n: interval_of_seeds(0.0151, error * (12 / n) ** 0.5, n - 1, (0.0, 1.0))[0] for n in range(12, 101)
    }
    needed = next(n for n, low in lows.items() if low >= 0.01)
    assert f"At this spread, about {needed} seeds would be needed: " in what_would_change(figure, 0.01)


def test_the_seeds_that_would_decide_a_ratio_are_those_of_the_interval_of_its_logarithm(bench: Bench) -> None:
    ratios = (1.0, 1.5, 2.5, 6.0)
    bench.add("aegis", seeds=4, edit=lambda record: record.timing.update(step_ratio=ratios[record.run.seed]))
    figure = bench.evidence().step_time("aegis")
    assert figure.low < 1.2 < figure.value
    mean, deviation = np.mean(np.log(ratios)), np.std(np.log(ratios), ddof=1)
    lows = {n: mean - stats.t.ppf(0.975, n - 1) * deviation / n**0.5 for n in range(4, 101)}
    needed = next(n for n, low in lows.items() if low >= np.log(1.2))
    assert f"At this spread, about {needed} seeds would be needed: " in what_would_change(figure, 1.2)


def test_a_run_in_another_order_of_the_targets_is_no_evidence(bench: Bench, add: Callable[..., None]) -> None:
    for seed in range(2):
        add("sft", seed, [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [0.5, 0.5, 1, 1, 0]])
    success = [[1, 1, 0, 0, 0], [1, 1, 1, 0, 0], [0, 0, 1, 1, 0]]
    record = bench.make_record(success, groups=(2, 2, 1), seed=2, order=1)
    reverse_targets(record)
    write_record(record, record_path(bench.folder / "records", TOY.id, "sft", 2, 1))
    evidence = bench.evidence()
    found = evidence.metric("retention", "sft")
    assert (found.value, found.seeds, evidence.not_used) == (0.5, (0, 1), ())
