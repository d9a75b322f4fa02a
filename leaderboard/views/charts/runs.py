"""Charts of the runs of one method: the success matrix, and the curves along the stages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from clbench.base.errors import InputError
from clbench.base.text import counted, printable
from clbench.records.paths import label_of, table_name
from clbench.records.record import Record
from clbench.scoring.intervals import Estimate, row_generator
from clbench.scoring.layout import Layout
from clbench.scoring.rates import check_same
from clbench.scoring.scores import Scores
from clbench.spec.references import BASELINE

from ..format import format_interval
from .along import SERIES, along_a_run, with_points
from .curves import estimated, retained_curve, target_curves
from .matrix import matrix
from .plane import WIDE
from .vega import FONT, Spec, heading, rounded


@dataclass(frozen=True)
class Runs:
    """Runs of one method on one scenario."""

    records: tuple[Record, ...]
    """Their records, one or more."""

    @classmethod
    def of(cls, records: Iterable[Record]) -> Runs:
        """Return the runs of records.

        Raises:
            InputError: There is no record, or they do not belong together.
        """
        found = cls(tuple(records))
        if not found.records:
            raise InputError("There is no record to draw.")
        names = dict.fromkeys(f"{found._method(one)} on {found._place(one)}" for one in found.records)
        if len(names) > 1:
            raise InputError(f"A chart shows one method on one scenario, not {', '.join(names)}.")
        check_same(one.layout for one in found.scores)
        return found

    @staticmethod
    def _method(record: Record) -> str:
        return label_of(record.run.method, record.run.changes)

    @staticmethod
    def _place(record: Record) -> str:
        return table_name(record.run.scenario, record.run.policy)

    @cached_property
    def scores(self) -> list[Scores]:
        """Their scores."""
        return [Scores.from_record(record) for record in self.records]

    @property
    def layout(self) -> Layout:
        """The layout of their scores, the targets as the first run learned them."""
        return self.scores[0].layout

    @property
    def method(self) -> str:
        """Name of their method."""
        return self.records[0].run.method

    @property
    def title(self) -> str:
        """Their method, scenario and seeds."""
        first, count = self.records[0], len(self.records)
        seeds = f"seed {first.run.seed}" if count == 1 else f"mean of {count} runs"
        return printable(f"{self._method(first)} on {self._place(first)}, {seeds}")

    @property
    def numbered(self) -> bool:
        """Whether targets are named by number, because the runs learned them in different orders."""
        return any(one.layout.target != self.layout.target for one in self.scores)

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets in their order."""
        names = enumerate(self.layout.target, 1)
        return tuple(f"target {number}" if self.numbered else printable(name) for number, name in names)

    @property
    def to_criterion(self) -> bool:
        """Whether their stages end when the target is learned."""
        return self.layout.to_criterion

    def curves(self) -> Mapping[str, Sequence[Estimate]]:
        """Return the points of all `SERIES` but the last, with intervals."""
        first = self.records[0]
        generator = row_generator(self._place(first), f"{self._method(first)} curves")
        retained, target = SERIES[:2]
        return estimated({retained: retained_curve, target: target_curves}, self.scores, generator)


def matrix_of(runs: Runs) -> Spec:
    """Return the chart of the mean success matrix of runs."""
    layout = runs.layout
    groups = {
        "retained": tuple(map(printable, layout.retained)),
        "target": runs.targets,
        "held out": tuple(map(printable, layout.held_out)),
    }
    stages = ["pretrained", *(f"after {name}" for name in runs.targets)]
    success = np.mean([one.rates().success for one in runs.scores], axis=0)
    return matrix(stages, groups, success, runs.title)


def curves_of(runs: Runs, sft: Runs | None) -> Spec:
    """Return the chart of the curves of runs, with plain fine-tuning's old skills if its runs are given."""
    steps = (1,) if runs.to_criterion else runs.layout.steps
    stages = range(len(runs.targets))
    at = {
        SERIES[0]: [(0, 0), *((stage, step) for stage in stages for step in steps)],
        SERIES[1]: [(stage, step) for stage in stages for step in (0, *steps)],
    }
    at[SERIES[2]] = at[SERIES[0]]
    found = dict(runs.curves())
    title = runs.title
    if sft is not None:
        check_same((runs.layout, sft.layout))
        if sft.method != BASELINE:
            raise InputError(f"The runs to compare with must be of {BASELINE}, not of {sft.method}.")
        title += f"; {BASELINE}: {counted(len(sft.records), 'run')}"
        found[SERIES[2]] = [Estimate(one.value, None, None) for one in sft.curves()[SERIES[0]]]
    points = [
        _point(series, place, steps[-1], one)
        for series, estimates in found.items()
        for place, one in zip(at[series], estimates, strict=True)
        if rounded(one.value) is not None
    ]
    names = runs.targets if runs.numbered else [f"{n} {name}" for n, name in enumerate(runs.targets, 1)]
    chart = along_a_run(names, None if runs.to_criterion else steps[-1], WIDE.width, FONT)
    return {**with_points(chart, points), "title": heading(title)}


def _point(series: str, place: tuple[int, int], length: int, one: Estimate) -> dict[str, Any]:
    """Return a point of a curve; the curve of the targets begins anew in each stage."""
    stage, step = place
    when = f"step {step}" if length > 1 else ("start", "end")[step]
    return {
        "series": series,
        "stage": f"{series} {stage}" if series == SERIES[1] else series,
        "x": stage * length + step,
        "y": rounded(one.value),
        "low": rounded(one.value if one.low is None else one.low),
        "high": rounded(one.value if one.high is None else one.high),
        "at": f"{when} of stage {stage + 1}",
        "success": format_interval(one),
    }
