"""Order sensitivity: how much of a method's final average depends on the order that the targets come in."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from clbench.scoring.metrics import measure

from .runs import Run

LEAST_ORDERS = 3
"""With fewer a range says next to nothing."""


@dataclass(frozen=True)
class Order:
    """One order of the targets."""

    number: int
    """0 is the published one."""
    targets: tuple[str, ...]
    """Names in the order in which they were learned."""
    final_average: float | None
    """Mean over the seeds that all orders have."""


@dataclass(frozen=True)
class Orders:
    """One method with the targets in several orders: same pretrained policies, same initial states."""

    seeds: tuple[int, ...]
    """Those that all orders have."""
    orders: tuple[Order, ...]
    """By number."""

    @property
    def sensitivity(self) -> float | None:
        """Greatest less least final average; None with fewer than `LEAST_ORDERS`, or where one is missing."""
        values = [order.final_average for order in self.orders if order.final_average is not None]
        if len(values) < max(LEAST_ORDERS, len(self.orders)):
            return None
        return max(values) - min(values)


def orders_of(runs: Iterable[Run]) -> Orders:
    """Return what came of the runs of one method, whatever their orders."""
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
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known and len(known) == len(values) else None
