"""Comparisons against SciPy, plain loops and scores worked by hand; tie groups against simulated boards."""

import ast
import importlib.util
import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy import stats

from clbench.cli.runs import run as run_command
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.runs.spec import RunSpec
from clbench.scoring.intervals import (
    REPLICATES,
    SEED_DEVIATION,
    Estimate,
    Runs,
    episodes_needed,
    expected_precision,
    half_width,
)
from clbench.scoring.layout import Layout
from clbench.scoring.ranks import (
    UNKNOWN_DEVIATION,
    deviation_of_differences,
    ranks,
    tie_groups,
)
from clbench.scoring.scores import Scores
from clbench.testing import TOY

ROOT = Path(__file__).parents[2]
NOTHING = Estimate(None, None, None)


def run(final: Any) -> Scores:
    """Return a run whose outcomes after its only target, the last task, are `final`, (tasks, episodes)."""
    final = np.asarray(final, dtype=float)
    skills = tuple(f"skill_{number}" for number in range(len(final) - 1))
    layout = Layout(skills, ("target",), (), tuple(range(final.shape[1])), (), (), (100,), ("left",))
    missing = np.full((1, 1), np.nan)
    return Scores(
        layout=layout,
        success=np.stack([np.ones_like(final), final]),
        on_the_way=np.zeros((1, 0, len(final), 0)),
        perturbed=np.full((2, len(skills), final.shape[1]), np.nan),
        validation=missing,
        asked=np.full((2, 1), 50.0),
        correct=np.full((2, 1), 25.0),
        answer_curves=missing,
        update_sparsity=missing,
        activation_drift=missing,
    )


def equal_run(successes: int, episodes: int = 10, tasks: int = 4) -> Scores:
    """Return a run with the same number of successes on each task."""
    return run(np.tile(np.arange(episodes) < successes, (tasks, 1)))


def row(*successes: int) -> dict[int, Scores]:
    """Return the runs of a row, given the successes in ten episodes of each seed."""
    return {seed: equal_run(count) for seed, count in enumerate(successes)}


def board(
    generator: np.random.Generator, rates: Any, seeds: int, deviation: float, tasks: int = 9
) -> dict[str, Runs]:
    """Return rows of methods with these rates, whose runs have an effect of their own and of their seed."""
    shared = deviation * generator.standard_normal(seeds)
    rows: dict[str, Runs] = {}
    for number, rate in enumerate(rates):
        of_seeds = rate + shared + deviation * generator.standard_normal(seeds)
        rows[f"method_{number}"] = {
            seed: run(generator.random((tasks, 20)) < of_seeds[seed]) for seed in range(seeds)
        }
    return rows


# ---- tie groups --------------------------------------------------------------------------------------------


def test_ranks_count_the_rows_above_the_group() -> None:
    rows = {"worst": row(0, 0, 1), "good": row(9, 10, 9), "middle": row(5, 5, 6), "best": row(10, 9, 10)}
    assert tie_groups("final_average", rows) == {"best": 1, "good": 1, "middle": 3, "worst": 4}
    assert list(tie_groups("final_average", rows)) == ["best", "good", "middle", "worst"]


def test_less_forgetting_is_better() -> None:
    rows = {"forgets": row(1, 1, 2), "keeps": row(9, 10, 9)}
    assert tie_groups("forgetting", rows) == {"keeps": 1, "forgets": 2}


def test_with_complete_boards_ranks_agree_with_tukeys_test() -> None:
    # Rows vary enough for the pooled error to be the largest, so that SciPy's test must agree.
    generator = np.random.default_rng(0)
    agreed = 0
    for _ in range(40):
        values = generator.normal([[2.0], [1.5], [0.5], [0.0]], 1.0, (4, 5))
        values = values[np.argsort(-values.mean(axis=1))]
        residuals = values - values.mean(axis=1, keepdims=True) - values.mean(axis=0) + values.mean()
        error = np.sqrt((residuals**2).sum() / 12 / 5)
        differences = values[0] - values[1:]
        if (differences.std(axis=1, ddof=1) / np.sqrt(10) > error).any():
            continue  # two rows' own error is larger
        p_values = stats.studentized_range.sf(differences.mean(axis=1) / error, 4, 12)
        first = next((number + 2 for number, p in enumerate(p_values) if p < 0.05), 1)
        found = ranks(values, np.repeat(values[..., None], 2, axis=2))
        assert next((rank for rank in found if rank > 1), 1) == first
        agreed += 1
    assert agreed > 3


def test_seeds_that_agree_by_chance_do_not_split_rows_that_differ_in_one_episode() -> None:
    rows = {
        "all": row(10, 10, 10),
        "all_but_one": dict.fromkeys(range(3), run([[1] * 10] * 3 + [[1] * 9 + [0]])),
    }
    assert set(tie_groups("final_average", rows).values()) == {1}


