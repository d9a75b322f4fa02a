"""Claim F6 follows from the results of benchmarks/decoding.py by its rule."""

import json
from pathlib import Path
from typing import Any

import pytest
from claims_bench import SCENARIO, Bench, section, verdicts

from clbench.base.entry_points import resolve

read_decoding = resolve("clbench.leaderboard.policies.decoders:read_decoding")


def ratio(value: float, half: float = 0.05) -> dict[str, float]:
    return {"median_ratio": value, "low": value - half, "high": value + half}


def decoder(
    speed_up: float, difference: float = 0.0, tokens: float = 64.0, *, is_pipeline: bool = False
) -> dict[str, Any]:
    return {
        "is_pipeline": is_pipeline,
        "success": 0.9 + difference,
        "success_difference": [difference, difference - 0.01, difference + 0.01],
        "forwards": 8.5,
        "tokens": tokens,
        "milliseconds": 12.0,
        "speed_up": ratio(speed_up),
    }


def results(speed_up: float, difference: float = 0.0, forward: float = 1.1) -> dict[str, Any]:
    return {
        "scenario": SCENARIO,
        "seeds": 3,
        "episodes": 600,
        "hardware": {"processor": "a processor"},
        "decoders": {
            "easy first, 12 forwards": decoder(1.0, tokens=384.0),
            "one forward": decoder(9.0),
            "pipeline, blocks of 1 step": decoder(speed_up - 0.4, is_pipeline=True),
            "pipeline, blocks of 4 steps": decoder(speed_up, difference, is_pipeline=True),
            "pipeline, blocks of 1 step, no kept keys": decoder(8.0),
        },
        "by_width": {
            "96": {"chunk": ratio(1.3), "forward": ratio(forward)},
            "768": {"chunk": ratio(3.3), "forward": ratio(4.0)},
        },
    }


@pytest.fixture
def page(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that makes the page of the claims from some results, or none."""

    def make(values: dict[str, Any] | None) -> str:
        path = tmp_path / "decoding.json"
        path.unlink(missing_ok=True)
        if values is not None:
            path.write_text(json.dumps(values), encoding="utf-8")
        monkeypatch.setattr("clbench.leaderboard.claims.fast_dvla.read_decoding", lambda: read_decoding(path))
        return bench.page()

    return make


@pytest.mark.parametrize(
    ("verdict", "speed_up", "difference", "forward"),
    [
        ("holds", 2.8, 0.0, 1.5),
        ("holds", 2.8, -0.015, 1.5),
        ("undecided", 2.66, 0.0, 1.5),
        ("undecided", 2.8, -0.03, 3.0),
        ("does not hold", 2.5, 0.0, 2.0),
        ("does not hold", 2.8, -0.05, 2.0),
        ("cannot be shown here", 2.8, 0.0, 1.1),
        ("cannot be shown here", 2.8, -0.05, 1.1),
        ("cannot be shown here", 2.5, 0.0, 1.1),
        ("does not hold", 2.5, 0.0, 1.46),
    ],
)
def test_the_verdict_follows_from_the_fastest_pipeline_by_the_rule(
    verdict: str, speed_up: float, difference: float, forward: float, page: Any
) -> None:
    assert verdicts(page(results(speed_up, difference, forward)))["F6"] == verdict


def test_the_page_shows_what_the_verdict_is_made_of(page: Any) -> None:
    entry = section(page(results(2.5)), "F6")
    assert "| speed-up of the pipeline, blocks of 4 steps | 2.50 [2.45, 2.55] |" in entry
    assert "| also: tokens in all forwards, easy first / pipeline, blocks of 4 steps | 6.00 |" in entry
    assert "speed-up of the head alone at width 768, initial weights | 3.30 [3.25, 3.35] |" in entry
    assert "only fewer passes save time here" in entry


def test_one_forward_that_succeeds_as_often_leaves_nothing_to_speed_up(page: Any) -> None:
    values = results(2.5, forward=2.0)
    assert verdicts(page(values))["F6"] == "does not hold"
    values["decoders"]["one forward"]["forwards"] = 1.0
    made = page(values)
    assert verdicts(made)["F6"] == "cannot be shown here"
    assert "One forward pass certainly succeeds at most 0.03 less often than 12" in section(made, "F6")
    values["decoders"]["one forward"]["success_difference"] = [-0.1, -0.12, -0.08]
    assert verdicts(page(values))["F6"] == "does not hold"


def test_without_results_the_claim_is_undecided_and_names_the_command(page: Any) -> None:
    made = page(None)
    assert verdicts(made)["F6"] == "undecided"
    assert "python benchmarks/decoding.py" in section(made, "F6")


def test_results_of_another_scenario_decide_nothing(page: Any) -> None:
    made = page({**results(2.8), "scenario": "clbench/Fetch-v1"})
    assert verdicts(made)["F6"] == "undecided"
    assert "measured on clbench/Fetch-v1 alone" in section(made, "F6")
