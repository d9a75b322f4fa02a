"""Coverage of the intervals, and false splits and power of the groups, simulated in minutes.

Run `python benchmarks/interval_coverage.py`.

The model mimics a row of the benchmark. The success rates of a method's runs have a beta distribution. Its
standard deviation is stated for a mean rate of one half; at a rate p it is 2 sqrt(p (1 - p)) times as large.
On the normal scale, half of the variance between runs belongs to the seed, which all methods share, and half
to the run alone. An episode succeeds if its luck is below the rate. Half of the variance of luck belongs to
the initial state, which all methods share. Draws are seeded, so that the result is the same each time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy import special

from clbench.records.paths import RECORDS
from clbench.records.reader import read_record
from clbench.scoring.groups import told_apart
from clbench.scoring.intervals import Estimate, interval
from clbench.scoring.layout import Array
from clbench.scoring.metrics import load_metric
from clbench.scoring.scores import Scores, rates_of
from clbench.spec.references import REFERENCES

RESULTS = Path(__file__).parent / "results" / "coverage.json"
BOARDS = ("Fetch-v1", "MetaWorld-v1", "PointMaze-v1")
"""Folders of records whose deviations between seeds the page states."""
EPISODES, FEW_EPISODES = 200, 40
"""Episodes of a run, of all tasks together, and of the two skills of PointMaze-v1."""
ROOT = math.sqrt(0.5)
"""Weight of each half of a variance."""
OTHERS = {0.01: 0.03, 0.03: 0.1, 0.1: 0.5, 0.5: 0.5, 0.9: 0.5, 0.97: 0.03, 0.99: 0.01}
"""Mean rates, each with another one for the difference of two methods."""
Outcomes = NDArray[np.bool_]
"""Success of episodes, (methods, seeds, episodes)."""


def main() -> None:
    """Simulate, print the tables of docs/guide/statistics.md and write results/coverage.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--simulations", type=int, default=4000, help="rows for each interval")
    parser.add_argument("--boards", type=int, default=1000, help="boards for each kind of board")
    arguments = parser.parse_args()
    generator = np.random.default_rng(0)
    results = {
        "simulations": arguments.simulations,
        "boards": arguments.boards,
        "intervals": list(interval_coverage(generator, arguments.simulations, SEVERAL)),
        "false_splits": list(false_splits(generator, arguments.boards)),
        "power": list(power(generator, arguments.boards)),
        "few_episodes": list(few_episodes(arguments.simulations)),
        "records": {name: seed_deviations(RECORDS / name) for name in BOARDS},
    }
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(_json(results), encoding="utf-8", newline="\n")
    print("\n\n".join(tables(results)))


def _json(results: dict[str, Any]) -> str:
    """Return `results` with a line for each row of a list."""
    parts = []
    for name, value in results.items():
        rows = ",\n  ".join(map(json.dumps, value)) if isinstance(value, list) else ""
        parts.append(f' "{name}": ' + (f"[\n  {rows}\n ]" if rows else json.dumps(value)))
    return "{\n" + ",\n".join(parts) + "\n}\n"


# ---- model -------------------------------------------------------------------------------------------------


def outcomes(
    generator: np.random.Generator,
    rates: Array,
    deviations: Array,
    seeds: int,
    episodes: int = EPISODES,
) -> Outcomes:
    """Return the outcomes of methods.

    Args:
        generator: Source of the draws.
        rates: The methods' mean rates, (methods,).
        deviations: Standard deviations of their runs' rates, as if the mean rate were one half, (methods,).
        seeds: Number of seeds.
        episodes: Number of episodes of a run.
    """
    shape = (len(rates), seeds)
    places = ROOT * (generator.standard_normal(shape) + generator.standard_normal(seeds))
    rates, deviations = np.broadcast_to(rates[:, None], shape), np.broadcast_to(deviations[:, None], shape)
    of_runs, vary = rates.copy(), deviations > 0
    # A beta distribution of mean p has the variance p (1 - p) / (size + 1).
    mean, size = rates[vary], 0.25 / deviations[vary] ** 2 - 1
    of_runs[vary] = special.betaincinv(mean * size, (1 - mean) * size, special.ndtr(places[vary]))
    luck = generator.standard_normal((*shape, episodes), dtype=np.float32)
    luck += generator.standard_normal((seeds, episodes), dtype=np.float32)
    return np.asarray(ROOT * luck < special.ndtri(of_runs)[..., None])


