"""Live logging: shows a run in progress in TensorBoard. The record does not depend on the log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from clbench.base.dependencies import require
from clbench.learning.adaptation import Step
from clbench.records.record import PolicyRow, Record
from clbench.spec.protocol import Point

LOG_STEPS = 10
"""Number of optimiser steps between two points of the loss."""


def require_tensorboard() -> None:
    """Check that TensorBoard is installed.

    Raises:
        MissingPackageError: TensorBoard is not installed.
    """
    require("tensorboard", "tensorboard", "Logging for TensorBoard")


class Log:
    """A log of one run's scalars over the optimiser steps since the first target.

    `training/` has the loss and the learning rate every `LOG_STEPS` steps. At every evaluation point,
    `success_test/`, `success_validation/` and `success_perturbed/` have the success rate of each task,
    `question_accuracy/` has the accuracy of each kind of question and of all questions, and `policy/` has the
    distance from the pretrained policy and, at the end of a stage, the shift within the stage. `diagnostics/`
    has the numbers among the method's diagnostics.

    Args:
        folder: Folder of the event files; None logs nothing.
        stage_steps: Number of optimiser steps in a stage.
        resumed_after: Last stage whose points an interrupted run has written; TensorBoard hides all later
            points. None hides all earlier logs.
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
        """Log every `LOG_STEPS`-th optimiser step of a stage."""
        if self._writer is None or step.loss is None or step.done % LOG_STEPS:
            return
        values = {"training/loss": step.loss.item(), "training/learning_rate": step.learning_rate}
        self._write(values.items(), stage, step.done)

    def report(self, record: Record, point: Point) -> None:
        """Log the results of an evaluation point in a record."""
        if self._writer is not None:
            self._write(_report(record, point), *point)
            self._writer.flush()  # the next checkpoint relies on it

    def diagnostics(self, found: Mapping[str, Any], stage: int) -> None:
        """Log the numbers among a method's diagnostics for a stage."""
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
        """Write the values other than None at `step` of a stage; stage 0 has no steps."""
        assert self._writer is not None
        place = max(0, stage - 1) * self._stage_steps + step
        for tag, value in values:
            if value is not None:
                self._writer.add_scalar(tag, value, place)


def _report(record: Record, point: Point) -> Iterator[tuple[str, float | None]]:
    """Yield tag and value of each scalar at an evaluation point."""
    outcomes: dict[str, list[int]] = {}
    for episode in record.episode_rows():
        if episode.point == point:
            outcomes.setdefault(f"success_{episode.split}/{episode.task}", []).append(episode.success)
    for tag, successes in outcomes.items():
        yield tag, sum(successes) / len(successes)
    answers = (row for row in record.answer_rows() if row[:2] == point)
    asked = [row for row in answers if row.asked]  # a policy that cannot answer is asked no questions
    for row in asked:
        yield f"question_accuracy/{row.kind}", row.correct / row.asked
    if asked:
        yield "question_accuracy/all", sum(row.correct for row in asked) / sum(row.asked for row in asked)
    for change in record.policy_rows():
        if change[:2] == point:
            yield from ((f"policy/{name}", getattr(change, name)) for name in PolicyRow._fields[2:])
