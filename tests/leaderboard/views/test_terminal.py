"""The table in the terminal."""

import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import set_in
from rich.console import Console

from clbench.base.entry_points import resolve
from clbench.cli.main import app
from clbench.scoring.intervals import Estimate


def test_the_terminal_shows_all_rows_in_108_columns(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "108")
    add_full("experience_replay", 0)
    printed, _ = shown()
    table, _, _ = printed.partition("Written: ")  # the paths below it are as long as they are
    assert max(map(len, table.splitlines())) <= 108
    for word in ("experience_replay", "from_scratch", "prior demonstrations", "reference", "0.45±."):
        assert word in printed
    row = next(line for line in printed.splitlines() if "experience_replay" in line)
    assert len(row.split()) == 3 + 6 + 3  # group, name, seeds; six metrics; cost, bytes, tier: none cut off
    assert "…" not in printed


@pytest.mark.parametrize(
    ("width", "lost"), [(60, "tier, bytes kept, forward transfer"), (80, "tier, bytes kept")]
)
def test_a_narrow_terminal_loses_whole_columns_and_says_which(
    width: int,
    lost: str,
    add_full: Callable[..., Path],
    shown: Callable[[], tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    add_full("experience_replay", 0)
    printed, _ = shown()
    table, _, _ = printed.partition("Written: ")
    assert max(map(len, table.splitlines())) <= width
    assert f"Not shown in {width} characters: {lost}" in " ".join(printed.split())
    row = next(line for line in printed.splitlines() if "experience_replay" in line)
    assert "±" in row
    assert "…" not in printed


@pytest.mark.parametrize("kind", ["FIXED", "TO_CRITERION"])
def test_a_narrow_terminal_can_lose_every_metric_but_the_final_average(kind: str) -> None:
    form = "clbench.leaderboard.views.format"
    names, title = resolve(f"{form}:FITTING_{kind}"), resolve(f"{form}:column_title")
    stay = {title(name, to_criterion=kind == "TO_CRITERION") for name in names}
    assert stay - set(resolve("clbench.leaderboard.views.terminal:DROPPED_FIRST")) == {"final average"}


def test_the_best_of_a_division_is_bold_and_a_lone_row_is_not(
    four_methods: Path, add_full: Callable[..., Path], matrix: Any
) -> None:
    add_full("better", 0, np.clip(matrix + 0.2, 0, 1))
    table = resolve("clbench.leaderboard.board.rows:compute_board")(four_methods)
    console = Console(record=True, width=108, file=io.StringIO(), force_terminal=True)
    console.print(resolve("clbench.leaderboard.views.terminal:terminal")(table, 108))
    lines = console.export_text(styles=True).splitlines()
    better, sft, lone = (next(line for line in lines if name in line) for name in ("better", "sft", "replay"))
    assert "\x1b[1m" in better
    assert "\x1b[1m" not in lone
    assert better.count("\x1b[1m") > sft.count("\x1b[1m")


def test_the_number_after_a_value_is_half_the_width_of_its_interval(four_methods: Path) -> None:
    table = resolve("clbench.leaderboard.board.rows:compute_board")(four_methods)
    uneven = {**table.rows[0].estimates, "retention": Estimate(0.9, 0.5, 0.94)}
    (row, *_) = table.rows
    only = dataclasses.replace(table, rows=(dataclasses.replace(row, estimates=uneven),))
    printed = io.StringIO()
    Console(width=108, file=printed).print(resolve("clbench.leaderboard.views.terminal:terminal")(only, 108))
    assert "0.90±.22" in printed.getvalue()


@pytest.mark.long
def test_one_scenario_is_shown_in_the_order_of_a_metric(
    four_methods: Path, add_full: Callable[..., Path], matrix: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    add_full("eager", 0, matrix * np.array([0.0, 0.0, 1.0, 1.0, 1.0]))  # learns alike, and keeps no skill
    other = np.clip(matrix * np.array([1.0, 1.0, 0.5, 0.5, 1.0]), 0, 1)
    add_full("careful", 0, other)
    order = {}
    for metric in ("adaptation", "retention"):
        app(
            ["leaderboard", "clbench/Toy-v0", "--sort", metric, "--records", str(four_methods)],
            result_action="return_value",
        )
        printed = capsys.readouterr().out
        order[metric] = printed.index("careful") < printed.index("eager")
    assert order == {"adaptation": False, "retention": True}


def test_a_narrow_terminal_keeps_the_column_that_it_is_sorted_by(
    four_methods: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    arguments = ["leaderboard", "clbench/Toy-v0", "--records", str(four_methods)]

    def shown(*sort: str) -> tuple[set[str], str]:
        app([*arguments, *sort], result_action="return_value")
        head, _, legend = capsys.readouterr().out.partition("Not shown in")
        return set(head.split()), " ".join(legend.split())

    unsorted, _ = shown()
    for metric in ("forgetting", "kept_share", "activation_drift"):
        words = set(metric.split("_"))
        head, legend = shown("--sort", metric)
        assert ("activation drift" in legend) == (metric == "activation_drift")  # where lower is better
        assert not words & unsorted
        assert words <= head


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["clbench/Toi-v0"],
            "No scenario with records is called 'clbench/Toi-v0'. Did you mean 'clbench/Toy-v0'?",
        ),
        (
            ["clbench/LiberoGoal-v0"],
            "makes a row of clbench/LiberoGoal-v0: `clbench run clbench/LiberoGoal-v0 sft` makes some.",
        ),
        (["--sort", "retension"], "No metric is called 'retension'. Did you mean 'retention'?"),
    ],
)
def test_a_wrong_scenario_or_metric_is_named_and_nothing_is_written(
    arguments: list[str], message: str, four_methods: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        app(["leaderboard", *arguments, "--records", str(four_methods)])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not (four_methods.parent / "site").exists()


def test_the_rows_come_as_json_with_null_for_what_is_missing(
    four_methods: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (four_methods / "torn.json").write_text("{", encoding="utf-8")
    app(["leaderboard", "--json", "--records", str(four_methods)], result_action="return_value")
    printed = capsys.readouterr()
    assert "Not shown: torn.json: " in printed.err
    rows = {row["method"]: row for row in json.loads(printed.out)}
    assert rows["sft"]["retention"] == pytest.approx(0.45)
    assert rows["sft"]["perturbed_retention"] is None
    assert not (four_methods.parent / "site").exists()


def test_the_rows_of_one_scenario_as_json_are_sorted_too_with_the_reasons_of_its_other_records(
    four_methods: Path,
    add_full: Callable[..., Path],
    matrix: Any,
    even_board: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    add_full("eager", 0, matrix * np.array([0.0, 0.0, 1.0, 1.0, 1.0]))
    add_full("careful", 0, np.clip(matrix * np.array([1.0, 1.0, 0.5, 0.5, 1.0]), 0, 1))
    add_full("odd", 0, edit=set_in("run", "changes", {"rate": 2}))
    even_board("odd", 0, 0.5, "leaderboard/records", rate=2)
    order = {}
    for metric in ("adaptation", "retention"):
        arguments = [
            "leaderboard",
            "clbench/Toy-v0",
            "--json",
            "--sort",
            metric,
            "--records",
            str(four_methods),
        ]
        app(arguments, result_action="return_value")
        printed = capsys.readouterr()
        methods = [row["method"] for row in json.loads(printed.out)]
        order[metric] = methods.index("careful") < methods.index("eager")
        assert printed.err.startswith("Not shown: Toy-v0/odd/seed-0.json: ")
        assert "Even-v1" not in printed.err
    assert order == {"adaptation": False, "retention": True}


def test_a_scenario_whose_records_are_all_refused_shows_why_and_what_to_run(
    four_methods: Path, even_board: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    even_board("sft", 0, 0.5, "leaderboard/records")
    for path in ((four_methods / "Even-v1/sft/seed-0.json"), (four_methods / "torn.json")):
        path.write_text("{", encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        app(["leaderboard", "clbench/Even-v1", "--records", str(four_methods)])
    assert ended.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Not shown: Even-v1/sft/seed-0.json: cannot be read as JSON" in said
    advice = "`clbench run clbench/Even-v1 sft` makes some, unless its records are whole."
    assert f"{advice} Scenarios with rows: clbench/Toy-v0." in said
    assert "torn.json" not in said


@pytest.mark.long
def test_a_weak_pretrained_policy_is_named_on_every_form_of_the_board(
    four_methods: Path,
    add_full: Callable[..., Path],
    matrix: Any,
    shown_with_page: Callable[[], tuple[str, str]],
) -> None:
    for seed in range(2):
        add_full("sft", seed, np.vstack([np.full((1, 5), 0.3), matrix[1:]]))
    printed, markdown = shown_with_page()
    page = (four_methods.parent / "site" / "index.html").read_text(encoding="utf-8")
    sentence = "The pretrained policy has a success rate of 0.30 on its skills. That is low: "
    for text in (printed, markdown, page):
        assert sentence in " ".join(text.split())


@pytest.mark.long
def test_bytes_have_three_digits_and_go_on_to_the_next_unit(
    four_methods: Path,
    add_full: Callable[..., Path],
    shown_with_page: Callable[[], tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "108")
    counts = {0: "0", 999: "999", 1234: "1.23k", 999_900: "1M", 45_678_901: "45.7M", 3 * 10**15: "3000T"}
    for number, count in enumerate(counts):
        add_full(f"size_{number}", 0, edit=set_in("costs", "bytes_kept", count))
    printed = [line.split() for line in shown_with_page()[0].splitlines()]
    page = (four_methods.parent / "site" / "index.html").read_text(encoding="utf-8")
    for number, (count, text) in enumerate(counts.items()):
        (size,) = (line[-2] for line in printed if f"size_{number}" in line)
        assert size == text
        digits = text.rstrip("kMGT")
        shown = f"{digits} {text.removeprefix(digits)}B" if count else "0"
        assert f'data-note="{count:,} bytes">{shown}<span class="unseen">, {count:,} bytes</span>' in page
