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

NOTE = (
    "Here, a skill counts as lost if the policy succeeds in fewer than half of its validation episodes after "
    "the last target. Each run measures only the skill with the fewest successes. If the policy never meets "
    "the criterion again, the full budget of a stage counts."
)

UNPRETRAINED = "The last column is for a policy that was not pretrained, and learned only the targets."


def lost_skills_section(boards: Mapping[str, Sequence[Row]]) -> Section:
    """Return how fast the skill that succeeds least comes back, on each board where it was measured."""
    losses, lines = [], []
    for name, rows in boards.items():
        by_method = {row.method: row for row in rows}
        measured = _measured(by_method.get(BASELINE))
        if measured:
            lost = [found for found, share in measured if share < LOST]
            losses.append(
                f"On {short(name)}, plain fine-tuning loses a skill in {len(lost)} of "
                f"{counted(len(measured), 'seed')}{_return_of(lost)}."
            )
            lines.append((short(name), *_cells(lost, by_method.get(FROM_SCRATCH))))
    question = "Is a lost skill gone for good?"
    if not lines:
        return Section(question, ())
    head = ("scenario", "lost skills, seeds", "steps to relearn", "never relearned")
    if all(line[-1] == MISSING for line in lines):
        return Section(question, tuple(losses), (Table(head, tuple(line[:-1] for line in lines)),), (NOTE,))
    table = Table((*head, "steps without pretraining"), tuple(lines))
    return Section(question, tuple(losses), (table,), (NOTE, UNPRETRAINED))


def _return_of(lost: Sequence[Relearning]) -> str:
    """Return the end of a sentence on how fast lost skills come back, and on how many never do."""
    met = [one for one in lost if one.met]
    never = len(lost) - len(met)
    if not met:
        return ", and never meets the criterion again" if never else ""
    after = f" after {_steps(met)} steps on the skill's demonstrations" if len(met) > 1 else ""
    if never:
        return f", and meets the criterion again{after} in {len(met)} of them; in {never}, it never does"
    return f", and meets the criterion again{after}" if after else ""


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
