"""Sections of the findings on the order of the methods, and on what predicts it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from clbench.base.text import counted
from clbench.scoring.layout import Array
from clbench.scoring.metrics import load_metric

from ..board.agreement import (
    LEAST_ROWS,
    SIGNIFICANCE,
    Concordance,
    RankCorrelation,
    agreement_between,
    kendall_tau,
)
from ..board.rows import Board, Row, agreement, predictions, values_by_seed
from ..board.summary import RANKED_BY, WITHOUT_DEMONSTRATIONS
from ..views.format import MISSING, chance_text, number_text, title_of
from ..views.sections import Section, Table, short

# ---- orders ------------------------------------------------------------------------------------------------

COUNTED = (
    "Here, plain fine-tuning counts as a method, but controls do not: each is another method with one thing "
    "changed."
)

W_NOTE = (
    f"{COUNTED} "
    "Kendall's W is 1 if all seeds order the methods alike, and 0 if they do not agree at all; its p-value "
    "comes from Friedman's test. Shares of the variance are those of the final average, as omega squared, "
    "for methods without prior demonstrations; each seed has its own order of the targets."
)

CELLS = (
    "The cells have Kendall's tau, its range over redrawn seeds, p and the number of methods. Two orders "
    "agree, or are opposite, if the whole range lies on one side of 0 and p is below 0.05."
)

TAU_NOTE = f"{CELLS} Here, p is that of Kendall's test."

DEFINITIONS_NOTE = (
    "The last table has Kendall's tau between the final average and other metrics. All definitions count the "
    "same episodes, so they would order even equal methods alike: these figures describe the board, and are "
    "not a test."
)


def orders_section(board: Board, boards: Mapping[str, list[Row]]) -> Section:
    """Return whether seeds, scenarios and definitions order the methods alike.

    Args:
        board: The board of the records.
        boards: Rows of each scenario at a common criterion.
    """
    answers, tables, notes = [], [], []
    for answer, table, note in (_of_seeds(board, boards), _of_scenarios(boards), _of_definitions(boards)):
        if table.lines:
            answers += answer
            tables.append(table)
            notes.append(note)
    question = "Do seeds, scenarios and definitions order the methods alike?"
    return Section(question, tuple(answers), tuple(tables), tuple(notes))


def _of_seeds(board: Board, boards: Mapping[str, list[Row]]) -> tuple[list[str], Table, str]:
    """Return how alike the seeds of each scenario order its methods, and what explains the variance."""
    lines = []
    certain: dict[str, list[bool]] = {"": [], " without prior demonstrations": []}
    for name, every in board.agreements.items():
        if every is None or name not in boards:
            continue
        without = without_demonstrations(boards[name])
        alone = agreement(without)  # replay is far above the others
        for found, one in zip(certain.values(), (every, alone), strict=True):
            found += [] if one is None else [one.certain]
        lines.append((short(name), _w_text(every), _w_text(alone), *_shares_of_variance(without)))
    answers = [
        f"The seeds agree on the order of the methods{which} more than chance would explain on {sum(found)} "
        f"of {counted(len(found), 'scenario')} with enough methods."
        for which, found in certain.items()
        if found
    ]
    head = ("scenario", "Kendall's W, all methods", "W, without prior demonstrations")
    return answers, Table((*head, "variance: method", "variance: seed and order"), tuple(lines)), W_NOTE


def _w_text(found: Concordance | None) -> str:
    if found is None:
        return MISSING
    doubt = "" if found.certain else " (not certain)"
    return f"{found.w:.2f}, {chance_text(found.chance)}, {counted(found.rows, 'method')}{doubt}"


def _of_scenarios(boards: Mapping[str, list[Row]]) -> tuple[list[str], Table, str]:
    """Return how alike two scenarios order the methods that both have."""
    pairs: list[tuple[str, RankCorrelation, RankCorrelation | None]] = []
    for (one, rows), (other, others) in combinations(boards.items(), 2):
        if across := _between(rows, others):
            rest = _between(*(without_demonstrations(them) for them in (rows, others)))
            pairs.append((f"{short(one)} and {short(other)}", across, rest))
    found = [one for _, *both in pairs for one in both]
    lines = tuple(zip((names for names, *_ in pairs), *_columns(found), strict=True))
    head = ("scenarios", "Kendall's tau, all methods", "tau, without prior demonstrations")
    return list(after_correction(_chances(found), "for pairs of scenarios")), Table(head, lines), TAU_NOTE


DEFINITIONS = ("kept_share", "forgetting", "backward_transfer")
"""Metrics whose order of the methods is compared with that of the final average."""


def _of_definitions(boards: Mapping[str, list[Row]]) -> tuple[list[str], Table, str]:
    """Return how alike metrics order the methods. They share episodes, so chance is not tested."""
    found = {short(name): _taus(rows) for name, rows in boards.items()}
    lines = tuple(
        (name, *(number_text(taus.get(metric), ".2f") for metric in DEFINITIONS))
        for name, taus in found.items()
        if taus
    )
    head = ("final average and", *(title_of(metric) for metric in DEFINITIONS))
    return [], Table(head, lines), DEFINITIONS_NOTE


# ---- predictors --------------------------------------------------------------------------------------------

PREDICTED = (
    f"{COUNTED} "
    "Forgetting here is 1 minus the kept share. Both quantities come from the same runs, so p is simulated: "
    "it is the share of simulated boards with equal methods, and with the noise of these runs, that have "
    "such a tau. Methods differ in more than one way, for example in learning rate, so an order that agrees "
    "does not show what causes forgetting."
)

BY_CONSTRUCTION = "`stop_gradient` does not train the backbone, so by construction few of its weights change."


def predictors_section(board: Board, boards: Mapping[str, list[Row]]) -> Section:
    """Return what orders the methods as their forgetting does.

    Args:
        board: The board of the records.
        boards: Rows of each scenario at a common criterion.
    """
    by_place: dict[tuple[str, str], list[RankCorrelation | None]] = {}
    for name, rows in boards.items():
        rest = {one.predictor: one for one in predictions(without_demonstrations(rows))}
        for one in board.predictions.get(name, ()):
            by_place[short(name), one.predictor] = [one, rest.get(one.predictor)]
    question = "What predicts how much a method forgets?"
    if not by_place:
        return Section(question, ())
    found = [one for both in by_place.values() for one in both]
    cells = zip(by_place, *_columns(found), strict=True)
    lines = tuple((*place, every, rest) for place, every, rest in cells)
    head = ("scenario", "predictor", "Kendall's tau, all methods", "tau, without prior demonstrations")
    named = any(row.method == "stop_gradient" for rows in boards.values() for row in rows)
    notes = (PREDICTED, CELLS, *((BY_CONSTRUCTION,) if named else ()))
    answers = [*_that_predict(by_place), *after_correction(_chances(found), "for predictors")]
    return Section(question, tuple(answers), (Table(head, lines),), notes)


def _that_predict(by_place: Mapping[tuple[str, str], Sequence[RankCorrelation | None]]) -> Iterator[str]:
    """Yield the predictors whose order is certain after the correction."""
    groups = ("", " without prior demonstrations")
    found = [
        (place, which, one)
        for place, both in by_place.items()
        for which, one in zip(groups, both, strict=True)
        if one is not None
    ]
    words = {1: "as forgetting does", -1: "opposite to their forgetting"}
    for ((scenario, predictor), which, one), chance in zip(
        found, holm([one.chance for *_, one in found]), strict=True
    ):
        if one.direction and chance < SIGNIFICANCE:
            yield f"On {scenario}, {predictor} orders the methods{which} {words[one.direction]}."


# ---- texts -------------------------------------------------------------------------------------------------


def holm(chances: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm 1979, Scandinavian Journal of Statistics 6)."""
    corrected, least = [0.0] * len(chances), 0.0
    for place, index in enumerate(sorted(range(len(chances)), key=chances.__getitem__)):
        least = max(least, min(1.0, (len(chances) - place) * chances[index]))
        corrected[index] = least
    return corrected


