"""Sentences of the findings on the order of the methods, and on what explains its differences."""

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
    Agreement,
    Concordance,
    agreement_between,
    kendall_tau,
)
from ..board.rows import Board, Row, agreement, values_by_seed
from ..board.summary import RANKED_BY, WITHOUT_DEMONSTRATIONS
from ..views.format import concordance_text, tau_text, title_of


def agreement_sentences(board: Board, boards: Mapping[str, list[Row]]) -> Iterator[str]:
    """Yield whether seeds, scenarios and definitions order the methods alike.

    Args:
        board: The board of the records.
        boards: Rows of each scenario at a common criterion.
    """
    for name, found in board.agreements.items():
        if found is not None and name in boards:
            yield f"On {name}, {_seeds_order(found)}."
            without = without_demonstrations(boards[name])
            alone = agreement(without)
            if alone is not None:  # replay is far above the others
                yield f"On {name}, without methods that read prior demonstrations, {_seeds_order(alone)}."
            yield from _shares_of_variance(name, without)
    pairs: list[tuple[str, Agreement, str]] = []
    for (one, rows), (other, others) in combinations(boards.items(), 2):
        across = _between(rows, others)
        if across is not None:
            pairs.append((f"{one} and {other}", across, counted(across.rows, "method")))
        rest = _between(*(without_demonstrations(them) for them in (rows, others)))
        if across is not None and rest is not None:
            methods = f"{counted(rest.rows, 'method')} without prior demonstrations"
            pairs.append((f"{one} and {other}", rest, methods))
    chances = [between.chance for _, between, _ in pairs]
    for (names, between, methods), corrected in zip(pairs, holm(chances), strict=True):
        yield f"{names} {_order(between, methods, corrected)}."
    yield from after_correction(chances)
    yield from _definitions(boards)


def holm(chances: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm 1979, Scandinavian Journal of Statistics 6)."""
    corrected, least = [0.0] * len(chances), 0.0
    for place, index in enumerate(sorted(range(len(chances)), key=chances.__getitem__)):
        least = max(least, min(1.0, (len(chances) - place) * chances[index]))
        corrected[index] = least
    return corrected


def after_correction(chances: Sequence[float]) -> Iterator[str]:
    """Yield how many p-values stay below 0.05 after Holm's correction, if any is below without it."""
    below = sum(chance < SIGNIFICANCE for chance in chances)
    if len(chances) < 2 or not below:
        return
    stay = sum(chance < SIGNIFICANCE for chance in holm(chances))
    yield (
        f"Of these {len(chances)} p-values, {below} {'is' if below == 1 else 'are'} "
        f"below {SIGNIFICANCE:g}; after Holm's correction for their number, {stay or 'none'}."
    )


DEFINITIONS = ("kept_share", "forgetting", "backward_transfer")
"""Metrics whose order of the methods is compared with that of the final average."""


def _definitions(boards: Mapping[str, list[Row]]) -> Iterator[str]:
    """Yield how alike metrics order the methods. They share episodes, so chance is not tested."""
    found = {name: _taus(rows) for name, rows in boards.items()}
    for name, taus in found.items():
        if taus:
            listed = ", ".join(f"{title_of(metric)} {tau:.2f}" for metric, tau in taus.items())
            yield f"On {name}, Kendall's tau between the final average and other metrics is: {listed}."
    if any(found.values()):
        yield (
            "All definitions count the same episodes, so they would order even equal methods alike: "
            "these figures describe the board, and are not a test."
        )


def _taus(rows: Sequence[Row]) -> dict[str, float]:
    """Return Kendall's tau between the final average and each of `DEFINITIONS` that the rows have."""
    found = {}
    for metric in DEFINITIONS:
        one, other = _common(rows, rows, RANKED_BY, metric)
        tau = float(kendall_tau(one.mean(axis=1), other.mean(axis=1))) if len(one) >= LEAST_ROWS else np.nan
        if np.isfinite(tau):
            found[metric] = tau
    return found


def without_demonstrations(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of methods that read no prior demonstrations, plain fine-tuning among them."""
    return [row for row in rows if row.division in WITHOUT_DEMONSTRATIONS]


def _shares_of_variance(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Yield the shares of the variance of the final average that the method and the seed explain.

    The shares are omega squared of the table of methods and seeds: sums of squares minus what noise alone
    adds to them (Hays 1963). For equal methods, the share of the method is 0 on average, before negative
    values become 0.

    Args:
        name: Name of the scenario.
        rows: Its rows without prior demonstrations.
    """
    values = np.array(list(values_by_seed(rows).values()), ndmin=2)
    if min(values.shape) < 2 or values.std() == 0:
        return
    (methods, seeds), mean = values.shape, values.mean()
    total = ((values - mean) ** 2).sum()
    by_method = seeds * ((values.mean(axis=1) - mean) ** 2).sum()
    by_seed = methods * ((values.mean(axis=0) - mean) ** 2).sum()
    noise = (total - by_method - by_seed) / ((methods - 1) * (seeds - 1))
    of_methods, of_seeds = (
        max(squares - degrees * noise, 0.0) / (total + noise)
        for squares, degrees in ((by_method, methods - 1), (by_seed, seeds - 1))
    )
    yield (
        f"On {name}, the method explains {of_methods:.0%} of the variance of the final average, and the seed "
        f"with its order of the targets {of_seeds:.0%} (omega squared; {methods} methods without prior "
        f"demonstrations, {seeds} seeds)."
    )


def _between(rows: Sequence[Row], others: Sequence[Row]) -> Agreement | None:
    """Return the agreement of two scenarios on the order of the methods that both have."""
    one, other = _common(rows, others, RANKED_BY, RANKED_BY)
    return agreement_between(one, other) if len(one) else None


def _common(
    rows: Sequence[Row], others: Sequence[Row], metric: str, other_metric: str
) -> tuple[Array, Array]:
    """Return two metrics of the methods that both lists have, higher is better, (methods, seeds).

    Args:
        rows: Rows of a scenario.
        others: Rows of another scenario, or of the same one.
        metric: Metric of the first rows.
        other_metric: Metric of the others.
    """
    ours, theirs = values_by_seed(rows, metric), values_by_seed(others, other_metric)
    both = [method for method in ours if method in theirs]
    one, other = (
        (1.0 if load_metric(name).higher_is_better else -1.0)
        * np.array([values[method] for method in both]).reshape(len(both), -1)
        for name, values in ((metric, ours), (other_metric, theirs))
    )
    return one, other


def _seeds_order(found: Concordance) -> str:
    """Return the sentence on how alike the seeds of a board order its methods, in lower case."""
    words = f"agree on the order of the {found.rows} methods more than chance would explain"
    if not found.certain:
        words = f"show no certain agreement on the order of the {found.rows} methods"
    return f"the {found.seeds} seeds {words} ({concordance_text(found)})"


def _order(found: Agreement, methods: str, corrected: float) -> str:
    """Return the predicate of a sentence on two boards; `corrected` is p corrected for all such pairs."""
    words = {
        1: f"agree on the order of {methods} more than chance would explain",
        0: f"show no certain agreement on the order of {methods}",
        -1: f"put {methods} in opposite orders",
    }
    alone = ", but only before Holm's correction" if found.direction and corrected >= SIGNIFICANCE else ""
    return f"{words[found.direction]}{alone} (Kendall's tau {tau_text(found)})"
