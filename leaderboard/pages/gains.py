"""Sections of the findings on gains over tuned fine-tuning, and their picture."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from clbench.base.text import counted, listed, megabytes
from clbench.scoring.groups import differences_needed
from clbench.scoring.intervals import Estimate
from clbench.spec.references import BASELINE

from ..board.certainty import TiedGain, sides_of_gains
from ..board.rows import Row
from ..board.summary import RANKED_BY, WITHOUT_DEMONSTRATIONS, competing
from ..views.format import MISSING, format_over_seeds, gain_text, no_tied_runs, number_text, rate_text
from ..views.sections import Section, Table, short

Tied = Mapping[str, Mapping[str, Sequence[TiedGain]]]
"""Gains over plain fine-tuning at tied settings by scenario and method: `Board.tied`."""


def by_gain(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods other than plain fine-tuning, by falling gain."""
    found = [row for row in competing(rows) if row.method != BASELINE]
    known = [row for row in found if row.estimates["gain"].value is not None]
    return sorted(known, key=lambda row: -(row.estimates["gain"].value or 0.0))


def is_tuned(boards: Iterable[Iterable[Row]]) -> bool:
    """Return whether tuning chose the settings of plain fine-tuning on all boards that have it."""
    return all(row.tried is not None for rows in boards for row in rows if row.method == BASELINE)


def without_tied_runs(boards: Mapping[str, Sequence[Row]], tied: Tied) -> Iterator[str]:
    """Yield the boards without a certain gain because plain fine-tuning lacks runs at a tied setting."""
    for name, rows in boards.items():
        lacking = [
            [one for one in tied.get(name, {}).get(row.method, ()) if not one.seeds] for row in by_gain(rows)
        ]
        if lacking and all(lacking):
            why = no_tied_runs(lacking[0][0])
            yield f"On {short(name)}, no gain is certain: for plain fine-tuning, {why}."


# ---- without prior demonstrations --------------------------------------------------------------------------

FAMILY = (
    "Methods are told apart from plain fine-tuning by Tukey's test of all methods without prior "
    "demonstrations on the scenario; what a gain must exceed depends on the method. The last column has the "
    "other gains whose own intervals exclude 0; they are not corrected for the number of methods."
)


def gains_section(boards: Mapping[str, Sequence[Row]], tied: Tied) -> Section:
    """Return whether any method beats tuned fine-tuning without prior demonstrations.

    Args:
        boards: Rows of each scenario at equal learning.
        tied: Gains over plain fine-tuning at tied settings.
    """
    judged = {name: rows for name, rows in boards.items() if _without_demonstrations(rows)}
    answers, undistinguished = [], []
    lines = []
    for name, rows in judged.items():
        sides = sides_of_gains(rows, tied.get(name, {}))
        found = list(_told_above(name, rows, tied.get(name, {}), sides))
        answers += found
        undistinguished += [] if found else [short(name)]
        lines.append(_gain_line(name, rows, tied.get(name, {}), sides))
    if undistinguished:
        where = listed(undistinguished)
        answers.insert(0, f"On {where}, no method is above plain fine-tuning and told apart from it.")
    for name in judged:
        answers += _over_tied_settings(name, tied.get(name, {}))
    head = ("scenario", "compared", "largest gain", "a gain must exceed", "told apart")
    tables = (Table((*head, "interval excludes 0, not told apart"), tuple(lines)),) if lines else ()
    kind = "tuned" if is_tuned(judged.values()) else "plain"
    question = f"Does a method without prior demonstrations beat {kind} fine-tuning?"
    picture = "gains" if any(by_gain(rows) for rows in boards.values()) else ""
    return Section(question, tuple(answers), tables, (FAMILY,) if lines else (), picture)


def _without_demonstrations(rows: Sequence[Row]) -> list[Row]:
    """Return the rows to compare with plain fine-tuning, by falling gain; none if it has no row."""
    has_baseline = any(row.method == BASELINE for row in rows)
    return [row for row in by_gain(rows) if has_baseline and row.division in WITHOUT_DEMONSTRATIONS]


def _told_above(
    name: str, rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]], sides: Mapping[str, int]
) -> Iterator[str]:
    """Yield the gains above 0 that are told apart from it: first those that are certain, then the others."""
    gains = {row.method: row.estimates["gain"] for row in _without_demonstrations(rows)}
    better = [method for method, gain in gains.items() if method in sides and (gain.value or 0.0) > 0]
    certain = [method for method in better if sides[method] == 1]
    if certain:
        named = ", ".join(f"`{method}` by {format_over_seeds(gains[method], '.3f')}" for method in certain)
        yield f"On {short(name)}, yes: {named}."
    for method in better:
        if method not in certain or tied.get(method):
            yield gain_text(short(name), f"`{method}`", gains[method], tied.get(method, ()))


def _gain_line(
    name: str, rows: Sequence[Row], tied: Mapping[str, Sequence[TiedGain]], apart: Collection[str]
) -> tuple[str, str, str, str, str, str]:
    """Return the cells of a scenario; `apart` are the methods that are told apart from plain fine-tuning."""
    others = _without_demonstrations(rows)
    gains = {row.method: row.estimates["gain"] for row in others}
    cells = {row.method: _gain_cell(row, tied.get(row.method, ())) for row in others}
    told = [cells[method] for method in gains if method in apart]
    alone = [
        cells[method]
        for method, gain in gains.items()
        if method not in apart and (gain.is_above(0) or gain.is_below(0))
    ]
    compared = f"{counted(len(gains), 'method')}, {counted(len(others[0].seeds), 'seed')}"
    needed = _smallest_told_apart(rows, gains)
    return (
        *(short(name), compared, cells[others[0].method], needed),
        *("; ".join(told) or MISSING, "; ".join(alone) or MISSING),
    )