# ---- intervals ---------------------------------------------------------------------------------------------


Cell = tuple[int, float, float]
"""Number of seeds, deviation and mean rate."""
SEVERAL: list[Cell] = [
    *itertools.product((1,), (0.0,), OTHERS),
    *itertools.product((2, 3, 4, 5, 8), (0.0, 0.05, 0.1), OTHERS),
]


def few_episodes(simulations: int) -> Iterator[dict[str, Any]]:
    """Yield the coverage with few episodes and the deviations of retention on MetaWorld and PointMaze."""
    cells = list(itertools.product((4, 8), (0.14, 0.24), OTHERS))
    return interval_coverage(np.random.default_rng(1), simulations, cells, FEW_EPISODES)


def interval_coverage(
    generator: np.random.Generator, simulations: int, cells: Sequence[Cell], episodes: int = EPISODES
) -> Iterator[dict[str, Any]]:
    """Yield the coverage of the intervals of a rate, and of its difference to another rate.

    With one seed the truth is the rate of this run, so that seeds do not differ.
    """
    for seeds, deviation, rate in track(cells, "intervals"):
        other = OTHERS[rate]
        # Seeds are independent: the seeds of all simulations are drawn at once.
        rates, deviations = np.array([rate, other]), np.full(2, deviation)
        both = outcomes(generator, rates, deviations, simulations * seeds, episodes)
        first, second = both.astype(np.int8).reshape(2, simulations, seeds, episodes)
        for name, success, truth, span in (
            ("rate", first, rate, (0.0, 1.0)),
            ("difference", first - second, rate - other, (-1.0, 1.0)),
        ):
            found = [_interval(generator, one, span) for one in success]
            ends = np.array([[one.low, one.high] for one in found], dtype=float)
            yield {
                "quantity": name,
                "seeds": seeds,
                "deviation": deviation,
                "rate": rate,
                "coverage": round(float(((ends[:, 0] <= truth) & (truth <= ends[:, 1])).mean()), 3),
                "width": round(float((ends[:, 1] - ends[:, 0]).mean()), 3),
            }


def _interval(
    generator: np.random.Generator, success: NDArray[np.int8], span: tuple[float, float]
) -> Estimate:
    """Return the interval of the mean of outcomes, or of differences of outcomes, (seeds, episodes)."""
    of_runs = success.mean(axis=1)
    total, seeds = of_runs.sum(), len(of_runs)

    def other_episodes() -> Array:
        # Draws with replacement from each run's outcomes -1, 0 and 1.
        kinds = np.array([-1, 0, 1])
        shares = (success[..., None] == kinds).mean(axis=1)
        episodes = success.shape[1]
        drawn = generator.multinomial(episodes, shares, (500, seeds)) @ kinds
        return np.asarray(drawn.mean(axis=1) / episodes)

    without_one = (total - of_runs) / (seeds - 1) if seeds > 1 else np.zeros(0)
    return interval(float(total / seeds), without_one, other_episodes, span)


# ---- groups ------------------------------------------------------------------------------------------------


