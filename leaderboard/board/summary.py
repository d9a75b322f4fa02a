"""The numbers of the board without its records: all that the terminal and `--json` show."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Protocol, TypeVar

from clbench.scoring.intervals import Estimate
from clbench.scoring.metrics import METRICS

from .agreement import Concordance

WITHOUT_DEMONSTRATIONS = ("prior-data-free", "prior questions")
"""Divisions of methods that may not read prior demonstrations."""

WITH_DEMONSTRATIONS = ("prior demonstrations",)
"""Divisions of methods that may read prior demonstrations."""

METHODS = (*WITHOUT_DEMONSTRATIONS, *WITH_DEMONSTRATIONS)
"""Divisions of methods, which start from the same policy and learn from the same demonstrations."""

ELSEWHERE = ("online", "external")
"""Divisions of policies that another program trained, so that there is nothing to run again: agents, which
learned by trial, and policies that were fine-tuned on data that their authors declare. No method is compared
with either. Each has a page of its name in `docs/guide`, and an actor in `clbench verify`."""

REFERENCE = "reference"
"""Division of references, which do not compete."""

DIVISIONS = (*METHODS, *ELSEWHERE, REFERENCE)
"""Divisions in the order of the table. Each has a rule in `RULES`, a shape in `SHAPES`, and a colour in
`PALETTE` and the style of the page."""

COSTS = {
    "steps": "optimiser_steps",
    "bytes_kept": "bytes_kept",
    "parameters": "parameters",
    "parameters_added": "parameters_added",
    "environment_steps": "environment_steps",
}
"""Fields of `Record.costs` by column of the table."""

RANKED_BY = "final_average"
"""Metric that rows are compared by."""

GAIN = "gain"
"""The same metric minus plain fine-tuning's with the same seeds."""


@dataclass(frozen=True, kw_only=True)
class RowSummary:
    """The numbers of one method on one scenario."""

    scenario: str
    """Name of its table: the Gymnasium id, with the name of the policy if it is not the default one."""
    method: str
    """Name or "module:Class"."""
    division: str
    """One of `DIVISIONS`."""
    letters: str | None
    """Letters of its groups. Two rows of a scenario and division share a letter if they are not told apart.
    None for a reference, which does not compete, and for a row without a final average."""
    tier: str
    """The lowest of `TIERS` among its runs: how far people other than the submitter have checked them."""
    seeds: tuple[int, ...]
    """Seeds of its runs."""
    to_criterion: bool
    """Whether its stages end when the target is learned."""
    estimates: Mapping[str, Estimate]
    """Value and interval of every metric."""
    costs: Mapping[str, float | None]
    """Mean over seeds by column of the table."""
    order_sensitivity: float | None
    """Range of the final average over the orders of the targets, see `Orders.sensitivity`."""
    tried: int | None = None
    """Number of settings that tuning tried on the scenario; None for a method that was not tuned."""


