"""The commands of the leaderboard: `leaderboard`, `submit` and `verify`."""

from __future__ import annotations

import os
import secrets
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.base.text import counted, print_plain, printable
from clbench.cli.arguments import (
    AsJson,
    MethodName,
    PolicyName,
    ScenarioId,
    Seed,
    Seeds,
    add_cwd_to_path,
    check_names,
    checked_input,
    error_line,
    print_json,
    whole_number,
)
from clbench.jobs.folders import check_folders
from clbench.records.paths import RECORDS, record_path
from clbench.records.reader import RecordError, check_home, read_record
from clbench.spec.identifiers import folder_name, scenario_ids, without_module
from clbench.spec.protocol import DEFAULT_SEEDS

from .board.paths import LADDER, SCENARIO

if TYPE_CHECKING:
    from .board.rows import Board
    from .board.summary import Summary

# Whatever imports PyTorch, SciPy or the charts is imported where it is needed: `--help` does not wait for it.


def show(
    scenario: ScenarioId | None = None,
    /,
    *,
    sort: str | None = None,
    records: Path = RECORDS,
    published: bool = False,
    as_json: AsJson = False,
) -> None:
    """Show the leaderboard, and write it to the folder `site` next to the records.

    Files: LEADERBOARD.md; leaderboard.csv with every metric; index.html, a page for the browser with the
    details of every row, which needs no network; pareto.svg, pareto-dark.svg and frontier-SCENARIO.svg, its
    charts as pictures; board.json. They always hold all scenarios.

    Args:
        scenario: Show only this scenario.
        sort: Name or title of the metric that orders the rows of each division, for example kept.
        records: Folder of the records.
        published: First copy published records that the folder lacks, so that the table shows your rows
            together with the published ones.
        as_json: Print a JSON list with an object for each row, with every metric and cost, and write no
            files. Standard error says which records are not shown, and why.
    """
    from clbench.scoring.metrics import load_metric

    from .board.summary import column_names, in_order_of, values_of
    from .publishing import add_published, inputs_of, read_unchanged, site_of, write_site
    from .views.files import print_written
    from .views.terminal import terminal

    if sort is not None:
        with checked_input():
            sort = load_metric(sort).name
    messages = Console(stderr=True, soft_wrap=True)
    if published:
        with checked_input():
            added = add_published(records)
        print_plain(messages, f"{counted(added, 'published record')} added to {records}.")
    if not any(records.rglob("*.json")):
        message = f"There are no records in {records}. Make some first: clbench run {SCENARIO} sft\n"
        message += "Or look at the published ones: clbench leaderboard --published"
        print_plain(messages, message)
        raise SystemExit(2)
    inputs = inputs_of(records)
    board = read_unchanged(records, inputs)
    computed = None
    if board is None:
        board = computed = _computed(records)
    shown = board if scenario is None or not board.rows else _of_scenario(board, without_module(scenario))
    if not shown.rows:
        _print_not_shown(shown, messages)
        messages.print(error_line(_why_empty(board, shown, scenario, records)))
        raise SystemExit(2)
    if sort is not None:
        shown = replace(shown, rows=in_order_of(shown.rows, sort))
    if as_json:
        print_json([dict(zip(column_names(), values_of(row), strict=True)) for row in shown.rows])
        _print_not_shown(shown, messages)
        return
    console = Console()
    with checked_input():
        try:
            written = {} if computed is None else write_site(computed, records, inputs)
        finally:  # the folder may be read-only
            console.print(terminal(shown, console.width, sort))
    if written:
        print_written(written)
    else:
        print_plain(console, f"Unchanged: {site_of(records)}")


def _print_not_shown(board: Summary, console: Console) -> None:
    for entry in board.not_shown:
        print_plain(console, printable(f"Not shown: {entry}"))


def _computed(records: Path) -> Board:
    """Return the board of the records; a spinner shows that it takes time."""
    from .board.rows import compute_board

    with Console(stderr=True).status("Computing the board and its intervals"):
        return compute_board(records)


def _of_scenario(board: Summary, scenario: str) -> Summary:
    """Return the part of the board in the folders of a scenario: its rows, and its files that make none."""
    rows = tuple(row for row in board.rows if row.scenario == scenario)
    folders = tuple(f"{parent}{folder_name(scenario)}/" for parent in ("", f"{LADDER.name}/"))
    not_shown = tuple(entry for entry in board.not_shown if entry.path.startswith(folders))
    return replace(board, rows=rows, not_shown=not_shown)