def test_rows_with_identical_outcomes_share_a_rank_and_others_do_not() -> None:
    rows = {"one": row(10, 10, 10), "two": row(10, 10, 10), "none": row(0, 0, 0)}
    assert tie_groups("final_average", rows) == {"one": 1, "two": 1, "none": 3}
    assert tie_groups("final_average", {"alone": row(3, 4)}) == {"alone": 1}


def test_a_row_with_one_seed_is_compared_by_that_seed() -> None:
    # Seed 1 is easy for all rows, by far: the row that has no other would be worst by its mean.
    rows: dict[str, Runs] = {
        "one": {0: equal_run(2), 1: equal_run(9), 2: equal_run(8)},
        "two": {0: equal_run(2), 1: equal_run(8), 2: equal_run(9)},
        "three": {0: equal_run(1), 1: equal_run(9), 2: equal_run(9)},
        "single": {0: equal_run(2)},
    }
    assert set(tie_groups("final_average", rows).values()) == {1}
    assert tie_groups("final_average", {**rows, "single": {1: equal_run(0)}})["single"] == 4


def test_rows_without_a_common_seed_are_compared_by_the_variation_of_runs() -> None:
    near: dict[str, Runs] = {"one": row(8, 9, 7), "two": {seed + 5: equal_run(7) for seed in range(3)}}
    far: dict[str, Runs] = {**near, "two": {seed + 5: equal_run(1) for seed in range(3)}}
    assert tie_groups("final_average", near) == {"one": 1, "two": 1}
    assert tie_groups("final_average", far) == {"one": 1, "two": 2}


def test_where_no_row_has_a_second_seed_only_distant_rows_have_different_ranks() -> None:
    # The studentised range of three, their deviation known, is 3.31: at least 3.31 * 0.15 = 0.5 is needed.
    assert pytest.approx(0.15) == UNKNOWN_DEVIATION
    near, far = ({"one": row(9), "two": row(9), "three": row(last)} for last in (4, 1))
    assert tie_groups("final_average", near)["three"] == 1
    assert tie_groups("final_average", far)["three"] == 3


def test_rows_without_value_have_no_rank() -> None:
    broken = equal_run(5)
    broken.success[-1, 0, 0] = np.nan
    rows = {"whole": row(5, 6), "broken": {0: broken, 1: equal_run(5)}, "empty": {}}
    assert tie_groups("final_average", rows) == {"whole": 1}
    assert tie_groups("forward_transfer", {"whole": row(5, 6)}) == {}
    assert tie_groups("final_average", {}) == {}


def test_a_metric_without_a_direction_ranks_nothing() -> None:
    with pytest.raises(ValueError, match="update_sparsity says nothing of better or worse"):
        tie_groups("update_sparsity", {"one": row(5, 6)})
    with pytest.raises(LookupError, match="final_average"):
        tie_groups("final_averages", {})


def test_rows_of_other_tasks_are_not_ranked_together() -> None:
    with pytest.raises(ValueError, match="same tasks"):
        tie_groups("final_average", {"one": row(5, 6), "two": {0: equal_run(5, episodes=20)}})


def of_rates(*rates: float) -> Runs:
    """Return runs of seeds 0, 1, ... whose final success is `rates` on both of their tasks."""
    return {seed: run(np.tile(np.arange(20) < round(20 * rate), (2, 1))) for seed, rate in enumerate(rates)}


def test_the_deviation_of_differences_is_the_residual_after_row_and_seed_means() -> None:
    rows = [of_rates(0.5, 0.7, 0.6), of_rates(0.2, 0.5, 0.2), of_rates(0.9, 0.9, 1.0)]
    values = np.array([[0.5, 0.7, 0.6], [0.2, 0.5, 0.2], [0.9, 0.9, 1.0]])
    residuals = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    expected = np.sqrt(2 * (residuals**2).sum() / 4)  # twice the variance of a run, on (3 - 1)(3 - 1) degrees
    assert deviation_of_differences("final_average", rows) == pytest.approx(expected)


def test_rows_that_move_together_from_seed_to_seed_differ_by_the_same() -> None:
    together = [of_rates(0.5, 0.9), of_rates(0.1, 0.5)]
    assert deviation_of_differences("final_average", together) == pytest.approx(0, abs=1e-12)


def test_without_two_common_seeds_of_two_rows_no_deviation_is_known() -> None:
    late = {seed + 1: scores for seed, scores in of_rates(0.5, 0.9).items()}
    for rows in ([], [of_rates(0.5, 0.9)], [of_rates(0.5), of_rates(0.6)], [of_rates(0.5, 0.9), late]):
        assert deviation_of_differences("final_average", rows) is None


@pytest.mark.parametrize(("methods", "seeds", "deviation"), [(5, 3, 0.05), (8, 3, 0.1)])
def test_boards_of_equal_methods_are_hardly_ever_split(methods: int, seeds: int, deviation: float) -> None:
    generator = np.random.default_rng(0)
    boards = (board(generator, [0.5] * methods, seeds, deviation) for _ in range(40))
    assert sum(max(tie_groups("final_average", rows).values()) > 1 for rows in boards) <= 5  # 2 expected


