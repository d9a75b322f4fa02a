"""Contents of a record besides scores: commands to repeat it, settings, machine, diagnostics.

A stranger may have written the record: any value may have any type, size and content.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from clbench.base.text import printable
from clbench.scoring.reading import is_number

from ...board.commands import commands_of
from ...board.rows import Row
from ...board.runs import Run
from ...board.summary import ELSEWHERE, grouped
from ..format import number_text

LONGEST = 160
"""Maximum length of a value in characters."""

MOST = 60
"""Maximum number of entries of one kind."""

_COMMIT = re.compile(r"[0-9a-f]{40}")


class Entry(NamedTuple):
    """A name and its text."""

    name: str
    text: str


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic of a method, by stage."""

    name: str
    cells: tuple[tuple[str, str], ...]
    """By stage, a text and the points of a line in a box of 100 by 20, empty without a series of numbers."""


@dataclass(frozen=True)
class Diagnostics:
    """Diagnostics of a method, means over seeds."""

    stages: tuple[str, ...]
    values: tuple[Diagnostic, ...]


def text_of(value: Any) -> str:
    """Return any value as text of limited length."""
    if isinstance(value, bool) or value is None:
        text = {True: "yes", False: "no", None: "none"}[value]
    elif is_number(value):
        text = number_text(value, ",d") if isinstance(value, int) else number_text(value, ".4g")
    else:
        text = value if isinstance(value, str) else json.dumps(value)
    text = printable(text)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def flat(values: Mapping[str, Any], prefix: str = "") -> list[Entry]:
    """Return the entries of nested dictionaries, with names such as "outer inner"."""
    entries: list[Entry] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value and len(prefix) < LONGEST:
            entries += flat(value, f"{name} ")
        else:
            entries.append(Entry(text_of(name), text_of(value)))
    return entries[:MOST]


def same_or_each(of_runs: Sequence[tuple[int, Sequence[Entry]]]) -> list[Entry]:
    """Return entries of several seeds: one text if all seeds share it, otherwise each text with its seeds."""
    names = dict.fromkeys(entry.name for _, entries in of_runs for entry in entries)
    found = []
    for name in names:
        texts = grouped((dict(entries).get(name, "none"), seed) for seed, entries in of_runs)
        parts = [text if len(texts) == 1 else f"{text} ({_seeds(seeds)})" for text, seeds in texts.items()]
        found.append(Entry(name, "; ".join(parts)))
    return found[:MOST]


def _seeds(seeds: Sequence[int]) -> str:
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}"


# ---- the command -------------------------------------------------------------------------------------------


def commands(row: Row) -> list[str]:
    """Return the commands that make the records of a row again, quoted for the shell."""
    lines = []
    for commit, runs in groupby(row.runs, key=_commit):
        lines += [f"git checkout {commit}", "pip install -c constraints.txt -e ."] if commit else []
        if row.division in ELSEWHERE:
            lines.append(f"# {printable(row.method)} is a separate program: docs/guide/{row.division}.md")
            continue
        lines += commands_of(runs)
    return lines


def _commit(run: Run) -> str:
    commit = run.record.fingerprint.get("commit")
    name = commit.get("id") if isinstance(commit, dict) else None
    return name if isinstance(name, str) and _COMMIT.fullmatch(name) else ""


# ---- diagnostics -------------------------------------------------------------------------------------------


def diagnostics(runs: Sequence[Run]) -> Diagnostics:
    """Return the diagnostics of the method of `runs` by stage."""
    recorded = [run.record.diagnostics for run in runs]
    by_stage = [
        {key: value for key, value in values.items() if isinstance(value, dict)} for values in recorded
    ]
    stages = sorted({key for values in by_stage for key in values}, key=lambda key: (len(key), key))[:MOST]
    names = dict.fromkeys(name for values in by_stage for stage in values.values() for name in stage)
    found = []
    for name in list(names)[:MOST]:
        series = [[values.get(stage, {}).get(name) for values in by_stage] for stage in stages]
        found.append(Diagnostic(text_of(name), tuple(map(_mean, series))))
    return Diagnostics(tuple(map(text_of, stages)), tuple(found))


def _mean(of_seeds: Sequence[Any]) -> tuple[str, str]:
    """Return the mean over seeds as text and as a line; for values other than numbers, what all share.

    A seed without a value does not count: its policy met the criterion before the first step of the stage.
    """
    values = [value for value in of_seeds if value is not None]
    text, line = _mean_of_all(values) if values else ("none", "")
    fewer = "" if len(values) in (0, len(of_seeds)) else f" ({len(values)} of {len(of_seeds)} seeds)"
    return text + fewer, line


def _mean_of_all(values: Sequence[Any]) -> tuple[str, str]:
    if all(map(is_number, values)):
        return text_of(float(np.mean(values))), ""
    lengths = {
        len(value) if isinstance(value, list) and all(map(is_number, value)) else 0 for value in values
    }
    if len(lengths) == 1 and min(lengths) > 1:
        points = np.mean(values, axis=0)
        return f"{text_of(float(points[0]))} → {text_of(float(points[-1]))}", _line(points)
    if any(isinstance(value, list | dict) for value in values):
        return "in the records", ""
    texts = set(map(text_of, values))
    return texts.pop() if len(texts) == 1 else "not the same in all seeds", ""


def _line(points: np.ndarray[Any, Any]) -> str:
    """Return the points of a line in a box of 100 by 20."""
    low, high = float(points.min()), float(points.max())
    across = np.linspace(0, 100, len(points))
    down = 19 - 18 * (points - low) / (high - low or 1.0)
    return " ".join(
        f"{round(float(x), 1):g},{round(float(y), 1):g}" for x, y in zip(across, down, strict=True)
    )
