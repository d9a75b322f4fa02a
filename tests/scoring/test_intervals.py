"""Intervals against simulations, against SciPy, against closed forms and against exact cases."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

from clbench.base.errors import InputError
from clbench.scoring.expected_precision import half_width
from clbench.scoring.intervals import (
    NO_ESTIMATE,
    Estimate,
    estimate,
    estimate_quantity,
    paired_difference,
    row_generator,
)
from clbench.scoring.layout import Layout
from clbench.scoring.metrics import METRICS, load_metric, measure
from clbench.scoring.scores import Scores


def of_episodes(value: float, low: float, high: float) -> Estimate:
    """Return an estimate whose interval says nothing of other seeds."""
    return Estimate(value, low, high, of_seeds=False)


def layout(retained: int, episodes: int, targets: int = 1, held_out: int = 0, points: int = 1) -> Layout:
    return Layout(
        retained=tuple(f"skill_{number}" for number in range(retained)),
        target=tuple(f"target_{number}" for number in range(targets)),
        held_out=tuple(f"unseen_{number}" for number in range(held_out)),
        episodes=tuple(range(episodes)),
        curve_episodes=tuple(range((episodes + 1) // 2)),
        validation_episodes=tuple(range(10)),
        steps=tuple(100 * (number + 1) for number in range(points)),
        kinds=("left", "above"),
    )


def scores(final: Any, correct: int = 50) -> Scores:
    """Return a run whose outcomes on the skills after its only target are `final`, (skills, episodes)."""
    final = np.asarray(final, dtype=float)
    success = np.ones((2, len(final) + 1, final.shape[1]))
    success[1, : len(final)] = final
    return whole_run(layout(*final.shape), success, correct=np.full((2, 2), float(correct)))


def whole_run(shape: Layout, success: Any, **arrays: Any) -> Scores:
    """Return a run with the outcomes `success` at the ends and the given `arrays`; the others are missing."""
    targets, points = len(shape.target), len(shape.steps)
    counts = np.full((targets + 1, len(shape.kinds)), 100.0)
    on_the_way = np.full((targets, points - 1, len(shape.tasks), len(shape.curve_episodes)), np.nan)
    curves = ("answer_curves", "update_sparsity", "activation_drift")
    missing = {name: np.full((targets, points), np.nan) for name in curves}
    perturbed = np.full((targets + 1, len(shape.tasks), len(shape.episodes)), np.nan)
    given = {
        "perturbed": perturbed,
        "on_the_way": on_the_way,
        "asked": counts,
        "correct": counts / 2,
        "steps": np.full(targets, np.nan),
        "met": np.full(targets, np.nan),
        "shift": np.full(targets, np.nan),
        "captured": np.full(targets, np.nan),
        "relearning_steps": np.array(np.nan),
        **missing,
        **arrays,
    }
    return Scores(layout=shape, success=success, **given)


def random_run(generator: np.random.Generator, shape: Layout) -> Scores:
    """Return a run of coin flips."""
    targets, points, tasks = len(shape.target), len(shape.steps), len(shape.tasks)
    on_the_way = (targets, points - 1, tasks, len(shape.curve_episodes))
    perturbed = (targets + 1, len(shape.tasks), len(shape.episodes))
    return whole_run(
        shape,
        success=generator.integers(0, 2, (targets + 1, tasks, len(shape.episodes))).astype(float),
        on_the_way=generator.integers(0, 2, on_the_way).astype(float),
        perturbed=generator.integers(0, 2, perturbed).astype(float),
        correct=generator.integers(0, 101, (targets + 1, 2)).astype(float),
        answer_curves=generator.random((targets, points)),
        update_sparsity=generator.random((targets, points)),
        activation_drift=generator.random((targets, points)),
        steps=generator.integers(1, 100, targets).astype(float),
        met=generator.integers(0, 2, targets).astype(float),
        shift=generator.random(targets),
        captured=generator.random(targets),
        relearning_steps=np.array(float(generator.integers(1, 100))),
    )


def width(one: Estimate) -> float:
    assert one.low is not None
    assert one.high is not None
    return one.high - one.low


def test_the_value_is_the_mean_of_the_seeds_values() -> None:
    generator = np.random.default_rng(0)
    shape = layout(3, 5, targets=3, held_out=2, points=2)
    runs = {seed: random_run(generator, shape) for seed in range(3)}
    estimates = estimate(METRICS, runs, generator, replicates=10)
    for name in {name for name, metric in METRICS.items() if not metric.references}:
        values = [measure(name, run) for run in runs.values()]
        assert estimates[name].value == pytest.approx(np.mean(np.array(values, dtype=float)))


def test_forward_transfer_averages_curves_over_seeds_before_the_ratio() -> None:
    shape = layout(1, 1)
    curves = {"run": [0.0, 1.0], "from_scratch": [1.0, 0.0]}
    runs = {
        name: {
            seed: whole_run(shape, np.array([[[0.0], [0.0]], [[0.0], [value]]]))
            for seed, value in enumerate(values)
        }
        for name, values in curves.items()
    }
    got = estimate(["forward_transfer"], runs["run"], np.random.default_rng(0), references=runs)
    assert got["forward_transfer"].value == pytest.approx(0.0)  # seed by seed: the mean of -1 and 0.5


def test_the_same_row_has_the_same_numbers_whatever_else_is_asked() -> None:
    generator = np.random.default_rng(0)
    shape = layout(3, 5, targets=3, held_out=2, points=2)
    runs, others = ({seed: random_run(generator, shape) for seed in range(3)} for _ in range(2))
    first = estimate(METRICS, runs, row_generator("clbench/Toy-v0", "sft"), references={"other": others})
    again = estimate(["retention"], runs, row_generator("clbench/Toy-v0", "sft"))
    backwards = estimate(
        METRICS, dict(sorted(runs.items(), reverse=True)), row_generator("clbench/Toy-v0", "sft")
    )
    assert first["retention"] == again["retention"]
    assert first == backwards


def test_rows_have_generators_of_their_own() -> None:
    names = [("a", "b"), ("a", "c"), ("b", "b"), ("ab", ""), ("", "ab"), ("\ud800", "b")]
    draws = {row_generator(*pair).integers(2**62) for pair in names}
    assert len(draws) == len(names)


def test_with_one_seed_and_task_the_interval_is_scipys() -> None:
    outcomes = np.random.default_rng(0).random(40) < 0.7
    got = estimate(["retention"], {0: scores([outcomes])}, np.random.default_rng(1), replicates=20_000)
    expected = stats.bootstrap(
        (outcomes.astype(float),),
        np.mean,
        method="percentile",
        n_resamples=20_000,
        rng=np.random.default_rng(2),
    ).confidence_interval
    assert got["retention"].low == pytest.approx(expected.low, abs=0.026)  # one episode is 0.025
    assert got["retention"].high == pytest.approx(expected.high, abs=0.026)


def test_answers_vary_like_binomials() -> None:
    got = estimate(
        ["question_retention"], {0: scores([[1, 0]], 80)}, np.random.default_rng(0), replicates=20_000
    )["question_retention"]
    low, high = stats.binom(200, 0.8).interval(0.95) / np.array(200)
    assert got.value == 0.8
    assert got.low == pytest.approx(low, abs=0.006)  # one answer is 0.005
    assert got.high == pytest.approx(high, abs=0.006)


def test_seeds_are_drawn_as_whole_runs() -> None:
    # Two seeds, one good at everything and one at nothing. Drawn apart, six tasks would hide it.
    runs = {0: scores(np.ones((6, 20))), 1: scores(np.zeros((6, 20)))}
    got = estimate(["retention"], runs, np.random.default_rng(0))["retention"]
    assert (got.value, got.low, got.high) == pytest.approx((0.5, 0.002, 0.998), abs=5e-4)


def test_the_episodes_of_a_run_are_the_same_at_all_stages() -> None:
    # Which episodes succeed varies, but each succeeds at both stages or at neither: nothing was forgotten.
    final = np.random.default_rng(0).random((4, 20)) < 0.5
    run = scores(final)
    run.success[0] = run.success[1]
    got = estimate(["retention", "forgetting"], {0: run}, np.random.default_rng(0))
    assert got["forgetting"] == of_episodes(0.0, 0.0, 0.0)
    assert width(got["retention"]) > 0.1


def test_more_episodes_make_a_narrower_interval() -> None:
    generator = np.random.default_rng(0)
    few, many = (
        estimate(["retention"], {0: scores(generator.random((3, episodes)) < 0.5)}, generator)["retention"]
        for episodes in (10, 160)
    )
    assert width(many) == pytest.approx(width(few) / 4, rel=0.35)


def rate_of_seeds(rates: Any, tasks: int, episodes: int, generator: np.random.Generator) -> dict[int, Scores]:
    """Return a run for each of the success rates of the seeds."""
    return {seed: scores(generator.random((tasks, episodes)) < rate) for seed, rate in enumerate(rates)}


@pytest.mark.parametrize(("seeds", "spread"), [(1, 0.0), (3, 0.05), (5, 0.1)])
def test_intervals_hold_the_truth_about_as_often_as_they_should(seeds: int, spread: float) -> None:
    generator = np.random.default_rng(0)
    held = 0
    for _ in range(300):
        runs = rate_of_seeds(0.6 + spread * generator.standard_normal(seeds), 6, 20, generator)
        got = estimate(["retention"], runs, generator, replicates=300)["retention"]
        assert got.low is not None
        assert got.high is not None
        held += got.low <= 0.6 <= got.high
    assert 0.92 <= held / 300 <= 0.98  # 0.95 within two and a half standard errors


def test_the_interval_of_a_rate_ends_where_the_value_is_just_likely() -> None:
    # Retentions 0.4, 0.5 and 0.9: the error at a rate is Student's, scaled by the root of rate (1 - rate).
    runs = {0: scores([[1] * 4 + [0] * 6]), 1: scores([[1] * 5 + [0] * 5]), 2: scores([[1] * 9 + [0]])}
    got = estimate(["retention"], runs, np.random.default_rng(0))["retention"]
    assert got.value == pytest.approx(0.6)
    reach = stats.t.ppf(0.975, 2) * stats.sem([0.4, 0.5, 0.9])

    def excess(rate: float) -> float:
        return float(abs(rate - 0.6) - reach * np.sqrt(rate * (1 - rate) / (0.6 * 0.4)))

    assert got.low == pytest.approx(optimize.brentq(excess, 1e-9, 0.6), rel=1e-6)
    assert got.high == pytest.approx(optimize.brentq(excess, 0.6, 1 - 1e-9), rel=1e-6)


def test_the_interval_of_pooled_curves_is_the_jackknifes() -> None:
    generator, shape = np.random.default_rng(3), layout(1, 10, targets=2, points=3)
    runs, scratch = ({seed: random_run(generator, shape) for seed in range(4)} for _ in range(2))

    def transfer(seeds: list[int]) -> float:
        some, references = ({seed: them[seed] for seed in seeds} for them in (runs, scratch))
        one = estimate(["forward_transfer"], some, generator, references={"from_scratch": references})
        return one["forward_transfer"].value or np.nan

    without_one = np.array([transfer([one for one in range(4) if one != seed]) for seed in range(4)])
    error = np.sqrt(3 / 4 * ((without_one - without_one.mean()) ** 2).sum())
    value = transfer([0, 1, 2, 3])
    got = estimate(["forward_transfer"], runs, generator, references={"from_scratch": scratch})
    reach = stats.t.ppf(0.975, 3) * error
    assert got["forward_transfer"].low == pytest.approx(value - reach, rel=1e-3)
    assert got["forward_transfer"].high == pytest.approx(min(value + reach, 1.0), rel=1e-3)


def test_intervals_stay_in_the_range_of_their_metric_and_hold_their_value() -> None:
    generator, shape = np.random.default_rng(0), layout(2, 3, targets=2, held_out=1, points=2)
    seen = set()
    for seeds in (1, 2, 3):
        for _ in range(5):
            runs, others = ({seed: random_run(generator, shape) for seed in range(seeds)} for _ in range(2))
            references = dict.fromkeys(("from_scratch", "joint", "sft"), others)
            for name, one in estimate(METRICS, runs, generator, references=references, replicates=50).items():
                if one.value is not None and one.low is not None and one.high is not None:
                    assert METRICS[name].low <= one.low <= one.value <= one.high <= METRICS[name].high
                    seen.add(name)
    assert seen == METRICS.keys()


def test_seeds_that_agree_exactly_have_the_error_of_episodes_and_the_quantile_of_seeds() -> None:
    half = scores(np.tile([1, 0], (4, 10)))
    got, alone = (
        estimate(["retention"], dict.fromkeys(range(seeds), half), np.random.default_rng(0))["retention"]
        for seeds in (4, 1)
    )
    assert got.value == 0.5
    error = 0.5 / np.sqrt(4 * 20)
    assert width(got) == pytest.approx(2 * stats.t.ppf(0.975, 3) * error / np.sqrt(4), rel=0.15)
    assert width(alone) == pytest.approx(2 * 1.96 * error, rel=0.15)
    assert got.of_seeds
    assert not alone.of_seeds


def test_seeds_that_agree_on_a_quantity_of_whole_runs_have_no_interval_of_it() -> None:
    run = random_run(np.random.default_rng(0), layout(5, 20, targets=4))
    run = replace(run, met=np.array([1.0, 1.0, 0.0, 1.0]), relearning_steps=np.asarray(0.0))
    for seeds in (4, 1):
        runs = dict.fromkeys(range(seeds), run)
        got = estimate(["criterion_met", "relearning_steps"], runs, np.random.default_rng(0))
        assert got["criterion_met"] == Estimate(0.75, None, None)
        assert got["relearning_steps"] == Estimate(0.0, None, None)


def test_only_an_interval_of_seeds_is_above_or_below_a_bar() -> None:
    for estimate_, above, below in (
        (Estimate(0.2, 0.1, 0.3), True, False),
        (Estimate(-0.2, -0.3, -0.1), False, True),
        (Estimate(0.1, 0.0, 0.2), False, False),
        (Estimate(0.2, None, None), False, False),
        (of_episodes(0.2, 0.1, 0.3), False, False),
        (of_episodes(-0.2, -0.3, -0.1), False, False),
    ):
        assert (estimate_.is_above(0), estimate_.is_below(0)) == (above, below)


def test_methods_with_other_numbers_of_runs_are_not_compared() -> None:
    runs = [scores(np.ones((4, 20))) for _ in range(3)]
    for first, second in ((runs, runs[:2]), (runs[:2], runs), ([], [])):
        with pytest.raises(
            InputError, match="runs of the same seeds, in the same order, and at least one run"
        ):
            estimate_quantity(
                lambda rates: rates["one"].success.mean(axis=(-1, -2, -3)),
                {"one": first, "two": second},
                np.random.default_rng(0),
            )


def test_an_exactly_known_quantity_has_no_width() -> None:
    # A frozen policy meets the same episodes at all stages: it forgets none of its skills.
    generator, shape = np.random.default_rng(0), layout(3, 10, targets=2)
    frozen = {}
    for seed in range(3):
        outcomes = (generator.random((1, 5, 10)) < 0.5).astype(float)
        frozen[seed] = whole_run(shape, np.repeat(outcomes, 3, axis=0))
    for runs, of_seeds in ((frozen, True), ({0: frozen[0]}, False)):
        got = estimate(["forgetting", "backward_transfer", "retention"], runs, generator)
        expected = Estimate(0.0, 0.0, 0.0, of_seeds=of_seeds)
        assert got["forgetting"] == got["backward_transfer"] == expected
        assert width(got["retention"]) > 0


def test_if_all_outcomes_are_equal_the_interval_has_no_width() -> None:
    runs = {seed: scores(np.ones((6, 20))) for seed in range(3)}
    got = estimate(["retention"], runs, np.random.default_rng(0))["retention"]
    assert got == Estimate(1.0, 1.0, 1.0)


@pytest.mark.parametrize(("seeds", "deviation"), [(3, 0.05), (5, 0.0), (5, 0.1)])
def test_the_width_to_expect_agrees_with_simulated_rows(seeds: int, deviation: float) -> None:
    generator = np.random.default_rng(0)
    rates = 0.5 + deviation * generator.standard_normal((100, seeds))
    widths = [
        width(estimate(["retention"], rate_of_seeds(row, 6, 20, generator), generator)["retention"])
        for row in rates
    ]
    root_mean_square = np.sqrt(np.mean(np.square(widths))) / 2
    assert half_width(seeds, 20, 6, seed_deviation=deviation) == pytest.approx(root_mean_square, rel=0.1)


def test_a_metric_without_value_has_no_interval() -> None:
    estimates = estimate(METRICS, {0: scores([[1, 0]])}, np.random.default_rng(0))
    assert estimates["zero_shot"] == estimates["forward_transfer"] == NO_ESTIMATE
    assert estimate(["retention"], {}, np.random.default_rng(0)) == {"retention": NO_ESTIMATE}


def test_a_reference_meets_the_draws_of_the_method_that_is_compared_with_it() -> None:
    generator = np.random.default_rng(5)
    runs, others = ({0: scores(generator.integers(0, 2, size=(2, 20)))} for _ in range(2))
    same = estimate(["gain"], runs, np.random.default_rng(0), references={"sft": runs})["gain"]
    assert same == of_episodes(0.0, 0.0, 0.0)
    found = estimate(["gain"], runs, np.random.default_rng(0), references={"sft": others})["gain"]
    paired = paired_difference("final_average", runs, others, np.random.default_rng(0))
    assert (found.low, found.high) == pytest.approx((paired.low, paired.high))


def test_a_reference_that_lacks_a_seed_is_missing() -> None:
    runs = {seed: scores([[1, 0]]) for seed in range(2)}
    short = {"from_scratch": {0: runs[0]}}
    got = estimate(["forward_transfer"], runs, np.random.default_rng(0), references=short)
    assert got["forward_transfer"] == NO_ESTIMATE


def test_an_unknown_metric_is_a_lookup_error() -> None:
    with pytest.raises(LookupError, match="zero_shot"):
        estimate(["zero_shots"], {}, np.random.default_rng(0))


def test_a_method_does_not_differ_from_itself() -> None:
    generator = np.random.default_rng(0)
    runs = {seed: scores(generator.random((4, 20)) < 0.5) for seed in range(3)}
    assert paired_difference("retention", runs, runs, generator) == Estimate(0.0, 0.0, 0.0)


@pytest.mark.parametrize("seeds", [1, 8])
def test_pairing_makes_the_interval_of_a_difference_narrower(seeds: int) -> None:
    generator = np.random.default_rng(0)
    luck = generator.random((seeds, 4, 20))
    runs, others = ({seed: scores(luck[seed] < rate) for seed in range(seeds)} for rate in (0.6, 0.5))
    difference = paired_difference("retention", runs, others, generator)
    alone = [estimate(["retention"], them, generator)["retention"] for them in (runs, others)]
    assert difference.value == pytest.approx((alone[0].value or 0) - (alone[1].value or 0))
    assert width(difference) < 0.7 * np.hypot(width(alone[0]), width(alone[1]))


def test_with_one_seed_and_task_the_paired_interval_is_scipys() -> None:
    generator = np.random.default_rng(0)
    luck = generator.random(40)
    ours, theirs = luck < 0.8, (luck + 0.3 * generator.random(40)) < 0.6
    got = paired_difference(
        "retention", {0: scores([ours])}, {0: scores([theirs])}, generator, replicates=20_000
    )
    expected = stats.bootstrap(
        (ours.astype(float), theirs.astype(float)),
        lambda first, second, axis: first.mean(axis) - second.mean(axis),
        paired=True,
        method="percentile",
        n_resamples=20_000,
        rng=np.random.default_rng(2),
    ).confidence_interval
    assert got.low == pytest.approx(expected.low, abs=0.026)
    assert got.high == pytest.approx(expected.high, abs=0.026)


def test_a_metric_that_needs_a_reference_has_no_paired_difference() -> None:
    generator = np.random.default_rng(0)
    shape = layout(2, 10, targets=2, points=2)
    runs, others = ({seed: random_run(generator, shape) for seed in range(3)} for _ in range(2))
    assert paired_difference("forward_transfer", runs, others, generator) == NO_ESTIMATE


def test_only_seeds_that_both_have_are_compared() -> None:
    good, bad = scores(np.ones((2, 5))), scores(np.zeros((2, 5)))
    difference = paired_difference(
        "retention", {0: good, 1: bad}, {0: bad, 2: good}, np.random.default_rng(0)
    )
    assert difference == of_episodes(1.0, 1.0, 1.0)
    assert paired_difference("retention", {0: good}, {1: bad}, np.random.default_rng(0)) == NO_ESTIMATE


def test_methods_that_met_different_episodes_are_not_compared() -> None:
    runs, others = {0: scores(np.ones((2, 5)))}, {0: scores(np.ones((2, 6)))}
    with pytest.raises(ValueError, match="different tasks, episodes"):
        paired_difference("retention", runs, others, np.random.default_rng(0))


def test_every_metric_has_an_interval() -> None:
    generator = np.random.default_rng(1)
    shape = layout(5, 20, targets=4, held_out=3, points=4)
    runs, scratch = ({seed: random_run(generator, shape) for seed in range(3)} for _ in range(2))
    references = dict.fromkeys(("from_scratch", "joint", "sft"), scratch)
    estimates = estimate(METRICS, runs, generator, references=references)
    assert all(one.low is not None for one in estimates.values())


def test_a_bootstrap_of_any_quantity_gives_a_difference_of_metrics_its_interval() -> None:
    generator, shape = np.random.default_rng(5), layout(3, 8, targets=2, points=3)
    ours, theirs = ([random_run(generator, shape) for _ in range(3)] for _ in range(2))
    retention = load_metric("retention").over_runs
    got = estimate_quantity(
        lambda rates: retention(rates["ours"]) - retention(rates["theirs"]),
        {"ours": ours, "theirs": theirs},
        np.random.default_rng(1),
        span=(-1, 1),
    )
    runs, others = dict(enumerate(ours)), dict(enumerate(theirs))
    assert got == paired_difference("retention", runs, others, np.random.default_rng(1))
