"""Certainty of gains: over settings of fine-tuning that tuning rated as highly, and among many methods."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clbench.base.entry_points import resolve
from clbench.runs.tuning import Tried, Tuned
from clbench.scoring.groups import groups
from clbench.scoring.intervals import Estimate

SCENARIO = "clbench/Even-v1"
MODULE = "clbench.leaderboard.board.certainty"
TiedGain, side_of_zero, sides_of_gains, tied_gains = (
    resolve(f"{MODULE}:{name}") for name in ("TiedGain", "side_of_zero", "sides_of_gains", "tied_gains")
)
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
ladder_of = resolve("clbench.leaderboard.board.frontier:ladder_of")
read_ladder = resolve("clbench.leaderboard.board.frontier:read_ladder")
read_run = resolve("clbench.leaderboard.board.runs:read_run")


@pytest.fixture
def _tuned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tuning have rated plain fine-tuning alike at 0.1, which it chose, and at 0.3."""
    scores = {1.0: 0.4, 0.1: 0.6, 0.3: 0.6, 0.03: 0.5}
    tried = tuple(Tried({"step_factor": factor}, final, 0.9) for factor, final in scores.items())
    found = {"sft": Tuned({"step_factor": 0.1}, tried)}
    monkeypatch.setattr(f"{MODULE}.tuned", lambda name: found if name == SCENARIO else {})


@pytest.mark.usefixtures("_tuned")
def test_a_gain_over_a_tied_setting_is_that_over_plain_fine_tuning_there_on_common_seeds(
    even_board: Callable[..., Path],
) -> None:
    for seed, kept in enumerate((0.6, 0.6, 0.7, 0.9)):
        records = even_board("lora", seed, kept)
    for seed, kept in enumerate((0.2, 0.2, 0.5)):
        even_board("sft", seed, kept, "ladder", step_factor=0.3)
        even_board("sft", seed, 0.0, "ladder", step_factor=0.1)  # tuning's choice is on the board already
        even_board("stop_gradient", seed, 0.9, "ladder", step_factor=0.3)
    runs = [read_run(records, path) for path in sorted(records.rglob("seed-*.json"))]
    ladder, _ = read_ladder(ladder_of(records))
    (one,) = tied_gains(SCENARIO, {"lora": {run.seed: run.scores for run in runs}}, ladder)["lora"]
    assert (one.factor, one.seeds) == (0.3, 3)
    # the final average has three tasks that are kept, and the last target, which all learn alike
    differences = [3 / 4 * (0.6 - 0.2), 3 / 4 * (0.6 - 0.2), 3 / 4 * (0.7 - 0.5)]
    assert one.gain.value == pytest.approx(sum(differences) / 3)
    assert one.gain.low < one.gain.value < one.gain.high


@pytest.mark.usefixtures("_tuned")
def test_runs_of_the_ladder_on_another_scenario_change_no_tied_gain(even_board: Callable[..., Path]) -> None:
    for seed in range(3):
        records = even_board("lora", seed, 0.6)
        even_board("sft", seed, 0.2, "ladder", step_factor=0.3)
    runs = [read_run(records, path) for path in sorted(records.rglob("seed-*.json"))]
    scores = {run.seed: run.scores for run in runs}
    ladder, _ = read_ladder(ladder_of(records))
    elsewhere = [
        dataclasses.replace(run, table="clbench/Other-v0", scores=scores[run.seed]) for run in ladder
    ]
    (one,) = tied_gains(SCENARIO, {"lora": scores}, [*ladder, *elsewhere])["lora"]
    assert one.gain.value == pytest.approx(3 / 4 * (0.6 - 0.2))


@pytest.mark.usefixtures("_tuned")
def test_a_tied_setting_without_runs_shows_no_gain_that_would_be_certain(
    even_board: Callable[..., Path],
) -> None:
    for seed in range(2):
        even_board("sft", seed, 0.1)
        even_board("frozen", seed, 0.9)  # a reference, which does not compete
        records = even_board("lora", seed, 0.9)
    tied = compute_board(records).tied[SCENARIO]
    assert set(tied) == {"lora", "sft"}
    (one,) = tied["lora"]
    assert (one.factor, one.seeds, one.gain.value, one.is_certain) == (0.3, 0, None, False)