def test_methods_that_differ_clearly_have_different_ranks() -> None:
    generator = np.random.default_rng(0)
    right = []
    for _ in range(10):
        found = tie_groups("final_average", board(generator, [0.8] * 3 + [0.5] * 3, 3, 0.05))
        right.append(
            [found[f"method_{good}"] < found[f"method_{bad}"] for good in range(3) for bad in range(3, 6)]
        )
    assert np.mean(right) > 0.9


def test_a_whole_board_falls_into_several_groups() -> None:
    rows = board(np.random.default_rng(0), np.linspace(0.1, 0.9, 23), 5, 0.05)
    found = tie_groups("final_average", rows)
    assert 1 < len(set(found.values())) < 23


# ---- the page docs/guide/statistics.md ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def coverage() -> ModuleType:
    spec = importlib.util.spec_from_file_location("coverage", ROOT / "benchmarks" / "coverage.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def results(coverage: ModuleType) -> Any:
    return json.loads(coverage.RESULTS.read_text(encoding="utf-8"))


def test_the_page_has_the_figures_of_the_simulations(coverage: ModuleType, results: Any) -> None:
    page = (ROOT / "docs" / "guide" / "statistics.md").read_text(encoding="utf-8")
    for table in coverage.tables(results):
        assert table in page
    for name in ("simulations", "boards"):
        assert f"{results[name]:,} " in page
    assert f"{REPLICATES:,} draws" in page
    for seeds in (3, 5, 10):
        shares = [100 * one["coverage"] for one in results["intervals"] if one["seeds"] == seeds]
        assert f"{min(shares):.1f} to {max(shares):.1f} % with {seeds}" in page.replace("\n", " ")
    retention = results["records"]["retention"]
    assert f"{retention['methods']} methods" in page
    assert f"{retention['root_mean_square']:.3f}" in page
    assert f"{retention['greatest']:.3f}" in page


def test_the_examples_of_the_page_give_its_results() -> None:
    page = (ROOT / "docs" / "guide" / "statistics.md").read_text(encoding="utf-8")
    examples = re.findall(r"^((?:half_width|episodes_needed)\(.*\))  # (None|[\d.]+)", page, re.MULTILINE)
    functions: dict[str, Callable[..., float | None]]
    functions = {"half_width": half_width, "episodes_needed": episodes_needed}
    assert len(examples) == 4
    for example, result in examples:
        call = ast.parse(example, mode="eval").body
        assert isinstance(call, ast.Call)
        values = [ast.literal_eval(value) for value in call.args]
        named = {str(part.arg): ast.literal_eval(part.value) for part in call.keywords}
        got = functions[ast.unparse(call.func)](*values, **named)
        assert (f"{got:.2f}" if isinstance(got, float) else str(got)) == result


def test_the_command_line_shows_the_width_to_expect_of_intervals_before_a_run(
    tmp_path: Path,
    make_record: Callable[..., Record],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = "clbench.testing:clbench/Toy-v0"
    spec = RunSpec(scenario, "sft", 0)
    run = spec.resolve()
    record = replace(make_record(np.ones((3, 5))), run=run.info, scenario=run.scenario_info)
    write_record(record, spec.path(tmp_path))
    monkeypatch.setattr(sys, "path", [*sys.path])  # the command adds the working directory
    run_command(scenario, "sft", seeds=1, records=tmp_path)
    said = " ".join(capsys.readouterr().err.split())
    assert said == f"{expected_precision(TOY, 1)} 1 of 1 runs have a record already."


def test_simulated_intervals_of_five_seeds_hold_the_truth_in_93_to_97_per_cent(results: Any) -> None:
    shares = [one["coverage"] for one in results["intervals"] if one["seeds"] == 5]
    assert len(shares) == 32
    assert min(shares) >= 0.93
    assert max(shares) <= 0.97


def test_simulated_boards_of_equal_methods_are_split_in_at_most_5_per_cent(results: Any) -> None:
    shares = [one["split"] for one in results["false_splits"] if one["kind"] == "equal"]
    assert len(shares) == 18
    assert results["boards"] >= 500
    assert max(shares) <= 0.05


def test_the_assumed_deviations_of_seeds_are_of_the_size_of_those_in_the_records(results: Any) -> None:
    retention = results["records"]["retention"]
    assert retention["root_mean_square"] <= SEED_DEVIATION <= retention["greatest"] <= UNKNOWN_DEVIATION


def test_the_simulations_repeat_themselves(coverage: ModuleType) -> None:
    levels, deviations = np.zeros(3), np.full(3, 0.1)
    first, again = (
        coverage.outcomes(np.random.default_rng(0), levels, deviations, 0.1, (40, 9)) for _ in range(2)
    )
    assert (first == again).all()
    assert first.mean() == pytest.approx(0.5, abs=0.1)
    level = coverage.level_of(0.9, 0.15, 6)
    many = coverage.outcomes(np.random.default_rng(0), np.array([level]), np.array([0.15]), 0.0, (2000, 6))
    assert many.mean() == pytest.approx(0.9, abs=0.01)
