"""The frontier: what methods learn and keep at each learning rate of the ladder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from clbench.records.paths import label_of
from clbench.scoring.intervals import Estimate, estimate, row_generator
from clbench.scoring.reading import is_number
from clbench.spec.references import BASELINE

from .paths import LADDER, beside
from .runs import ALIKE, Run, Sift, Sifted, differences, read_run, read_runs, sift_by
from .summary import DIVISIONS, grouped

FACTOR = "step_factor"
"""Hyper-parameter that the ladder changes."""

LEARNED, KEPT = "adaptation", "kept"
"""Metrics of the two axes."""


@dataclass(frozen=True)
class Rung:
    """One method at one learning rate."""

    factor: float
    """Factor of the learning rate."""
    learned: Estimate
    """Success on each target right after learning it."""
    kept: Estimate
    """Success at the end on everything that was known before the last target."""
    seeds: tuple[int, ...]
    """Seeds of its runs."""


@dataclass(frozen=True)
class Curve:
    """One method along the ladder."""

    method: str
    """Name of the method, with its other changed settings if the ladder has several of these."""
    division: str
    """One of `DIVISIONS`."""
    rungs: tuple[Rung, ...]
    """By falling factor."""

    @property
    def is_baseline(self) -> bool:
        """Whether it is plain fine-tuning, which the others must beat."""
        return self.method == BASELINE


def ladder_of(records: Path) -> Path:
    """Return the folder of the ladder's records for a folder of records."""
    return beside(records, LADDER.name)


def read_ladder(folder: Path, board: Iterable[Run] = ()) -> Sifted:
    """Return the runs of the ladder below `folder`, sorted by scenario, and the files that are no such run.

    The paths of these files begin with the folder's name. A missing folder counts as empty.

    Args:
        folder: The folder.
        board: Runs of the board, to which those of the ladder must be comparable.
    """
    sifts = (like_the_board(board), *ALIKE, on_the_ladder)
    runs, refused = read_runs(folder, partial(read_run, changed=True), sifts)
    runs.sort(key=lambda run: run.table)
    return runs, [dataclasses.replace(one, path=f"{folder.name}/{one.path}") for one in refused]


def like_the_board(board: Iterable[Run]) -> Sift:
    """Return the sift that keeps runs made and evaluated like the board's, where the board has any."""
    examples = {run.table: run for run in board}

    def traits(run: Run) -> dict[str, Any]:
        return {
            **vars(run.scores.layout),
            **vars(run.published),
            "rollouts": run.record.fingerprint.get("rollouts"),
        }

    def fault(run: Run) -> str:
        fields = differences(traits(run), traits(examples.get(run.table, run)))
        return f"it cannot be compared with the board: {', '.join(fields)} differ." if fields else ""

    return lambda runs: sift_by(runs, fault)


def frontiers_of(ladder: Sequence[Run]) -> dict[str, tuple[Curve, ...]]:
    """Return the curves by scenario, plain fine-tuning first, of runs that `read_ladder` returned.

    A scenario with one learning rate has no curves: its runs are for the claims.
    """
    by_table = grouped((run.table, run) for run in ladder)
    return {table: _curves(members) for table, members in by_table.items() if _is_ladder(members)}


def _is_ladder(runs: Sequence[Run]) -> bool:
    """Return whether a method, with its other changes, ran at several learning rates."""
    return len({run.label for run in runs}) > len(set(map(apart_from_the_factor, runs)))


def on_the_ladder(runs: list[Run]) -> Sifted:
    """Keep the runs that changed the learning rate, to a positive value that tells it from all others.

    A run writes 1.0. With 1 or 1.0000001 in its place, a seed would have two records of one rung, which
    claims name by six digits.
    """
    fault = f"its changes have no {FACTOR}, the ladder's setting, of up to six digits, such as 0.3 or 1.0."

    def is_rung(factor: Any) -> bool:
        return isinstance(factor, float) and is_number(factor) and 0 < factor == float(f"{factor:g}")

    return sift_by(runs, lambda run: "" if is_rung(run.record.run.changes.get(FACTOR)) else fault)


def _curves(runs: Sequence[Run]) -> tuple[Curve, ...]:
    """Return the curves of the runs of one scenario, over the seeds that all have, if there are any."""
    seeds: dict[str, set[int]] = {}
    for run in runs:
        seeds.setdefault(run.label, set()).add(run.seed)
    common = set.intersection(*seeds.values())
    by_label: dict[str, dict[str, list[Run]]] = {}
    for run in sorted((run for run in runs if not common or run.seed in common), key=lambda run: run.seed):
        by_label.setdefault(run.record.run.method, {}).setdefault(apart_from_the_factor(run), []).append(run)
    curves = [
        Curve(method if len(labels) == 1 else label, members[0].division, _rungs(members))
        for method, labels in by_label.items()
        for label, members in labels.items()
    ]
    return tuple(
        sorted(curves, key=lambda one: (not one.is_baseline, DIVISIONS.index(one.division), one.method))
    )


def apart_from_the_factor(run: Run) -> str:
    """Return the label of a run of the ladder without its factor: the method with its other changes."""
    changes = {name: value for name, value in run.record.run.changes.items() if name != FACTOR}
    return label_of(run.record.run.method, changes)


def _rungs(runs: Sequence[Run]) -> tuple[Rung, ...]:
    by_factor = grouped((float(run.record.run.changes[FACTOR]), run) for run in runs)
    return tuple(_rung(factor, members) for factor, members in sorted(by_factor.items(), reverse=True))


def _rung(factor: float, runs: Sequence[Run]) -> Rung:
    generator = row_generator(runs[0].table, runs[0].label)
    found = estimate((LEARNED, KEPT), {run.seed: run.scores for run in runs}, generator)
    return Rung(factor, found[LEARNED], found[KEPT], tuple(run.seed for run in runs))