@dataclass(frozen=True)
class NotShown:
    """A file that makes no row."""

    path: str
    """Path, relative to the folder of records."""
    reason: str
    """Reason, in words."""

    def __str__(self) -> str:
        return f"{self.path}: {self.reason}"


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The numbers of the board."""

    rows: tuple[RowSummary, ...] = ()
    """Rows by scenario and division, the best first; scenarios with a criterion come first."""
    starts: Mapping[str, float | None] = field(default_factory=dict)
    """Mean success of the pretrained policy on its skills, by scenario."""
    machines: Mapping[str, str] = field(default_factory=dict)
    """Kind of processor on which all records of a scenario were made, if its worlds move differently there
    than in the published records, by scenario."""
    unpaired: Mapping[str, Mapping[str, Sequence[int]]] = field(default_factory=dict)
    """Seeds whose runs began with another pretrained policy than plain fine-tuning, by scenario and
    method."""
    agreements: Mapping[str, Concordance | None] = field(default_factory=dict)
    """How alike the seeds order the rows, by scenario."""
    not_shown: tuple[NotShown, ...] = ()
    """Files that make no row, by path."""

    def to_json(self) -> dict[str, Any]:
        """Return the summary as JSON; further fields of a subclass are left out."""
        return {
            "rows": [_row_to_json(row) for row in self.rows],
            "starts": dict(self.starts),
            "machines": dict(self.machines),
            "unpaired": {name: dict(found) for name, found in self.unpaired.items()},
            "agreements": {name: found and asdict(found) for name, found in self.agreements.items()},
            "not_shown": [asdict(entry) for entry in self.not_shown],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Summary:
        """Return the summary that `to_json` wrote.

        Raises:
            KeyError, TypeError: It has other fields.
        """
        return Summary(
            rows=tuple(_row_from_json(row) for row in values["rows"]),
            starts=values["starts"],
            machines=values["machines"],
            unpaired=values["unpaired"],
            agreements={name: found and Concordance(**found) for name, found in values["agreements"].items()},
            not_shown=tuple(NotShown(**entry) for entry in values["not_shown"]),
        )


_PLAIN = [one.name for one in fields(RowSummary) if one.name not in ("seeds", "estimates", "costs")]
"""Fields of a row that are JSON as they are."""


def _row_to_json(row: RowSummary) -> dict[str, Any]:
    return {
        **{name: getattr(row, name) for name in _PLAIN},
        "seeds": list(row.seeds),
        "estimates": {name: [one.value, one.low, one.high] for name, one in row.estimates.items()},
        "costs": dict(row.costs),
    }


def _row_from_json(values: Mapping[str, Any]) -> RowSummary:
    seeds = tuple(values["seeds"])
    estimates = {
        name: Estimate(value, low, high, of_seeds=len(seeds) > 1)
        for name, (value, low, high) in values["estimates"].items()
    }
    return RowSummary(**{**values, "seeds": seeds, "estimates": estimates})


class Placed(Protocol):
    """A row with a division, of one scenario or of all."""

    @property
    def division(self) -> str:
        """One of `DIVISIONS`."""


OneRow = TypeVar("OneRow", bound=RowSummary)
PlacedRow = TypeVar("PlacedRow", bound=Placed)
Key = TypeVar("Key")
Value = TypeVar("Value")


def in_order_of(rows: Iterable[OneRow], metric: str) -> tuple[OneRow, ...]:
    """Return the rows, each division of each table by the value of a metric, the best first, missing last."""
    sign = -1 if METRICS[metric].higher_is_better is False else 1

    def place(row: RowSummary) -> tuple[bool, float]:
        value = row.estimates[metric].value
        return value is None, 0.0 if value is None else -sign * value

    divisions = (members for table in tables_of(rows).values() for members in divisions_of(table).values())
    return tuple(row for members in divisions for row in sorted(members, key=place))


def letters_of(row: RowSummary, rows: Iterable[RowSummary]) -> str:
    """Return the letters of a row; empty if its division has no other row to tell it apart from.

    Args:
        row: The row.
        rows: All rows of its table.
    """
    rivals = [other for other in rows if other.division == row.division]
    return row.letters if row.letters and len(rivals) > 1 else ""


def tables_of(rows: Iterable[OneRow]) -> dict[str, list[OneRow]]:
    """Return the rows by the name of their table, tables and rows in the order of `rows`."""
    return grouped((row.scenario, row) for row in rows)


def divisions_of(rows: Iterable[PlacedRow]) -> dict[str, list[PlacedRow]]:
    """Return the rows by their division, divisions and rows in the order of `rows`."""
    return grouped((row.division, row) for row in rows)


def competing(rows: Iterable[PlacedRow]) -> list[PlacedRow]:
    """Return the rows of methods, which compete; references and policies from other programs do not."""
    return [row for row in rows if row.division in METHODS]


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are known, None if none is."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Return the values of each key, in their order."""
    found: dict[Key, list[Value]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


def column_names() -> list[str]:
    """Return the columns of the CSV file and of the data frame."""
    ends = ("", "_low", "_high")
    metrics = (name + end for name in METRICS for end in ends)
    return [
        "scenario",
        "method",
        "division",
        "letters",
        "tier",
        "seeds",
        *metrics,
        "relative_cost",
        *COSTS,
        "order_sensitivity",
        "settings_tried",
    ]


def values_of(row: RowSummary) -> list[str | float | None]:
    """Return the values of `row` in the order of `column_names`."""
    estimates = (row.estimates[name] for name in METRICS)
    numbers = [number for one in estimates for number in (one.value, one.low, one.high)]
    place = [row.scenario, row.method, row.division, row.letters, row.tier, len(row.seeds)]
    return [*place, *numbers, *row.costs.values(), row.order_sensitivity, row.tried]
