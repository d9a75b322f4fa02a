"""What a record says besides scores, for a reader: how to make it again, what with, what its method tells.

All of it was written by whoever ran it: any value may be of any type, size and content.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from ...board.rows import Row
from ...board.runs import Run, is_number, printable
from ..table import number_text

LONGEST = 160
"""Characters of a value that are shown."""

MOST = 60
"""Entries of one kind that are shown."""

_COMMIT = re.compile(r"[0-9a-f]{40}")


class Entry(NamedTuple):
    """A name and what stands beside it."""

    name: str
    text: str


@dataclass(frozen=True)
class Told:
    """One thing that a method tells about itself, stage after stage."""

    name: str
    texts: tuple[str, ...]
    """For each stage."""
    lines: tuple[str, ...]
    """For each stage, if it is a series of numbers: points of a line in a box of 100 by 20."""


@dataclass(frozen=True)
class Diagnostics:
    """What a method tells about itself, means over seeds."""

    stages: tuple[str, ...]
    told: tuple[Told, ...]


def text_of(value: Any) -> str:
    """Return any value in words, not too many."""
    if isinstance(value, bool) or value is None:
        text = {True: "yes", False: "no", None: "none"}[value]
    elif is_number(value):
        text = number_text(value, ",d") if isinstance(value, int) else number_text(value, ".4g")
    else:
        text = value if isinstance(value, str) else json.dumps(value)
    text = printable(text)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def flat(values: Mapping[str, Any], prefix: str = "") -> list[Entry]:
    """Return the entries of nested dictionaries as "outer inner"."""
    entries: list[Entry] = []
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value and len(prefix) < LONGEST:
            entries += flat(value, f"{name} ")
        else:
            entries.append(Entry(text_of(name), text_of(value)))
    return entries[:MOST]


def same_or_each(of_runs: Sequence[tuple[int, Sequence[Entry]]]) -> list[Entry]:
    """Return entries of several seeds: a text once if all have it, else each with its seeds."""
    names = dict.fromkeys(entry.name for _, entries in of_runs for entry in entries)
    found = []
    for name in names:
        texts: dict[str, list[int]] = {}
        for seed, entries in of_runs:
            texts.setdefault(dict(entries).get(name, "none"), []).append(seed)
        parts = [text if len(texts) == 1 else f"{text} ({_seeds(seeds)})" for text, seeds in texts.items()]
        found.append(Entry(name, "; ".join(parts)))
    return found[:MOST]


def _seeds(seeds: Sequence[int]) -> str:
    return f"{'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}"


# ---- the command -------------------------------------------------------------------------------------------


def commands(row: Row) -> list[str]:
    """Return what makes the records of a row again, quoted: a reader may paste it into a shell."""
    lines = []
    for commit, runs in groupby(row.runs, key=_commit):
        lines += [f"git checkout {commit}", "pip install -c constraints.txt -e ."] if commit else []
        if row.division == "online":
            lines.append(f"# {printable(row.method)}: a program of its own, docs/guide/online.md")
            continue
        for (device, perturb), members in groupby(runs, key=_how):
            for first, count in _in_a_row([run.seed for run in members]):
                words = ["clbench", "run", row.scenario, row.method, "--seeds", str(count)]
                words += ["--first-seed", str(first)] if first else []
                words += [] if device == "cpu" else ["--device", printable(device)]
                words += ["--perturb"] if perturb else []
                lines.append(shlex.join(words))
    return lines


def _how(run: Run) -> tuple[str, bool]:
    """Return where a run was computed, and whether its skills met perturbed episodes."""
    return str(run.record.run.get("device", "cpu")), run.record.run.get("perturb", False)


def _commit(run: Run) -> str:
    commit = run.record.fingerprint.get("commit")
    name = commit.get("id") if isinstance(commit, dict) else None
    return name if isinstance(name, str) and _COMMIT.fullmatch(name) else ""


def _in_a_row(seeds: Iterable[int]) -> list[tuple[int, int]]:
    """Return rising seeds as the first and the number of those that follow one another."""
    found: list[tuple[int, int]] = []
    for seed in seeds:
        if found and sum(found[-1]) == seed:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((seed, 1))
    return found


# ---- diagnostics -------------------------------------------------------------------------------------------


def diagnostics(runs: Sequence[Run]) -> Diagnostics:
    """Return what the method of `runs` tells about itself in each stage."""
    told = [run.record.diagnostics for run in runs]
    by_stage = [{key: value for key, value in values.items() if isinstance(value, dict)} for values in told]
    stages = sorted({key for values in by_stage for key in values}, key=lambda key: (len(key), key))[:MOST]
    names = dict.fromkeys(name for values in by_stage for stage in values.values() for name in stage)
    found = []
    for name in list(names)[:MOST]:
        series = [[values.get(stage, {}).get(name) for values in by_stage] for stage in stages]
        texts, lines = zip(*map(_mean, series), strict=True)
        found.append(Told(text_of(name), texts, lines))
    return Diagnostics(tuple(map(text_of, stages)), tuple(found))


def _mean(values: Sequence[Any]) -> tuple[str, str]:
    """Return the mean of what seeds tell in words and as a line; of what is no number the first."""
    if all(map(is_number, values)):
        return text_of(float(np.mean(values))), ""
    lengths = {
        len(value) if isinstance(value, list) and all(map(is_number, value)) else 0 for value in values
    }
    if len(lengths) == 1 and min(lengths) > 1:
        points = np.mean(values, axis=0)
        return f"{text_of(float(points[0]))} → {text_of(float(points[-1]))}", _line(points)
    return text_of(next((value for value in values if value is not None), None)), ""


def _line(points: np.ndarray[Any, Any]) -> str:
    """Return the points of a line in a box of 100 by 20."""
    low, high = float(points.min()), float(points.max())
    across = np.linspace(0, 100, len(points))
    down = 19 - 18 * (points - low) / (high - low or 1.0)
    return " ".join(
        f"{round(float(x), 1):g},{round(float(y), 1):g}" for x, y in zip(across, down, strict=True)
    )
