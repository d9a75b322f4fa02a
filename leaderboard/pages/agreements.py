"""Sentences of the findings on the order of the methods, and on what its differences are due to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from clbench.base.text import counted
from clbench.scoring.metrics import load_metric

from ..board.agreement import Agreement, Concordance, agreement_between
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
            without = [row for row in boards[name] if row.division in WITHOUT_DEMONSTRATIONS]
            alone = agreement(without)
            if alone is not None:  # replay is far above the others
                yield f"On {name}, without methods that read prior demonstrations, {_seeds_order(alone)}."
            yield from _shares_of_variance(name, without)
    for (one, rows), (other, others) in combinations(boards.items(), 2):
        across = _between(rows, others, RANKED_BY, RANKED_BY)
        if across is not None:
            yield f"{one} and {other} {_order(across, counted(across.rows, 'method'))}."
    for name, rows in boards.items():
        for metric in ("kept_share", "forgetting", "backward_transfer"):
            same = _between(rows, rows, RANKED_BY, metric, paired=True)
            if same is not None:
                yield f"On {name}, final average and {title_of(metric)} {_order(same)}."


def _shares_of_variance(name: str, rows: Sequence[Row]) -> Iterator[str]:
    """Yield which share of the variance of the final average the method explains, and which the seed.

    They are the sums of squares of the table of methods and seeds.

    Args:
        name: Name of the scenario.
        rows: Its rows without prior demonstrations.
    """
    values = np.array(list(values_by_seed(rows).values()), ndmin=2)
    if min(values.shape) < 2 or values.std() == 0:
        return
    mean = values.mean()
    total = ((values - mean) ** 2).sum()
    of_methods = values.shape[1] * ((values.mean(axis=1) - mean) ** 2).sum() / total
    of_seeds = values.shape[0] * ((values.mean(axis=0) - mean) ** 2).sum() / total
    yield (
        f"On {name}, of the variance of the final average over {values.shape[0]} methods without prior "
        f"demonstrations and {values.shape[1]} seeds, the method explains {of_methods:.0%}, and the seed "
        f"with its order of the targets {of_seeds:.0%}."
    )


def _between(
    rows: Sequence[Row], others: Sequence[Row], metric: str, other_metric: str, *, paired: bool = False
) -> Agreement | None:
    """Return the agreement of two metrics on the order of the methods that both lists have.

    Args:
        rows: Rows of a scenario.
        others: Rows of another one, or the same.
        metric: Metric of the first rows.
        other_metric: Metric of the others.
        paired: Whether both are of the same runs.
    """
    ours, theirs = values_by_seed(rows, metric), values_by_seed(others, other_metric)
    both = [method for method in ours if method in theirs]
    if not both:
        return None
    one, other = (
        (1.0 if load_metric(name).higher_is_better else -1.0) * np.array([values[method] for method in both])
        for name, values in ((metric, ours), (other_metric, theirs))
    )
    return agreement_between(one, other, paired=paired)


def _seeds_order(found: Concordance) -> str:
    """Return the sentence on how alike the seeds of a board order its methods, in lower case."""
    words = f"order the {found.rows} methods alike more than chance would explain"
    if not found.certain:
        words = f"show no certain agreement on the order of the {found.rows} methods"
    return f"the {found.seeds} seeds {words} ({concordance_text(found)})"


def _order(found: Agreement, methods: str = "the methods") -> str:
    """Return the predicate of a sentence on two boards."""
    words = {
        1: f"agree on the order of {methods} more than chance would explain",
        0: f"show no certain agreement on the order of {methods}",
        -1: f"put {methods} in opposite orders",
    }
    return f"{words[found.direction]} (Kendall's tau {tau_text(found)})"
