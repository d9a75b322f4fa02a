"""Live logging: what a run does, in TensorBoard while it is under way. The record does not depend on it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from clbench.base.dependencies import require
from clbench.learning.adaptation import Step
from clbench.records.record import Record
from clbench.spec.protocol import Point

LOG_STEPS = 10
"""Optimiser steps between two points of the loss."""


def require_tensorboard() -> None:
    """Refuse to log where TensorBoard is missing.

    Raises:
        LookupError: The package is not installed.
    """
    require("tensorboard", "tensorboard", "Logging for TensorBoard")


class Log:
    """The scalars of one run, over the optimiser steps since the first target; without a folder, nothing.

    `training/` holds loss and step size every `LOG_STEPS` steps; `success_test/`, `success_validation/` and
    `success_perturbed/` the success of each task, `question_accuracy/` that of each kind of question and of
    all, and `policy/` how far the policy has moved, at every evaluation point; `diagnostics/` the numbers
    that the method tells.

    Args:
        folder: Where the event files go.
        stage_steps: Optimiser steps of a stage.
        resumed_after: The stage whose points, and those before, an interrupted run has written; TensorBoard
            hides what is there beyond. All that is there if None.
    """

    def __init__(
        self, folder: Path | None = None, stage_steps: int = 0, resumed_after: int | None = None
    ) -> None:
        self._stage_steps = stage_steps
        self._writer = None
        if folder is not None:
            from torch.utils.tensorboard import SummaryWriter  # takes seconds to import

            first = 0 if resumed_after is None else resumed_after * stage_steps + 1
            self._writer = SummaryWriter(folder, purge_step=first)

    def step(self, stage: int, step: Step) -> None:
        """Log an optimiser step of a stage, if its turn has come."""
        if self._writer is None or step.loss is None or step.done % LOG_STEPS:
            return
        values = {"training/loss": step.loss.item(), "training/learning_rate": step.learning_rate}
        self._write(values.items(), stage, step.done)

    def report(self, record: Record, point: Point) -> None:
        """Log what a record holds about an evaluation point."""
        if self._writer is not None:
            self._write(_report(record, point), *point)
            self._writer.flush()  # the checkpoint that follows counts on it

    def diagnostics(self, found: Mapping[str, Any], stage: int) -> None:
        """Log the numbers among a method's diagnostics of a stage."""
        if self._writer is not None:
            numbers = ((name, value) for name, value in found.items() if type(value) in (int, float))
            values = ((f"diagnostics/{name}", value) for name, value in numbers)
            self._write(values, stage, self._stage_steps if stage else 0)
            self._writer.flush()

    def close(self) -> None:
        """Close the event file."""
        if self._writer is not None:
            self._writer.close()

    def _write(self, values: Iterable[tuple[str, float | None]], stage: int, step: int) -> None:
        """Write the values that there are at `step` of a stage; stage 0 has no steps."""
        assert self._writer is not None
        place = max(0, stage - 1) * self._stage_steps + step
        for tag, value in values:
            if value is not None:
                self._writer.add_scalar(tag, value, place)


def _report(record: Record, point: Point) -> Iterator[tuple[str, float | None]]:
    """Yield the tags and values of an evaluation point."""
    outcomes: dict[str, list[int]] = {}
    for row in _rows(record.episodes, point):
        outcomes.setdefault(f"success_{row['split']}/{row['task']}", []).append(row["success"])
    for tag, successes in outcomes.items():
        yield tag, sum(successes) / len(successes)
    answers = list(_rows(record.answers, point))
    for row in answers:
        yield f"question_accuracy/{row['kind']}", row["correct"] / row["asked"]
    asked = sum(row["asked"] for row in answers)
    yield "question_accuracy/all", sum(row["correct"] for row in answers) / asked
    for row in _rows(record.policy, point):
        yield "policy/update_sparsity", row["update_sparsity"]
        yield "policy/activation_drift", row["activation_drift"]


def _rows(columns: Mapping[str, list[Any]], point: Point) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table that belong to an evaluation point."""
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        if (row["stage"], row["step"]) == point:
            yield row
