"""The commands that write pages: `claims`, `findings`, `method-pages` and `scenario-card`."""

from __future__ import annotations

import filecmp
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from clbench.base.errors import InputError, MissingPackageError
from clbench.base.text import print_plain
from clbench.cli.arguments import ScenarioId, add_cwd_to_path, check_names, checked_input, whole_number
from clbench.records.paths import RECORDS, check_folder
from clbench.spec.identifiers import folder_name, scenario_ids, without_module

from ..board.paths import CONTROLS, SCENARIO

if TYPE_CHECKING:
    from clbench.spec.scenario import Scenario

    from ..board.rows import Board
    from ..claims.evidence import Evidence

# Whatever imports PyTorch, SciPy or the charts is imported where it is needed: `--help` does not wait for it.


def claims(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    scenario: ScenarioId | None = None,
    output: Path = Path("docs/reference/claims.md"),
) -> None:
    """Judge the claims of the papers by the records, and write a page with the verdicts and figures.

    Args:
        records: Folder of the records of the leaderboard.
        controls: Folder of the records of changed settings.
        scenario: Gymnasium id of the scenario on which all claims are judged (default: each claim
            names its own).
        output: Path of the page.
    """
    from ..claims.judges import judge_all
    from .claims_page import page, terminal

    evidence = _evidence(scenario, records, controls)
    judged = judge_all(evidence, None if scenario is None else without_module(scenario))
    console = Console()
    console.print(terminal(judged))
    _write({output: page(judged, records, controls, published=_holds_published(records))})


def findings(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    output: Path = Path("docs/reference/findings.md"),
) -> None:
    """Summarise the records, and write a page with every figure, its interval and charts.

    Args:
        records: Folder of the records of the leaderboard.
        controls: Folder of the records of changed settings.
        output: Path of the page; pictures go to the folder `findings` beside it.
    """
    from ..claims.judges import judge_all
    from .findings import in_short, page, pictures, sections

    evidence = _evidence(None, records, controls)
    board = _board(records)
    judged = judge_all(evidence)
    told = in_short(board, judged), sections(board, judged, evidence)
    text = page(*told, published=_holds_published(records))
    drawn = {output.parent / "findings" / name: svg for name, svg in pictures(board).items()}
    _write({output: text, **drawn})


def method_pages(
    *,
    records: Path = RECORDS,
    controls: Path = CONTROLS,
    scenario: ScenarioId = SCENARIO,
    output: Path = Path("docs/reference/methods"),
) -> None:
    """Write a page for each built-in method, from its code and its records.

    Args:
        records: Folder of the records of the leaderboard.
        controls: Folder of the records of changed settings.
        scenario: Gymnasium id of the scenario.
        output: Folder of the pages.
    """
    from ..claims.judges import judge_all
    from ..views.descriptions import built_in_descriptions
    from ..views.files import write_all
    from .method_pages import Sources, pages

    evidence = _evidence(scenario, records, controls, optional=True)
    sources = Sources(evidence(without_module(scenario)), judge_all(evidence), _board(records).rows)
    texts = pages(built_in_descriptions(), sources)
    with checked_input():
        write_all({output / name: text for name, text in texts.items()})
    print_plain(Console(), f"Written: {len(texts)} pages in {output}")


def scenario_card(
    *scenarios: ScenarioId,
    episodes: Annotated[int, whole_number(1)] = 100,
    records: Path = RECORDS,
    output: Path = Path("docs/reference/scenarios"),
) -> None:
    """Write the card of each of SCENARIOS: its tasks with pictures, and whether it tells methods apart.

    The command measures experts and draws pictures only where they are missing from the folder of the card.
    If no renderer works, the command leaves out missing pictures, deletes outdated ones and says so. If a
    scenario lacks a package, its card stays as it is, unless you name the scenario.

    Args:
        scenarios: Gymnasium ids (default: all scenarios with records, or with a card in the folder).
        episodes: Number of episodes of each task for measuring the experts.
        records: Folder of the records.
        output: Folder of the cards.
    """
    from clbench.jobs.folders import check_folders
    from clbench.spec.registry import load_scenario

    from .scenario_cards import Card
    from .scenario_tasks import choose_renderer, make_missing, picture_path, undrawn

    add_cwd_to_path()
    console = Console(stderr=True, soft_wrap=True)
    with checked_input():
        check_folders({"--output": output})
        board = _board(records)
        names = scenarios or [
            name
            for name in scenario_ids()
            if name in board.scenarios or (output / f"{folder_name(name)}.md").is_file()
        ]
        if not names:
            raise InputError(f"No scenario has records in {records}. Name one, for example {SCENARIO}.")
        typed: dict[str, str] = {}
        homes: dict[Path, Scenario] = {}
        for name in names:
            try:
                scenario = load_scenario(name)
            except MissingPackageError as error:
                if scenarios:
                    raise
                print_plain(console, f"The card of {name} stays as it is. {error.args[0]}")
                continue
            typed[scenario.id], homes[output / folder_name(scenario.id)] = name, scenario
    # before any world is made; a world that cannot be drawn takes no picture from another scenario
    bare = {home: undrawn(scenario, home) for home, scenario in homes.items()}
    together = choose_renderer([task for tasks in bare.values() for task in tasks])
    faults = {home: together and choose_renderer(tasks) for home, tasks in bare.items()}
    for home, scenario in homes.items():
        if (fault := faults[home]) is not None:
            kept = "No pictures are drawn; existing ones are kept unless outdated."
            print_plain(console, f"{scenario.id}: {kept} {fault}")
        with checked_input():  # an expert may refuse its task
            experts = make_missing(scenario, home, episodes, drawing=fault is None, console=console)
        drawn = {task.name for task in scenario.tasks if picture_path(home, task).is_file()}
        card = Card(scenario, board, experts, frozenset(drawn), typed[scenario.id], records)
        _write({output / f"{home.name}.md": card.page()})


def _evidence(
    scenario: str | None, records: Path, controls: Path, optional: bool = False
) -> Callable[[str], Evidence]:
    """Return the function that gives the evidence on a scenario.

    A scenario without records that is not registered is refused, and so is a missing folder of records unless
    it is optional.
    """
    from ..board.frontier import ladder_of
    from ..claims.evidence import read_evidence

    if scenario is not None:
        homes = [home / folder_name(without_module(scenario)) for home in (records, controls)]
        if not any(home.is_dir() for home in homes):  # one with records may be of a missing package
            check_names([scenario], [])  # before all records are read, which takes 10 s
    if not optional:
        with checked_input():
            check_folder(records)
    for folder in (records, controls, ladder_of(records)):
        if not folder.is_dir():
            text = f"There is no folder {folder}: verdicts may differ from the published ones."
            print_plain(Console(stderr=True), text, "yellow")
    return read_evidence(records, controls)


def _holds_published(records: Path) -> bool:
    """Return whether a folder has all published records, unchanged."""
    from ..publishing import PUBLISHED

    names = [path.relative_to(PUBLISHED).as_posix() for path in PUBLISHED.rglob("seed-*.json")]
    same, _, _ = filecmp.cmpfiles(PUBLISHED, records, names)
    return bool(names) and same == names


def _board(records: Path) -> Board:
    """Return the board of the records, an empty one if there is no folder."""
    from ..board.rows import Board, compute_board

    return compute_board(records) if records.is_dir() else Board()


def _write(texts: Mapping[Path, str]) -> None:
    """Write texts to their paths, and print the paths."""
    from ..views.files import print_written, write_all

    with checked_input():
        written = write_all(texts)
    print_written(written)
