"""The page docs/guide/statistics.md: its figures are those of the simulations, the records and the code."""

import ast
import importlib.util
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers import blocks_of

from clbench import read_record
from clbench.cli.runs import run as run_command
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.expected_precision import (
    SEED_DEVIATION,
    episodes_needed,
    expected_precision,
    half_width,
)
from clbench.scoring.groups import UNKNOWN_DEVIATION
from clbench.scoring.intervals import REPLICATES
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores
from clbench.testing import TOY

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def coverage() -> ModuleType:
    spec = importlib.util.spec_from_file_location("coverage", ROOT / "benchmarks" / "interval_coverage.py")
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
    shown = [one for one in results["intervals"] if one["seeds"] in (3, 4, 8)]
    for table in (*coverage.tables({**results, "intervals": shown})[:2], *coverage.tables(results)[2:]):
        assert table in page
    for name in ("simulations", "boards"):
        assert f"{results[name]:,} " in page
    assert f"{REPLICATES:,} draws" in page
    shares = [100 * one["coverage"] for one in usual(results)]
    assert f"{min(shares):.1f} to {max(shares):.1f} %" in page.replace("\n", " ")
    stated = " ".join(page.split())
    retention = {name: of_metrics["retention"] for name, of_metrics in results["records"].items()}
    for name, one in retention.items():
        assert f"{one['deviation']:.2f} on {name}" in stated
        assert f"{one['deviation']:.3f} on {name} ({one['methods']} methods" in stated
    first, second, third = (f"{one['greatest']:.3f}" for one in retention.values())
    assert f"at most {first}, {second} and {third}." in stated


@pytest.mark.slow
def test_the_deviations_between_seeds_are_those_of_the_committed_records(
    coverage: ModuleType, results: Any
) -> None:
    for name, of_metrics in results["records"].items():
        assert coverage.seed_deviations(ROOT / "leaderboard" / "records" / name) == of_metrics


@pytest.mark.slow
def test_the_correlations_of_shift_and_forgetting_are_those_of_the_committed_records() -> None:
    stated = " ".join((ROOT / "docs" / "guide" / "statistics.md").read_text(encoding="utf-8").split())
    free = ["aegis", "consft", "consft_calibrated", "finch", "l2_sp", "lora", "sft", "stop_gradient"]
    maze = correlation_within_methods("PointMaze-v1", [*free, "experience_replay", "fast_dvla"])
    readers = ["a_gem", "buffered_replay", "ewc", "experience_replay", "fast_dvla"]
    every, without = (correlation_within_methods("Fetch-v1", names) for names in ([*free, *readers], free))
    assert f"is {maze:.2f} on PointMaze-v1, and on Fetch-v1 it is {every:.2f} for all methods" in stated
    assert f"for all methods and {without:.2f} for those without prior demonstrations." in stated


def correlation_within_methods(scenario: str, methods: list[str]) -> float:
    """Return the correlation of what is left of both metrics without the means of methods and of seeds."""
    values = []
    for method in methods:
        files = sorted((ROOT / "leaderboard" / "records" / scenario / method).glob("seed-*.json"))
        runs = [Scores.from_record(read_record(file)) for file in files]
        values.append([[measure(name, one) for name in ("shift", "kept_share")] for one in runs])
    noise = np.array(values, dtype=float) * (1, -1)
    noise -= noise.mean(axis=1, keepdims=True)
    noise -= noise.mean(axis=0, keepdims=True)
    return float(np.corrcoef(noise[..., 0].ravel(), noise[..., 1].ravel())[0, 1])


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


@pytest.mark.long
def test_its_script_prints_the_paired_interval_that_the_page_shows(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (script,) = (
        block for block in blocks_of(ROOT / "docs" / "guide" / "statistics.md", "python") if "ttest" in block
    )
    monkeypatch.chdir(ROOT)
    exec(compile(script, "statistics.md", "exec"), {})
    assert capsys.readouterr().out.strip() == script.rpartition("# ")[2].strip()


@pytest.mark.long
def test_the_command_line_shows_the_width_to_expect_of_intervals_before_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = "clbench.testing:clbench/Toy-v0"
    execute(RunSpec(scenario, "frozen", 0), tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])  # the command adds the working directory
    run_command(scenario, "frozen", seeds=1, records=tmp_path)
    said = " ".join(capsys.readouterr().err.split())
    end = f"1 of 1 run already has a record. Next: clbench leaderboard --records {tmp_path}"
    assert said == f"{expected_precision(TOY, 1)} {end}"


def usual(results: Any) -> list[Any]:
    """Return the simulations of three seeds or more with a small deviation of seeds."""
    return [one for one in results["intervals"] if one["seeds"] > 2 and one["deviation"] <= 0.05]


def test_simulated_intervals_hold_the_truth_in_about_95_per_cent(results: Any) -> None:
    shares = {(one["rate"], one["coverage"]) for one in usual(results)}
    assert len(usual(results)) == 2 * 4 * 2 * 7
    assert all(0.93 <= share <= 0.97 for rate, share in shares if 0.03 < rate < 0.97)
    # Near 0 and 1 it depends on where the few possible outcomes happen to lie.
    assert all(0.92 <= share <= 0.985 for _, share in shares)


def test_simulated_boards_of_equal_methods_are_split_in_at_most_5_per_cent(results: Any) -> None:
    shares = [one["split"] for one in results["false_splits"] if one["kind"] == "equal"]
    assert len(shares) == 27
    assert results["boards"] >= 500
    assert max(shares) <= 0.05


def test_the_assumed_deviations_of_seeds_are_of_the_size_of_those_in_the_records(results: Any) -> None:
    retention = results["records"]["Fetch-v1"]["retention"]
    assert retention["deviation"] <= SEED_DEVIATION <= retention["greatest"] <= UNKNOWN_DEVIATION


def test_the_simulations_repeat_themselves(coverage: ModuleType) -> None:
    rates, deviations = np.array([0.5, 0.9, 0.5]), np.array([0.1, 0.15, 0.0])
    first, again = (coverage.outcomes(np.random.default_rng(0), rates, deviations, 2000) for _ in range(2))
    assert (first == again).all()
    of_runs = first.mean(axis=2)
    assert of_runs.mean(axis=1) == pytest.approx(rates, abs=0.01)
    spread = rates * (1 - rates)
    expected = np.sqrt(4 * spread * deviations**2 * (1 - 1 / 200) + spread / 200)
    assert of_runs.std(axis=1) == pytest.approx(expected, rel=0.05)
