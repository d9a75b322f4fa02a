"""Order sensitivity: how much a method's final average depends on the order of the targets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from clbench.scoring.metrics import measure

from .runs import Run
from .summary import mean_of

LEAST_ORDERS = 3
"""Fewest orders for a range; a range over fewer orders means little."""


@dataclass(frozen=True)
class Order:
    """One order of the targets."""

    number: int
    """Number of the order; 0 is the published one."""
    targets: tuple[str, ...]
    """Names in the order in which they were learned."""
    final_average: float | None
    """Mean over the seeds that all orders share."""


@dataclass(frozen=True)
class Orders:
    """One method with the targets in several orders: same pretrained policies, same initial states."""

    seeds: tuple[int, ...]
    """Seeds that all orders share."""
    orders: tuple[Order, ...]
    """Orders by number."""

    @property
    def sensitivity(self) -> float | None:
        """Greatest minus least final average; None with fewer than `LEAST_ORDERS`, or if one is missing."""
        values = [order.final_average for order in self.orders if order.final_average is not None]
        if len(values) < max(LEAST_ORDERS, len(self.orders)):
            return None
        return max(values) - min(values)


def orders_of(runs: Iterable[Run]) -> Orders:
    """Return the orders among the runs of one method."""
    by_order: dict[int, dict[int, Run]] = {}
    for run in runs:
        by_order.setdefault(run.order, {})[run.seed] = run
    seeds = tuple(sorted(set.intersection(*(set(members) for members in by_order.values()))))
    orders = []
    for number, members in sorted(by_order.items()):
        targets = next(iter(members.values())).scores.layout.target
        orders.append(Order(number, targets, _final_average([members[seed] for seed in seeds])))
    return Orders(seeds, tuple(orders))


def _final_average(runs: list[Run]) -> float | None:
    values = [measure("final_average", run.scores) for run in runs]
    return None if None in values else mean_of(values)
