"""Section of the findings on skills that are lost: how fast they come back."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from clbench.base.text import counted
from clbench.records.record import Relearning
from clbench.scoring.intervals import mean_of_seeds
from clbench.spec.references import BASELINE, FROM_SCRATCH

from ..board.rows import Row
from ..views.format import MISSING, format_interval
from ..views.sections import Section, Table, short

LOST = 0.5
"""Share of its validation episodes below which a skill counts as lost."""

NOTES = (
    "Here, a skill counts as lost if the policy succeeds in fewer than half of its validation episodes after "
    "the last target. Each run measures only the skill with the fewest successes.",
    "The steps are those on the skill's demonstrations until the policy meets the criterion again; without "
    "it, they are the full budget of a stage. A policy without pretraining has learned the targets.",
)


def lost_skills_section(boards: Mapping[str, Sequence[Row]]) -> Section:
    """Return how fast the skill that succeeds least comes back, on each board where it was measured."""
    losses, lines = [], []
    for name, rows in boards.items():
        by_method = {row.method: row for row in rows}
        measured = _measured(by_method.get(BASELINE))
        if measured:
            lost = [found for found, share in measured if share < LOST]
            losses.append(f"{len(lost)} of {counted(len(measured), 'seed')} on {short(name)}")
            lines.append((short(name), *_cells(lost, by_method.get(FROM_SCRATCH))))
    question = "Is a lost skill gone for good?"
    if not lines:
        return Section(question, ())
    head = ("scenario", "lost skills", "steps to relearn", "never relearned", "steps without pretraining")
    answer = f"Plain fine-tuning loses a skill in {', '.join(losses)}."
    return Section(question, (answer,), (Table(head, tuple(lines)),), NOTES)


def _cells(lost: Sequence[Relearning], unpretrained: Row | None) -> tuple[str, str, str, str]:
    """Return the cells on the skills that plain fine-tuning lost, and on a policy without pretraining."""
    skills = {one.skill for one in lost}
    same = [one for one, _ in _measured(unpretrained) if one.skill in skills]
    never = f"{sum(not one.met for one in lost)} of {counted(len(lost), 'seed')}" if lost else MISSING
    return (_skills(lost) or MISSING, _steps(lost), never, _with_skills(same))


def _measured(row: Row | None) -> list[tuple[Relearning, float]]:
    """Return what each run of a row relearned, with the skill's success before."""
    runs = [run.record for run in row.runs] if row else []
    return [
        (record.relearning, record.relearning.successes / record.scenario.budget["validation_episodes"])
        for record in runs
        if record.relearning is not None
    ]


def _with_skills(found: Sequence[Relearning]) -> str:
    return f"{_steps(found)} ({_skills(found)})" if len(found) > 1 else MISSING


def _skills(found: Sequence[Relearning]) -> str:
    counts = Counter(one.skill for one in found)
    return ", ".join(f"`{skill}` in {count}" for skill, count in counts.most_common())


def _steps(found: Sequence[Relearning]) -> str:
    """Return the mean number of steps; a dash for a single run, which has no interval."""
    if len(found) < 2:
        return MISSING
    return format_interval(mean_of_seeds([one.steps for one in found], (0.0, math.inf)), ".0f")
