"""A report for the terminal, in lines that fit any width, and as values for JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from clbench.base.text import printable
from clbench.metrics.definitions import DEFINITIONS, FAMILIES
from clbench.metrics.report import Matrices, Report, Value
from clbench.scoring.metrics import METRICS

UNNAMED = "the matrix"
"""Name that is shown for a method without a name."""


def text(report: Report, notes: Sequence[str] = ()) -> Group:
    """Return a report for the terminal.

    Args:
        report: The report.
        notes: Notes of the table, such as its source.
    """
    return Group(
        *(Text(printable(note)) for note in notes),
        *_facts(report.matrices),
        *(part for family in FAMILIES for part in _family(report, family)),
        *_order(report),
        *_missing(report),
    )


def _facts(matrices: Matrices) -> Iterator[Text]:
    """Yield what was read, and what was assumed."""
    layout, largest = matrices.layout, f"{matrices.largest:g}"
    why = {
        ("share", False): "none is above 1",
        ("percent", False): f"the greatest is {largest}",
    }.get((matrices.unit, matrices.unit_was_given), "you said so")
    unit = {"share": "shares", "percent": "per cent"}[matrices.unit]
    yield Text(f"Rates: read as {unit}, since {why}; shown as shares.")
    for title, tasks in (
        ("Targets, in the order in which they were learned", layout.target),
        ("Retained", layout.retained),
        ("Held out", layout.held_out),
    ):
        if tasks:
            yield Text(f"{title}: {printable(', '.join(tasks))}.")
    if _most_seeds(matrices) > 1:
        yield Text(f"Seeds: {_seeds(matrices)}. Values are means over seeds, with 95 % intervals.")


def _most_seeds(matrices: Matrices) -> int:
    return max(map(len, matrices.success.values()))


def _seeds(matrices: Matrices) -> str:
    """Return how many seeds the methods have, such as "2" or "1 to 3"."""
    counts = {len(runs) for runs in matrices.success.values()}
    return " to ".join(map(str, sorted({min(counts), max(counts)})))


def _family(report: Report, family: str) -> Iterator[RenderableType]:
    """Yield the definitions of a family that have a value."""
    found = [name for name, one in DEFINITIONS.items() if one.family == family and _some(report.values[name])]
    if found:
        yield Text(f"\n{family.capitalize()}: {FAMILIES[family]}", style="bold")
    for name in found:
        yield from _definition(name, report.values[name], report.matrices)


def _definition(name: str, values: Mapping[str, Value], matrices: Matrices) -> Iterator[RenderableType]:
    """Yield a definition with the values of all methods, the best first."""
    metric = METRICS[name]
    numbers = {method: _number(value, method, matrices) for method, value in values.items()}
    best_first = sorted(values.items(), key=lambda item: _rank(item[1], metric.higher_is_better))
    if list(values) == [""]:
        yield Text.assemble((name, "bold"), f": {numbers['']}, {metric.direction}")
    else:
        yield Text.assemble((name, "bold"), f": {metric.direction}")
        items = [Text(f"{printable(method)} {numbers[method]}") for method, _ in best_first]
        yield Padding(Columns(items, padding=(0, 3)), (0, 0, 0, 4))
    yield Padding(Text(f"{DEFINITIONS[name].assumption} Source: {metric.source}."), (0, 0, 0, 4))


def _rank(value: Value, higher_is_better: bool | None) -> tuple[bool, float]:
    """Return the key that sorts the best value to the front and missing ones to the end."""
    number = value.value or 0.0
    return value.value is None, -number if higher_is_better else number


def _number(value: Value, method: str, matrices: Matrices) -> str:
    """Return a value with its interval, or with the reason why it has none while other methods may."""
    if value.value is None:
        return "-"
    if value.low is not None:
        return f"{value.value:.3f} [{value.low:.3f}, {value.high:.3f}]"
    why = " (seeds agree)" if len(matrices.success[method]) > 1 else " (one seed)"
    return f"{value.value:.3f}{why if _most_seeds(matrices) > 1 else ''}"


def _order(report: Report) -> Iterator[RenderableType]:
    """Yield where the order of the methods depends on the definition."""
    if len(report.matrices.success) < 2:
        return
    yield Text("\nWhere the order of methods flips", style="bold")
    if not report.flips:
        yield Text("Nowhere: within each family, all definitions agree.")
    elif _most_seeds(report.matrices) > 1:
        yield Text(f"With {_seeds(report.matrices)} seeds a difference may be noise: look at the intervals.")
    else:
        yield Text("With one seed a difference may be noise: there are no intervals.")
    for flip in report.flips:
        first, second = printable(flip.first or UNNAMED), printable(flip.second or UNNAMED)
        yield Text(f"{flip.family}: {first} or {second}?")
        for winner, names in ((first, flip.first_is_better), (second, flip.second_is_better)):
            yield Padding(Text.assemble((winner, "bold"), f" by {', '.join(names)}"), (0, 0, 0, 4))


def _missing(report: Report) -> Iterator[RenderableType]:
    """Yield the metrics without a value by their reasons."""
    by_reason: dict[str, list[str]] = {}
    for name, values in report.values.items():
        for method, value in values.items():
            if value.reason is not None and name in DEFINITIONS:
                of_method = f" ({printable(method)})" if method and _some(values) else ""
                entry = f"{name}{of_method}"
                if entry not in by_reason.setdefault(value.reason, []):
                    by_reason[value.reason].append(entry)
    if by_reason:
        yield Text("\nNo value", style="bold")
    for reason, names in by_reason.items():
        yield Text(printable(reason))
        yield Padding(Text(", ".join(names)), (0, 0, 0, 4))
    others = [name for name in report.values if name not in DEFINITIONS]
    yield Text("\nNot from success at the ends of stages", style="bold")
    yield Text(", ".join(others))


def _some(values: Mapping[str, Value]) -> bool:
    """Return whether some method has a value."""
    return any(value.reason is None for value in values.values())


# ---- JSON --------------------------------------------------------------------------------------------------


def as_values(report: Report) -> dict[str, Any]:
    """Return a report as values for JSON; a missing value is None, with its reason."""
    matrices = report.matrices
    return {
        "unit": matrices.unit,
        "unit_was_given": matrices.unit_was_given,
        "retained": list(matrices.layout.retained),
        "target": list(matrices.layout.target),
        "held_out": list(matrices.layout.held_out),
        "seeds": {method: list(runs) for method, runs in matrices.success.items()},
        "metrics": [_metric(name, values) for name, values in report.values.items()],
        "flips": [vars(flip) for flip in report.flips],
    }


def _metric(name: str, values: Mapping[str, Value]) -> dict[str, Any]:
    metric, definition = METRICS[name], DEFINITIONS.get(name)
    return {
        "name": name,
        "family": definition.family if definition else None,
        "higher_is_better": metric.higher_is_better,
        "formula": metric.formula,
        "assumption": definition.assumption if definition else None,
        "source": metric.source,
        "values": {method: vars(value) for method, value in values.items()},
    }