def test_a_gain_or_a_loss_is_certain_over_all_tied_settings_or_over_none() -> None:
    gain, loss, neither = (Estimate(middle, middle - 0.01, middle + 0.01) for middle in (0.02, -0.02, 0.005))
    up, down, unsure = (TiedGain(0.3, one, 4) for one in (gain, loss, neither))
    assert [side_of_zero(one, []) for one in (gain, loss, neither)] == [1, -1, 0]
    assert side_of_zero(gain, [up, up]) == 1
    assert side_of_zero(loss, [down]) == -1
    assert [side_of_zero(gain, tied) for tied in ([up, unsure], [unsure, up], [down])] == [0, 0, 0]
    assert [side_of_zero(loss, tied) for tied in ([unsure], [up])] == [0, 0]


# ---- among many methods ------------------------------------------------------------------------------------

ABOVE, BELOW, UNSURE = Estimate(0.2, 0.1, 0.3), Estimate(-0.2, -0.3, -0.1), Estimate(0.2, -0.1, 0.5)


def _row(method: str, scores: dict[int, Any], gain: Estimate = ABOVE) -> Any:
    """Return a row of a scenario, as far as the test reads it."""
    estimates = {"gain": gain}
    return SimpleNamespace(method=method, division="prior-data-free", scores=scores, estimates=estimates)


def _apart(rows: list[Any]) -> set[str]:
    return set(sides_of_gains(rows, {}))


def test_a_method_is_not_tested_together_with_those_that_may_look_at_more(
    scores: Callable[..., Any],
) -> None:
    def some(rate: float) -> dict[int, Any]:
        return dict.fromkeys(range(8), scores(np.full((2, 5), rate), groups=(3, 1, 1), episodes=10))

    # one episode of ten: 0.1 with a standard error of 0.1 / sqrt(8), 2.8 times. Tukey's factor for 2 rows of
    # 8 seeds is 2.36, and for 10 rows 3.28
    sft, lora = _row("sft", some(0.4)), _row("lora", some(0.5))
    others = [_row(f"method_{number}", some(0.4)) for number in range(8)]
    assert _apart([sft, lora]) == {"lora"}
    assert _apart([sft, lora, *others]) == set()
    for row in others:
        row.division = "prior demonstrations"
    assert _apart([sft, lora, *others]) == {"lora"}


@pytest.mark.parametrize("division", ["prior-data-free", "prior questions", "prior demonstrations"])
def test_a_method_of_any_division_is_tested_together_with_plain_fine_tuning(
    division: str, scores: Callable[..., Any]
) -> None:
    low, high = (
        dict.fromkeys(range(8), scores(np.full((2, 5), rate), groups=(3, 1, 1), episodes=10))
        for rate in (0.2, 0.9)
    )
    better, alike = _row("better", high), _row("alike", low)
    better.division = alike.division = division
    assert _apart([_row("sft", low), better, alike]) == {"better"}


def test_a_method_that_shares_a_letter_with_plain_fine_tuning_is_not_apart_from_it(
    scores: Callable[..., Any],
) -> None:
    # the row between the others is like both, which are not like each other
    successes = {"high": (8, 7, 9, 8), "sft": (6, 7, 6, 7), "low": (5, 4, 5, 6)}
    rows = [
        _row(
            name,
            {
                seed: scores(np.full((2, 5), count / 10), groups=(3, 1, 1), episodes=10)
                for seed, count in enumerate(counts)
            },
        )
        for name, counts in successes.items()
    ]
    assert groups("final_average", {row.method: row.scores for row in rows}) == {
        "high": "a",
        "sft": "ab",
        "low": "b",
    }
    assert _apart(rows) == set()


def test_a_method_that_is_told_apart_has_the_side_on_which_all_its_gains_lie(
    scores: Callable[..., Any],
) -> None:
    def some(rate: float) -> dict[int, Any]:
        return dict.fromkeys(range(8), scores(np.full((2, 5), rate), groups=(3, 1, 1), episodes=10))

    gains = {"up": ABOVE, "down": BELOW, "unsure": UNSURE, "tied": ABOVE}
    rows = [_row("sft", some(0.2)), *(_row(name, some(0.9), gain) for name, gain in gains.items())]
    tied = {"up": [TiedGain(0.3, ABOVE, 4)], "tied": [TiedGain(0.3, UNSURE, 4)]}
    assert sides_of_gains([*rows, _row("alike", some(0.2))], tied) == {
        "up": 1,
        "down": -1,
        "unsure": 0,
        "tied": 0,
    }