def after_correction(chances: Sequence[float], which: str) -> Iterator[str]:
    """Yield how many p-values stay below 0.05 after Holm's correction, if any is below without it.

    `which` says in words what the p-values are of.
    """
    below = sum(chance < SIGNIFICANCE for chance in chances)
    if len(chances) < 2 or not below:
        return
    stay = sum(chance < SIGNIFICANCE for chance in holm(chances))
    yield (
        f"Of the {len(chances)} p-values {which}, {below} {'is' if below == 1 else 'are'} "
        f"below {SIGNIFICANCE:g}; after Holm's correction for their number, {stay or 'none'}."
    )


def _chances(found: Iterable[RankCorrelation | None]) -> list[float]:
    return [one.chance for one in found if one is not None]


def _columns(found: Sequence[RankCorrelation | None]) -> tuple[list[str], list[str]]:
    """Return the cells of agreements, which alternate: with all methods, and with some of them."""
    corrected = iter(holm(_chances(found)))
    cells = [MISSING if one is None else _tau_text(one, next(corrected)) for one in found]
    return cells[::2], cells[1::2]


def _tau_text(found: RankCorrelation, corrected: float) -> str:
    """Return the cell of an agreement, given its p-value after the correction."""
    order = {1: "agree: ", 0: "", -1: "opposite: "}[found.direction]
    alone = " (only before Holm's correction)" if found.direction and corrected >= SIGNIFICANCE else ""
    ends = " to ".join(number_text(end, ".2f") for end in (found.low, found.high))
    parts = (number_text(found.tau, ".2f"), ends, chance_text(found.chance), counted(found.rows, "method"))
    return f"{order}{', '.join(parts)}{alone}"