def _why_empty(board: Summary, shown: Summary, scenario: str | None, records: Path) -> str:
    """Return why `shown`, the part of the board for a scenario, has no rows, and what makes some."""
    if scenario is None or not board.rows:
        return f"No record in {records} makes a row, so no board was written."
    scenario = without_module(scenario)
    if not shown.not_shown and scenario not in scenario_ids():
        return str(unknown("scenario with records", scenario, board.starts).args[0])
    skips = ", unless its records are whole" if shown.not_shown else ""
    advice = f": `clbench run {scenario} sft` makes some{skips}"
    names = ", ".join(sorted(board.starts))
    return f"No record in {records} makes a row of {scenario}{advice}. Scenarios with rows: {names}."


def submit(
    method: MethodName,
    /,
    *,
    scenario: ScenarioId = SCENARIO,
    seeds: Seeds = DEFAULT_SEEDS,
    first_seed: Seed = 0,
    order: Seed = 0,
    workers: Annotated[int | None, whole_number(1)] = None,
    records: Path = RECORDS,
    device: str = "cpu",
    checkpoints: Path | None = None,
) -> None:
    """Check METHOD, run it, and print its row and place, or the reason why it has no row.

    The check takes seconds on a toy scenario and reports what to fix. Each run has its own process, which is
    stopped if it exceeds the scenario's limits on time, memory and written bytes. Runs with a record are
    skipped. The command runs the method's code with your rights: read code from others first.

    Args:
        method: module:Class, or the name of an installed method.
        scenario: Gymnasium id of the scenario, for example clbench/Fetch-v1; module:id imports the module
            first.
        seeds: Number of seeds.
        first_seed: The first seed. No board shows seeds from 100 on, which are for tuning.
        order: Order of the targets, for scenarios with one published order: 0 is that order, other numbers
            are permutations. Only order 0 makes rows. Scenarios with a separate order for each seed, such
            as Fetch-v1, accept only 0.
        workers: Number of runs at once, and of the cores that they share (default: all cores; with --device
            cuda, one run per GPU, and all cores).
        records: Folder of the records.
        device: Device that runs the policies, for example cpu or cuda, which gives each run one of the GPUs.
        checkpoints: Keep the policies of all stages below this folder, so that `clbench verify` need not make
            them again.
    """
    check_names([scenario], [method])
    from clbench.runs.spec import RunSpec, check_device

    from .board.rows import compute_board
    from .publishing import check_site, inputs_of, site_of, write_site
    from .submission.submit import placement, run_submission
    from .views.files import print_written

    add_cwd_to_path()
    with checked_input():
        check_device(device)
        first = RunSpec(scenario, method, first_seed, device=device, order=order)
        runs = [replace(first, seed=first_seed + number).resolve() for number in range(seeds)]
        folders = {"--records": records, "--checkpoints": checkpoints, "The board's folder": site_of(records)}
        check_folders(folders)
        check_site(records)
        went_well = run_submission(runs, records, workers, checkpoints)
    if went_well is None:
        raise SystemExit(1)
    if records.is_dir():
        inputs = inputs_of(records)
        board = compute_board(records)
        with checked_input():
            written = write_site(board, records, inputs)
        print_written(written)
        lines = placement(board, runs[0], records)
        print_plain(Console(), "\n".join(lines))
    if not went_well:
        raise SystemExit(1)