def _gain_cell(row: Row, tied: Sequence[TiedGain]) -> str:
    """Return a method with its gain, and what speaks against reading it alone."""
    gain, met = row.estimates["gain"], row.estimates["criterion_met"].value
    remarks = []
    unsure = [one for one in tied if not one.is_certain]
    if gain.is_above(0) and unsure:
        measured = any(one.seeds for one in unsure)
        remarks.append("not over the tied setting" if measured else "no runs at the tied setting")
    if met is not None and met < 1:
        remarks.append(f"{1 - met:.0%} of its stages missed the criterion")
    remark = f" ({'; '.join(remarks)})" if remarks else ""
    return f"`{row.method}` {format_over_seeds(gain, '.3f')}{remark}"


def _smallest_told_apart(rows: Iterable[Row], methods: Collection[str]) -> str:
    """Return the gain, or the range of gains, that the test of these methods could just tell from 0."""
    family = {row.method: row.scores for row in rows if row.method in methods or row.method == BASELINE}
    needed = differences_needed(RANKED_BY, family, BASELINE)
    if not needed or not math.isfinite(max(needed.values())):
        return MISSING
    return " to ".join(dict.fromkeys(f"{end:.3f}" for end in (min(needed.values()), max(needed.values()))))


def _over_tied_settings(name: str, tied: Mapping[str, Sequence[TiedGain]]) -> Iterator[str]:
    """Yield how plain fine-tuning at a tied setting compares with the chosen one.

    Methods below it are not named: they, too, have tied settings, of which the board has only one.
    """
    for one in tied.get(BASELINE, ()):
        value, low, high = one.gain.value, one.gain.low, one.gain.high
        if one.gain.is_below(0) and value is not None and low is not None and high is not None:
            more = Estimate(-value, -high, -low)
            yield (
                f"On {short(name)}, tuning rated plain fine-tuning at {rate_text(one.factor)} as highly as "
                f"at the chosen one. In the test episodes of {counted(one.seeds, 'seed')} it ends "
                f"{format_over_seeds(more, '.3f')} higher than at the chosen one, so every gain on this "
                "board is smaller when it is measured over the tied setting."
            )


# ---- with prior demonstrations -----------------------------------------------------------------------------

WHAT_IS_KEPT = (
    "Replay and `a_gem` keep demonstrations between stages; `ewc` and `fast_dvla` keep vectors as large as "
    "the policy, which they make from demonstrations before the first stage."
)

OWN_RATES = (
    "Each method has the learning rate that tuning chose for it. A smaller rate takes more steps, so a "
    "difference in steps need not come from the demonstrations. A stage that misses the criterion counts as "
    "the full budget of steps."
)


def replay_section(boards: Mapping[str, Sequence[Row]], tied: Tied) -> Section:
    """Return what prior demonstrations buy, and what they cost.

    Args:
        boards: Rows of each scenario at equal learning.
        tied: Gains over plain fine-tuning at tied settings.
    """
    keeping = {name: [row for row in by_gain(rows) if _keeps_data(row)] for name, rows in boards.items()}
    lines: list[tuple[str, ...]] = []
    certain: list[bool] = []
    for name, members in keeping.items():
        sides = sides_of_gains(boards[name], tied.get(name, {}))
        certain += [sides.get(row.method) == 1 for row in members]
        lines += [_replay_line(row, "" if sides.get(row.method) else " (not certain)") for row in members]
        lines += [_replay_line(row) for row in boards[name] if row.method == BASELINE and members]
    question = "What do prior demonstrations buy?"
    if not lines:
        return Section(question, ())
    answer = (
        f"In {sum(certain)} of {counted(len(certain), 'comparison')}, a method that reads prior "
        "demonstrations certainly gains over plain fine-tuning."
    )
    head = (
        "scenario",
        "method",
        "gain",
        "kept between stages",
        "steps to learn a target",
        "stages that missed the criterion",
    )
    answers = (answer, *without_tied_runs(keeping, tied))
    return Section(question, answers, (Table(head, tuple(lines)),), (WHAT_IS_KEPT, OWN_RATES))


def _keeps_data(row: Row) -> bool:
    return row.division not in WITHOUT_DEMONSTRATIONS and bool(row.costs.get("bytes_kept"))


def _replay_line(row: Row, doubt: str = "") -> tuple[str, ...]:
    """Return the cells of a method; `doubt` follows its gain."""
    kept, met = row.costs.get("bytes_kept"), row.estimates["criterion_met"].value
    return (
        *(short(row.scenario), f"`{row.method}`"),
        MISSING if row.method == BASELINE else f"{format_over_seeds(row.estimates['gain'])}{doubt}",
        megabytes(int(kept or 0)),
        format_over_seeds(row.estimates["steps_to_criterion"], ".0f"),
        number_text(None if met is None else 1 - met, ".0%"),
    )