def _taus(rows: Sequence[Row]) -> dict[str, float]:
    """Return Kendall's tau between the final average and each of `DEFINITIONS` that the rows have."""
    found = {}
    for metric in DEFINITIONS:
        one, other = _common(rows, rows, metric)
        tau = float(kendall_tau(one.mean(axis=1), other.mean(axis=1))) if len(one) >= LEAST_ROWS else np.nan
        if np.isfinite(tau):
            found[metric] = tau
    return found


def without_demonstrations(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods that read no prior demonstrations, plain fine-tuning among them."""
    return [row for row in rows if row.division in WITHOUT_DEMONSTRATIONS]


def _shares_of_variance(rows: Sequence[Row]) -> tuple[str, str]:
    """Return the shares of the variance of the final average that the method and the seed explain.

    The shares are omega squared of the table of methods and seeds: sums of squares minus what noise alone
    adds to them (Hays 1963). For equal methods, the share of the method is 0 on average, before negative
    values become 0.

    Args:
        rows: Rows of a scenario, without those that read prior demonstrations.
    """
    values = np.array(list(values_by_seed(rows).values()), ndmin=2)
    if min(values.shape) < 2 or values.std() == 0:
        return MISSING, MISSING
    (methods, seeds), mean = values.shape, values.mean()
    total = ((values - mean) ** 2).sum()
    by_method = seeds * ((values.mean(axis=1) - mean) ** 2).sum()
    by_seed = methods * ((values.mean(axis=0) - mean) ** 2).sum()
    noise = (total - by_method - by_seed) / ((methods - 1) * (seeds - 1))
    of_methods, of_seeds = (
        max(squares - degrees * noise, 0.0) / (total + noise)
        for squares, degrees in ((by_method, methods - 1), (by_seed, seeds - 1))
    )
    return f"{of_methods:.0%}", f"{of_seeds:.0%}"


def _between(rows: Sequence[Row], others: Sequence[Row]) -> RankCorrelation | None:
    """Return the agreement of two scenarios on the order of the methods that both have."""
    one, other = _common(rows, others, RANKED_BY)
    return agreement_between(one, other) if len(one) else None


def _common(rows: Sequence[Row], others: Sequence[Row], metric: str) -> tuple[Array, Array]:
    """Return two metrics of the methods that both lists have, higher is better, (methods, seeds).

    Both arrays are empty if there is no such method.

    Args:
        rows: Rows of a scenario, of which the final average is returned.
        others: Rows of another scenario, or of the same one.
        metric: Metric of the others.
    """
    ours, theirs = values_by_seed(rows, RANKED_BY), values_by_seed(others, metric)
    both = [method for method in ours if method in theirs]
    one, other = (
        (1.0 if load_metric(name).higher_is_better else -1.0) * np.array([values[method] for method in both])
        for name, values in ((RANKED_BY, ours), (metric, theirs))
    )
    return one, other
