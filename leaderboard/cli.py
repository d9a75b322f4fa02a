"""The commands `clbench leaderboard`, `clbench claims` and `clbench method-pages`."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console
from rich.text import Text

from clbench.record import RECORDS, TUNING

from ._claims import page
from ._claims.evidence import CONTROLS, SCENARIO, STEP_TIME, read_evidence
from ._claims.judges import judge_all
from ._descriptions import built_in_methods
from ._method_pages import pages, read_sources
from ._rows import Table, read_table
from ._table import csv_text, markdown, terminal, write_if_changed

WIDTH = 100
"""Least width: in a narrower one the last metrics would be cut off, and a long line only wraps."""


def show(*, records: Path = RECORDS) -> None:
    """Show the leaderboard, and write it as LEADERBOARD.md and leaderboard.csv beside the records.

    Args:
        records: Folder of the records.
    """
    if not any(records.rglob("*.json")):
        message = f"There are no records in {records}. Make some first: clbench run clbench/Fetch-v0 sft"
        Console(stderr=True, soft_wrap=True).print(Text(message))
        raise SystemExit(2)
    table = read_table(records)
    console = _console()
    console.print(terminal(table))
    folder = Path(os.path.normpath(records / ".."))
    for name, text in (("LEADERBOARD.md", markdown(table)), ("leaderboard.csv", csv_text(table))):
        _write(console, folder / name, text)


def claims(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    scenario: str = SCENARIO,
    step_time: Path = STEP_TIME,
    output: Path = Path("docs/claims.md"),
) -> None:
    """Judge the claims of the papers by the records, and write the page that says why.

    Args:
        records: Folder of the records of the board.
        controls: Folder of the records of changed settings.
        scenario: Gymnasium id of the scenario.
        step_time: What the speed benchmark left.
        output: The page.
    """
    evidence = read_evidence(scenario, records, controls, step_time)
    findings = judge_all(evidence)
    console = _console()
    console.print(page.terminal(findings))
    _write(console, output, page.page(evidence, findings))


def method_pages(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    tuning: Path = TUNING,
    scenario: str = SCENARIO,
    step_time: Path = STEP_TIME,
    output: Path = Path("docs/methods"),
) -> None:
    """Write a page for each built-in method, from its code and its records.

    Args:
        records: Folder of the records of the board.
        controls: Folder of the records of changed settings.
        tuning: Folder of the records of tuning runs.
        scenario: Gymnasium id of the scenario.
        step_time: What the speed benchmark left.
        output: Folder of the pages.
    """
    evidence = read_evidence(scenario, records, controls, step_time)
    board = read_table(records) if records.is_dir() else Table({}, (), ())
    sources = read_sources(evidence, judge_all(evidence), board, tuning)
    texts = pages(built_in_methods(), sources)
    output.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_if_changed(output / name, text)
    _console().print(Text(f"Written: {len(texts)} pages in {output}"), soft_wrap=True)


def _console() -> Console:
    console = Console()
    return console if console.width >= WIDTH else Console(width=WIDTH)


def _write(console: Console, path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_if_changed(path, text)
    console.print(Text(f"Written: {path}"), soft_wrap=True)