def false_splits(generator: np.random.Generator, boards: int) -> Iterator[dict[str, Any]]:
    """Yield the share of boards of equal methods that have more than one group.

    Besides plain boards there are harder ones: runs of every second method vary and other runs do not; one
    method varies three times as much as the others; a third of the rows has only the first seed; all rows
    have only the first seed.
    """
    asked = itertools.product(("equal",), (5, 10, 15), (3, 5, 8), (0.0, 0.05, 0.15))
    harder = itertools.product(("unequal", "ragged"), (10,), (3, 5, 8), (0.05, 0.15))
    loud = itertools.product(("loud",), (10,), (3, 5, 8), (0.05,))
    single = itertools.product(("single",), (10,), (1,), (0.0, 0.05, 0.15))
    for kind, methods, seeds, deviation in track([*asked, *harder, *loud, *single], "false splits"):
        deviations = np.full(methods, deviation)
        if kind == "unequal":
            deviations[::2] = 0.0
        if kind == "loud":
            deviations[0] *= 3
        split = 0
        for _ in range(boards):
            success = outcomes(generator, np.full(methods, 0.5), deviations, seeds)
            split += bool(board_apart(success, single=methods // 3 if kind == "ragged" else 0).any())
        yield {
            "kind": kind,
            "methods": methods,
            "seeds": seeds,
            "deviation": deviation,
            "split": round(split / boards, 3),
        }


def power(generator: np.random.Generator, boards: int) -> Iterator[dict[str, Any]]:
    """Yield the share of the pairs of a better and a worse method that are told apart.

    Five of ten methods are better by a difference, all around a rate of one half.
    """
    cells = list(itertools.product((0.1, 0.2, 0.3), (3, 5, 8), (0.0, 0.05, 0.1)))
    for difference, seeds, deviation in track(cells, "power"):
        rates = np.repeat([0.5 + difference / 2, 0.5 - difference / 2], 5)
        right = 0.0
        for _ in range(boards // 4):
            success = outcomes(generator, rates, np.full(10, deviation), seeds)
            right += float(board_apart(success)[:5, 5:].mean())
        yield {
            "difference": difference,
            "seeds": seeds,
            "deviation": deviation,
            "power": round(right / (boards // 4), 2),
        }


def board_apart(success: Outcomes, single: int = 0) -> NDArray[np.bool_]:
    """Return which methods are told apart by mean success; the first `single` have only one seed."""
    values = success.mean(axis=2)
    values[:single, 1:] = np.nan
    without_episode = (success.sum(axis=2, keepdims=True) - success) / (EPISODES - 1)
    order = np.argsort(-np.nanmean(values, axis=1), kind="stable")
    place = np.argsort(order)
    return told_apart(values[order], without_episode[order])[np.ix_(place, place)]


# ---- committed records -------------------------------------------------------------------------------------


def seed_deviations(records: Path) -> dict[str, dict[str, float]]:
    """Return the deviation between seeds in `records`, beyond the noise of their episodes, for some metrics.

    For each metric: the number of methods with several seeds, the deviation of all of them in the unit of
    `outcomes`, as if the mean rate were one half, and the greatest standard deviation of one method as it is.
    References do not count, because a policy that trains nothing hardly varies; neither do policies that were
    trained elsewhere.
    """
    runs: dict[Path, list[Scores]] = {}
    for path in sorted(records.rglob("*.json")):
        record = read_record(path)
        competes = not record.run.trained_elsewhere and record.run.method not in REFERENCES
        if competes and not record.run.order:
            runs.setdefault(path.parent, []).append(Scores.from_record(record))
    found = {}
    for name in ("retention", "adaptation", "final_average"):
        pairs = [_excess(name, them) for them in runs.values() if len(them) > 1]
        excess, at_half = np.transpose(pairs)
        found[name] = {
            "methods": len(excess),
            "deviation": round(math.sqrt(max(float(excess.sum() / at_half.sum()), 0)), 3),
            "greatest": round(math.sqrt(max(float(excess.max()), 0)), 3),
        }
    return found


def _excess(metric: str, runs: list[Scores]) -> tuple[float, float]:
    """Return the variance of a metric between runs minus the jackknife variance of their episodes.

    The second value is the variance of a success at the mean rate, divided by that at one half.
    """
    values = load_metric(metric).function(rates_of(runs, {}))
    episodes = len(runs[0].layout.episodes)
    weights = (1 - np.eye(episodes)) * episodes / (episodes - 1)
    counts = np.broadcast_to(weights[:, None], (episodes, len(runs[0].layout.tasks), episodes))
    of_episodes = [(episodes - 1) * load_metric(metric).function(run.rates(counts)).var() for run in runs]
    mean = float(values.mean())
    return float(values.var(ddof=1) - np.mean(of_episodes)), 4 * mean * (1 - mean)


# ---- tables ------------------------------------------------------------------------------------------------

Row = dict[str, Any]
"""A row of the results."""
QUANTITIES = ("rate", "difference")
"""Quantities whose intervals are simulated."""
Lines = dict[str, Row]
"""Lines or columns of a table, with the values that a row of the results must have to belong there."""


def tables(results: Row) -> list[str]:
    """Return the tables of docs/guide/statistics.md: coverage thrice, widths, false splits twice, power."""
    equal: Lines = {f"{count} methods": {"kind": "equal", "methods": count} for count in (5, 10, 15)}
    harder: Lines = {
        "runs of every second method differ, others do not": {"kind": "unequal"},
        "one method varies three times as much as the others": {"kind": "loud"},
        "a third of the rows have one seed": {"kind": "ragged"},
        "all rows have one seed": {"kind": "single"},
    }
    differences = {f"difference {size:.1f}": {"difference": size} for size in (0.1, 0.2, 0.3)}
    rates, minus = ([row for row in results["intervals"] if row["quantity"] == name] for name in QUANTITIES)
    middle = [row for row in rates if row["rate"] == 0.5]
    few = [row for row in results["few_episodes"] if row["quantity"] == "rate"]
    splits, pairs = results["false_splits"], results["power"]
    of_rates: Lines = {f"{rate:g}": {"rate": rate} for rate in OTHERS}
    of_pairs: Lines = {f"{rate:g} - {other:g}": {"rate": rate} for rate, other in OTHERS.items()}
    return [
        _table("%", rates, _kinds(rates), of_rates, _coverage),
        _table("%", minus, _kinds(minus), of_pairs, _coverage),
        _table("%", few, _kinds(few), of_rates, _coverage),
        _table("width", middle, _seeds(rates), _deviations(rates), lambda row: f"{row['width']:.2f}"),
        _table("%", splits, equal, _kinds(splits, "equal"), _split),
        _table("%", splits, harder, _kinds(splits, "unequal", "single"), _split),
        _table("%", pairs, differences, _kinds(pairs), lambda row: f"{100 * row['power']:.0f}"),
    ]


def _coverage(row: Row) -> str:
    return f"{100 * row['coverage']:.1f}"


def _split(row: Row) -> str:
    return f"{100 * row['split']:.1f}"


def _plural(seeds: int) -> str:
    return f"{seeds} seeds" if seeds > 1 else "1 seed"


def _seeds(rows: Iterable[Row]) -> Lines:
    return {_plural(count): {"seeds": count} for count in sorted({row["seeds"] for row in rows})}


def _deviations(rows: Iterable[Row]) -> Lines:
    sizes = sorted({row["deviation"] for row in rows})
    return {f"deviation {size:.2f}": {"deviation": size} for size in sizes}


def _kinds(rows: list[Row], *kinds: str) -> Lines:
    """Return a column for each pair of a number of seeds and a deviation in the rows of these kinds."""
    pairs = {(row["seeds"], row["deviation"]) for row in rows if row.get("kind") in (kinds or (None,))}
    return {f"{_plural(a)}, {b:.2f}": {"seeds": a, "deviation": b} for a, b in sorted(pairs)}


def _table(
    corner: str,
    rows: list[Row],
    lines: Lines,
    columns: Lines,
    cell: Callable[[Row], str],
) -> str:
    """Return a Markdown table; a cell shows the row that has the values of its line and column."""
    text = [f"| {' | '.join([corner, *columns])} |", f"| --- |{' --: |' * len(columns)}"]
    for name, line in lines.items():
        cells = []
        for column in columns.values():
            wanted = {**line, **column}.items()
            found = [row for row in rows if wanted <= row.items()]
            cells.append(cell(found[0]) if found else "-")
        text.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(text)


if __name__ == "__main__":
    main()