def verify(
    *paths: Path,
    tier: str = "replayed",
    episodes: Annotated[int, whole_number(1)] = 40,
    seed: Seed | None = None,
    method: MethodName | None = None,
    policy: PolicyName | None = None,
    scenario: ScenarioId | None = None,
    checkpoints: Path | None = None,
    pretrain: bool = False,
    any_processor: bool = False,
    by: str | None = None,
    workers: Annotated[int | None, whole_number(1)] = None,
    records: Path = RECORDS,
    as_json: AsJson = False,
) -> None:
    """Check the records at PATHS, and write the tier that each reaches into a file next to it.

    recomputed: the record is intact, matches its method and scenario, and its metrics follow from its
    episodes. replayed: the policies of its stages give the same results in randomly chosen episodes at the
    ends of stages, and the same answers there. retrained: the whole run gives the same record again. Each
    tier includes the tiers before it. The file of a higher tier stays unless a check fails.

    Args:
        paths: Records, or folders of records.
        tier: Highest tier to check: recomputed, replayed or retrained.
        episodes: Number of episodes to replay.
        seed: Random seed that selects the episodes (default: random; keep it secret from the submitter).
        method: module:Class of the method, if it is not installed: clbench runs its code with your rights.
        policy: module:Class of the policy, if it is not built in: clbench runs its code, too.
        scenario: module:id of the scenario, if clbench does not register it.
        checkpoints: Folder of policies from `clbench run --checkpoints` (default: train them again).
        pretrain: At the tier retrained, also repeat the pretraining (default: use the cached policy).
        any_processor: Also train again on a processor that may compute differently from the record's. Equal
            results prove the record; different results prove nothing.
        by: Your name, for the file (default: none).
        workers: Number of verifications at once, and of the cores that they share (default: all cores; for
            records of cuda, one per GPU, and all cores).
        records: Folder of the records.
        as_json: Print a JSON list that states for each record whether it passed, its tier, checks and
            failure.
    """
    from .board.tiers import TIERS, tier_of
    from .submission.subject import Request
    from .submission.verify import run_verifications

    add_cwd_to_path()
    with checked_input():
        if tier not in TIERS[1:]:
            raise unknown("tier", tier, TIERS[1:])
        if pretrain and tier != "retrained":
            raise InputError(
                "--pretrain repeats the pretraining at the tier retrained: add --tier retrained."
            )
        if checkpoints is not None and not checkpoints.is_dir():
            raise InputError(
                f"There is no folder {checkpoints}. --checkpoints names the folder of policies that "
                "`clbench run --checkpoints` filled."
            )
        found, records = _placed(_found(paths, records), records)
    seed = secrets.randbits(48) if seed is None else seed
    request = Request(
        tier=tier,
        episodes=episodes,
        seed=seed,
        method=method,
        scenario=scenario,
        checkpoints=checkpoints,
        pretrain=pretrain,
        by=by,
        policy=policy,
        any_processor=any_processor,
    )
    done = run_verifications(found, records, request, workers, Console(stderr=as_json))
    if as_json:
        print_json(
            [
                {
                    "path": str(one.path),
                    "passed": one.failure is None,
                    "tier": tier_of(one.path),
                    "checks": one.checks,
                    "failure": one.failure,
                }
                for one in done
            ]
        )
    if any(one.failure for one in done):
        raise SystemExit(1)


def _found(paths: Sequence[Path], records: Path) -> list[Path]:
    """Return the records at `paths`, including those in folders, each once."""
    each = [one for path in paths for one in (sorted(path.rglob("*.json")) if path.is_dir() else [path])]
    found = [*{os.path.abspath(one): one for one in each}.values()]
    absent = [path for path in found if not os.path.lexists(path)]
    if absent or not found:
        what = f"There is no record at {absent[0]}." if absent else "There is no record to verify."
        raise InputError(f"{what} Give paths, for example {record_path(records, SCENARIO, 'sft', 0)}.")
    return found


def _placed(found: list[Path], records: Path) -> tuple[list[Path], Path]:
    """Return the records and their folder in one form, as typed or absolute.

    Raises:
        InputError: A record is not below the folder, or has its place below another one.
    """
    folder = Path(os.path.abspath(records))
    absolute = [Path(os.path.abspath(path)) for path in found]
    for path in absolute:
        if not path.is_relative_to(folder):
            raise InputError(
                f"{path} is not below {folder}: set --records to the folder in which the record is "
                "SCENARIO/METHOD/seed-N.json."
            )
        in_place = len(path.relative_to(folder).parts) == 3  # then the verification reads it, and not this
        home = None if in_place else _home_of(path)
        if home is not None:
            raise InputError(f"{path} belongs below {home}: add --records {home}.")
    typed = all(path.is_relative_to(records) and ".." not in path.parts for path in found)
    return (found, records) if typed else (absolute, folder)


def _home_of(path: Path) -> Path | None:
    """Return the folder of records in which a record has its place; None if it has none, or is no record."""
    try:
        home = check_home(read_record(path).run, path)
    except RecordError:
        return None
    return path.parents[len(home.parts) - 1]
