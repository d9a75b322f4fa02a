"""Predictors of forgetting, on made-up values and on boards of made-up records."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import kendalltau

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record

chance_among_equals = resolve("clbench.leaderboard.board.agreement:chance_among_equals")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
markdown = resolve("clbench.leaderboard.views.markdown:markdown")
prediction_of = resolve("clbench.leaderboard.board.agreement:prediction_of")
predictions = resolve("clbench.leaderboard.board.rows:predictions")


def test_tau_is_that_of_the_means_over_seeds_by_scipy() -> None:
    values = np.random.default_rng(0).random((8, 4, 2))
    means = values.mean(axis=1)
    expected = kendalltau(means[:, 0], means[:, 1]).statistic
    assert prediction_of("x", values).tau == pytest.approx(expected)


def test_the_interval_is_that_of_draws_of_seeds_shared_by_rows_and_quantities() -> None:
    values = np.random.default_rng(1).random((9, 8, 2))  # three seeds have so few draws that levels agree
    found = prediction_of("x", values, replicates=200)
    draws = np.random.default_rng(0).integers(8, size=(200, 8))
    taus = []
    for draw in draws:
        means = values[:, draw].mean(axis=1)
        taus.append(kendalltau(means[:, 0], means[:, 1]).statistic)
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(taus, (2.5, 97.5))))


def test_equal_methods_with_noise_that_correlates_seldom_seem_to_be_ordered() -> None:
    generator = np.random.default_rng(3)
    covariance = [[1.0, -0.6], [-0.6, 1.0]]
    kendalls, ours = 0, 0
    for _ in range(100):
        values = generator.multivariate_normal([0.0, 0.0], covariance, size=(12, 8))
        means = values.mean(axis=1)
        test = kendalltau(means[:, 0], means[:, 1])
        kendalls += test.pvalue < 0.05
        ours += chance_among_equals(test.statistic, values, boards=200) < 0.05
    assert ours <= 12 < kendalls  # 5 are expected; Kendall's test takes the two quantities for unrelated


def test_the_probability_of_a_tau_is_that_of_equal_methods_with_the_noise_of_the_board() -> None:
    values = np.random.default_rng(4).random((6, 5, 2)) + np.arange(6)[:, None, None]
    noise = [[[0.0, 0.0] for _ in range(5)] for _ in range(6)]
    for one in range(2):
        of_row = [sum(values[row, :, one]) / 5 for row in range(6)]
        of_seed = [sum(values[:, seed, one]) / 6 for seed in range(5)]
        for row in range(6):
            for seed in range(5):
                whole = sum(of_row) / 6
                noise[row][seed][one] = values[row, seed, one] - of_row[row] - of_seed[seed] + whole
    drawn = np.random.default_rng(0).integers(5, size=(300, 6, 5))
    taus = []
    for board in drawn:
        means = [
            [round(sum(noise[row][seed][one] for seed in board[row]) / 5, 9) for row in range(6)]
            for one in (0, 1)  # rounded: a row whose seeds are drawn once each has a mean of 0, a tie
        ]
        taus.append(kendalltau(*means).statistic)
    assert (
        chance_among_equals(1.0, values, boards=300) == (1 + sum(abs(tau) > 1 - 1e-9 for tau in taus)) / 301
    )
    assert (
        chance_among_equals(-0.6, values, boards=300)
        == (1 + sum(abs(tau) > 0.6 - 1e-9 for tau in taus)) / 301
    )
    assert chance_among_equals(0.0, values, boards=300) == 1.0


def test_a_predictor_that_is_equal_everywhere_predicts_nothing() -> None:
    values = np.random.default_rng(2).random((6, 3, 2))
    values[..., 0] = 1.0
    assert prediction_of("x", values) is None


class _Row:
    """A row of the board, as far as predictors read it."""

    def __init__(self, method: str, division: str, scores: dict[int, Any], to_criterion: bool = True) -> None:
        self.method, self.division, self.scores, self.to_criterion = method, division, scores, to_criterion
        self.seeds = tuple(scores)


@pytest.fixture
def rows(scores: Any) -> list[_Row]:
    """Seven methods, of which those with the greater shift and drift forget more, and a reference."""

    def run(number: int, seed: int) -> Any:
        left = 1 - 0.1 * number
        matrix = [[1, 1, 0, 0, 0], [left, left, 1, 0, 0], [left, left, left, 1, 0]]
        moved = number + 0.1 * seed
        options = {"sparsity": np.full((2, 1), 0.5), "drift": np.full((2, 1), moved), "shift": [moved, moved]}
        return scores(matrix, groups=(2, 2, 1), steps=(100,), ends=(8, 12), seed=seed, **options)

    names = ["sft", "ewc", "lora", "aegis", "lwf", "finch", "consft"]
    made = [
        _Row(name, "prior-data-free", {seed: run(number, seed) for seed in range(4)})
        for number, name in enumerate(names)
    ]
    return [*made, _Row("joint", "reference", {seed: run(9, seed) for seed in range(4)})]


def test_predictors_that_order_the_methods_as_forgetting_does_have_tau_1(rows: list[_Row]) -> None:
    found = {one.predictor: one for one in predictions(rows)}
    assert set(found) == {"the shift of the policy on the new data", "activation drift"}  # sparsity is equal
    for one in found.values():
        assert (one.tau, one.low, one.high, one.rows) == (1.0, 1.0, 1.0, 7)


def test_each_predictor_is_compared_with_the_share_of_what_was_known_that_is_lost(scores: Any) -> None:
    # success on two skills before and after the first stage: what is left falls, its share falls more
    known = [(8, 8), (10, 9), (12, 9), (14, 9), (16, 9), (18, 8), (20, 7)]

    def run(number: int, seed: int) -> Any:
        before, after = (count / 20 for count in known[number])
        matrix = [[before] * 2 + [0] * 3, [after] * 2 + [1, 0, 0], [after] * 2 + [1, 1, 0]]
        moved = {"sparsity": np.full((2, 1), 1 - 0.1 * number), "drift": np.full((2, 1), 9.0 - number)}
        shift = [1.0 + number % 3, 1.0]
        return scores(matrix, groups=(2, 2, 1), steps=(100,), ends=(8, 12), seed=seed, shift=shift, **moved)

    names = ["sft", "ewc", "lora", "aegis", "lwf", "finch", "consft"]
    made = [
        _Row(name, "prior-data-free", {seed: run(number, seed) for seed in range(4)})
        for number, name in enumerate(names)
    ]
    found = {one.predictor: one.tau for one in predictions(made)}
    shifts = [1.0 + number % 3 for number in range(7)]
    assert found == {
        "the shift of the policy on the new data": pytest.approx(kendalltau(shifts, range(7)).statistic),
        "the share of the weights that changed": 1.0,
        "activation drift": -1.0,
    }
    for row in made:
        row.scores = {seed: row.scores[seed] for seed in range(3)}
        row.seeds = tuple(row.scores)
    assert predictions(made) == []  # three seeds are too few


def test_few_rows_and_rows_of_equal_stages_have_no_prediction(rows: list[_Row]) -> None:
    assert predictions(rows[:5]) == []
    for row in rows:
        row.to_criterion = False
    assert predictions(rows) == []


def test_a_row_without_a_seed_of_the_baseline_is_left_out(rows: list[_Row]) -> None:
    rows[1].seeds = (0,)
    assert {one.rows for one in predictions(rows)} == {6}


def test_a_board_has_the_predictions_of_its_scenarios_and_the_page_writes_them(
    make_record: Callable[..., Record], tmp_path: Path
) -> None:
    for number, method in enumerate(["sft", "ewc", "lora", "aegis", "lwf", "finch"]):
        left = 1 - 0.1 * number
        matrix = [[1, 1, 0, 0, 0], [left, left, 1, 0, 0], [left, left, left, 1, 0]]
        for seed in range(4):
            moved = {"sparsity": np.full((2, 1), 0.5), "drift": np.full((2, 1), number + 0.1 * seed)}
            options = {"groups": (2, 2, 1), "steps": (100,), "ends": (8, 12), **moved}
            record = make_record(matrix, method=method, seed=seed, **options)
            write_record(record, record_path(tmp_path / "records", record.run.scenario, method, seed))
    board = compute_board(tmp_path / "records")
    (found,) = board.predictions.values()
    assert list(found) == predictions(board.rows)
    assert [(one.predictor, one.tau, one.rows) for one in found] == [("activation drift", 1.0, 6)]
    assert "a stage: activation drift 1.00, 1.00 to 1.00 with redrawn seeds" in markdown(board, {})
