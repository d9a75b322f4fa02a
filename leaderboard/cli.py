"""The commands `clbench leaderboard`, `submit`, `verify`, `claims`, `method-pages` and `scenario-card`."""

from __future__ import annotations

import os
import secrets
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.cli.arguments import add_cwd_to_path, at_least, checked_input
from clbench.learning.registry import build_method
from clbench.records.paths import RECORDS, TUNING, record_path
from clbench.runs.spec import RunSpec
from clbench.spec.identifiers import folder_name, scenario_ids
from clbench.spec.registry import load_scenario

from .board.costs import STEP_TIME
from .board.rows import Table, read_table
from .board.tiers import TIERS
from .claims import page
from .claims.evidence import CONTROLS, SCENARIO, read_evidence
from .claims.judges import judge_all
from .pages.descriptions import built_in_methods
from .pages.method_pages import pages, read_sources
from .pages.scenario_cards import Card
from .pages.scenario_tasks import choose_renderer, make_missing, picture_path, undrawn
from .submission.submit import placement, run_submission
from .submission.verify import Request, run_verifications
from .views import page as web_page
from .views.table import csv_text, markdown, terminal, write_if_changed

WIDTH = 108
"""Least width: in a narrower one the last metrics would be cut off, and a long line only wraps."""


def show(*, records: Path = RECORDS) -> None:
    """Show the leaderboard, and write it beside the records.

    As LEADERBOARD.md, as leaderboard.csv with every metric, and as index.html, a page for a browser that has
    all that is behind the numbers and needs no network; pareto.svg and pareto-dark.svg are pictures of it.

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
    _write_table(console, table, records)


def submit(
    method: str,
    /,
    *,
    scenario: str = SCENARIO,
    seeds: int = 3,
    first_seed: int = 0,
    order: int = 0,
    workers: int | None = None,
    records: Path = RECORDS,
) -> None:
    """Check METHOD, run it, and put it on the board: its row, its rank and, if it is not shown, why.

    The check takes seconds on a toy scenario and says what to mend. Each run is a process of its own, which
    is stopped when it goes beyond the scenario's limits of time, memory and written bytes; a run that has a
    record is skipped. Submitting runs the method's code as you: read it first if it is not yours.

    Args:
        method: module:Class, or the name of an installed method.
        scenario: Gymnasium id of the scenario, as clbench/Fetch-v0; module:id imports the module first.
        seeds: How many seeds.
        first_seed: The first of them.
        order: In which order the targets are learned, as for `clbench run`: a row is of the published one, 0.
        workers: Runs at once, each a process with one thread; all cores if not given.
        records: Folder of the records.
    """
    add_cwd_to_path()
    with checked_input():
        at_least(1, "--seeds", seeds)
        at_least(0, "--first-seed", first_seed)
        at_least(1, "--workers", workers)
        name = load_scenario(scenario).in_order(order).id
        build_method(method, {})
    numbers = range(first_seed, first_seed + seeds)
    specs = [RunSpec(scenario, method, seed, order=order) for seed in numbers]
    went_well = run_submission(specs, records, workers)
    if records.is_dir():
        table, console = read_table(records), _console()
        _write_table(console, table, records)
        console.print(Text("\n".join(placement(table, name, method, records))), soft_wrap=True)
    if not went_well:
        raise SystemExit(1)


def verify(
    *paths: Path,
    tier: str = "replayed",
    episodes: int = 40,
    seed: int | None = None,
    method: str | None = None,
    scenario: str | None = None,
    checkpoints: Path | None = None,
    workers: int | None = None,
    records: Path = RECORDS,
) -> None:
    """Check the records at PATHS, and write the tier that each reaches beside it.

    recomputed: the record is whole, is what its method and scenario say, and its metrics follow from its
    episodes. replayed: test episodes, drawn at random, and all questions come out the same with the
    policies of its stages. retrained: the whole run does. Each tier includes those before it.

    Args:
        paths: Records, or folders of them.
        tier: How far to go: recomputed, replayed or retrained.
        episodes: How many episodes are replayed.
        seed: Of the choice of these; by chance if not given. Whoever made the record must not know it.
        method: The method's module:Class, if it is not installed: it is imported, and its code runs as you.
        scenario: Where the scenario is registered, as module:id, if clbench does not register it.
        checkpoints: Folder of policies that `clbench run --checkpoints` kept; made again if not given.
        workers: Verifications at once, each a process with one thread; all cores if not given.
        records: Folder of the records.
    """
    add_cwd_to_path()
    with checked_input():
        at_least(1, "--episodes", episodes)
        at_least(1, "--workers", workers)
        if tier not in TIERS[1:]:
            raise unknown("tier", tier, TIERS[1:])
        found = _found(paths, records)
    seed = secrets.randbits(48) if seed is None else seed
    request = Request(tier, episodes, seed, method, scenario, checkpoints)
    if not run_verifications(found, records, request, workers):
        raise SystemExit(1)


def _found(paths: Sequence[Path], records: Path) -> list[Path]:
    """Return the records at `paths`, those in folders too."""
    found = [one for path in paths for one in (sorted(path.rglob("*.json")) if path.is_dir() else [path])]
    absent = [path for path in found if not path.is_file()]
    if absent or not found:
        what = f"There is no record at {absent[0]}." if absent else "There is no record to verify."
        raise InputError(f"{what} Give paths, as {record_path(records, SCENARIO, 'sft', 0)}.")
    return found


def claims(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    scenario: str = SCENARIO,
    step_time: Path = STEP_TIME,
    output: Path = Path("docs/reference/claims.md"),
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
    output: Path = Path("docs/reference/methods"),
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


def scenario_card(
    *scenarios: str,
    episodes: int = 100,
    records: Path = RECORDS,
    output: Path = Path("docs/reference/scenarios"),
) -> None:
    """Write the card of each of SCENARIOS: its tasks with pictures, and whether it tells methods apart.

    Experts are measured, and pictures drawn, where the folder beside the card does not have them yet. Where
    nothing can draw, a card goes without the pictures that are missing, and says so.

    Args:
        scenarios: Gymnasium ids; those that have records if none is given.
        episodes: How many episodes of each task the experts are measured on.
        records: Folder of the records.
        output: Folder of the cards.
    """
    add_cwd_to_path()
    with checked_input():
        at_least(1, "--episodes", episodes)
        board = read_table(records) if records.is_dir() else Table({}, (), ())
        names = scenarios or [name for name in scenario_ids() if name in board.scenarios]
        if not names:
            raise InputError(f"No scenario has records in {records}: name one, as {SCENARIO}.")
        loaded = [load_scenario(name) for name in names]
    homes = {output / folder_name(scenario.id): scenario for scenario in loaded}
    console = Console(stderr=True, soft_wrap=True)
    fault = choose_renderer([task for home, scenario in homes.items() for task in undrawn(scenario, home)])
    if fault is not None:
        console.print(Text(f"No pictures are drawn; those that are there are kept. {fault}"))
    for home, scenario in homes.items():
        experts = make_missing(scenario, home, episodes, drawing=fault is None, console=console)
        drawn = {task.name for task in scenario.tasks if picture_path(home, task).is_file()}
        card = Card(scenario, board, experts, frozenset(drawn))
        _write(_console(), output / f"{home.name}.md", card.page())


def _write_table(console: Console, table: Table, records: Path) -> None:
    """Write every form of the table beside the records."""
    folder = Path(os.path.normpath(records / "../site"))
    texts = {
        "LEADERBOARD.md": markdown(table),
        "leaderboard.csv": csv_text(table),
        "index.html": web_page.page(table),
        **web_page.pictures(table),
    }
    for name, text in texts.items():
        _write(console, folder / name, text)


def _console() -> Console:
    console = Console()
    return console if console.width >= WIDTH else Console(width=WIDTH)


def _write(console: Console, path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_if_changed(path, text)
    console.print(Text(f"Written: {path}"), soft_wrap=True)
