"""Sentences of the findings on skills that are lost: how fast they come back."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from clbench.base.text import counted
from clbench.records.record import Relearning
from clbench.scoring.intervals import mean_of_seeds
from clbench.spec.references import BASELINE, FROM_SCRATCH

from ..board.rows import Row
from ..views.format import format_interval

LOST = 0.5
"""Share of its validation episodes below which a skill counts as lost."""

LOST_MEANS = (
    "Here, a skill counts as lost if the policy succeeds in fewer than half of its validation episodes after "
    "the last target. Each run measures only the skill with the fewest successes."
)


def relearning_sentences(boards: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return how fast the skill that succeeds least comes back, on each board where it was measured."""
    answers = []
    for name, rows in boards.items():
        by_method = {row.method: row for row in rows}
        measured = _measured(by_method.get(BASELINE))
        if not measured:
            continue
        lost = [found for found, share in measured if share < LOST]
        seeds = counted(len(measured), "seed")
        if len(lost) < 2:
            answers.append(f"On {name}, plain fine-tuning loses a skill in {len(lost)} of {seeds}.")
            continue
        answers.append(
            f"On {name}, plain fine-tuning loses a skill in {len(lost)} of {seeds} ({_skills(lost)}). "
            f"The policy meets the criterion again after {_steps(lost)} steps on the skill's "
            f"demonstrations{_never_again(lost)}."
            f"{_without_pretraining(by_method.get(FROM_SCRATCH), lost)}"
        )
    if answers:
        answers.insert(0, LOST_MEANS)
    return answers


def _never_again(lost: Sequence[Relearning]) -> str:
    """Return the end of a sentence on steps to relearn, if some runs ended without the criterion."""
    count = sum(not one.met for one in lost)
    if not count:
        return ""
    return (
        f"; in {count} of these {len(lost)} seeds it never does, which counts as the full budget of a stage"
    )


def _measured(row: Row | None) -> list[tuple[Relearning, float]]:
    """Return what each run of a row relearned, with the skill's success before."""
    runs = [run.record for run in row.runs] if row else []
    return [
        (record.relearning, record.relearning.successes / record.scenario.budget["validation_episodes"])
        for record in runs
        if record.relearning is not None
    ]


def _without_pretraining(row: Row | None, lost: Sequence[Relearning]) -> str:
    """Return what a policy without pretraining needs for the same skill; empty if no run measured that."""
    found = [one for one, _ in _measured(row)]
    same = [one for one in found if one.skill in {entry.skill for entry in lost}]
    if len(same) < 2:
        return ""
    return (
        f" A policy without pretraining, which has learned the targets, takes {_steps(same)} "
        f"({_skills(same)})."
    )


def _skills(found: Sequence[Relearning]) -> str:
    counts = Counter(one.skill for one in found)
    return ", ".join(f"`{skill}` in {count}" for skill, count in counts.most_common())


def _steps(found: Sequence[Relearning]) -> str:
    return format_interval(mean_of_seeds([one.steps for one in found], (0.0, math.inf)), ".0f")
