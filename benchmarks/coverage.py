"""Coverage of the intervals and false splits of the ranks, simulated in minutes.

Run `python benchmarks/coverage.py`.

The model mimics a row of the benchmark. A run's success rate on a task is, on the scale of the logit,

    the method's level + the task's effect + the seed's, shared by all methods + the run's own

The last two are normal, and the same for all tasks of a run. Their standard deviation is stated for a rate of
one half; it is 4 times as large on the scale of the logit. An episode succeeds if its luck is below the rate.
Half of the variance of luck belongs to the initial state, which all methods share. Draws are seeded, so that
the result is the same each time.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from clbench.records.paths import RECORDS
from clbench.records.reader import read_record
from clbench.scoring.intervals import Estimate, interval
from clbench.scoring.layout import Array
from clbench.scoring.metrics import load_metric
from clbench.scoring.ranks import ranks
from clbench.scoring.scores import Scores, rates_of

RESULTS = Path(__file__).parent / "results" / "coverage.json"
EPISODES = 20
ROOT = math.sqrt(0.5)
"""Weight of each half of a variance."""
SKILLS, TRAINED = 6, 9
"""Tasks in retention, and in the final average of a board."""
Outcomes = NDArray[np.bool_]
"""Success of episodes, (methods, seeds, tasks, episodes)."""


def main() -> None:
    """Simulate, print the tables of docs/guide/statistics.md and write results/coverage.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--simulations", type=int, default=1500, help="rows for each interval")
    parser.add_argument("--boards", type=int, default=1000, help="boards for each kind of board")
    arguments = parser.parse_args()
    generator = np.random.default_rng(0)
    of_records = seed_deviations(RECORDS / "Fetch-v0")
    results = {
        "simulations": arguments.simulations,
        "boards": arguments.boards,
        "intervals": list(interval_coverage(generator, arguments.simulations)),
        "false_splits": list(false_splits(generator, arguments.boards)),
        "power": list(power(generator, arguments.boards)),
        "records": of_records,
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

_PLACES = np.linspace(-6, 6, 12001)
_BELOW = np.array([NormalDist().cdf(place) for place in _PLACES])


def outcomes(
    generator: np.random.Generator, levels: Array, deviations: Array, shared: float, shape: tuple[int, int]
) -> Outcomes:
    """Return the outcomes of methods.

    Args:
        generator: Source of the draws.
        levels: The methods' levels, (methods,).
        deviations: Standard deviations of their runs' own effects, (methods,).
        shared: Standard deviation of the effects that all methods share.
        shape: Number of seeds and of tasks.
    """
    methods, seeds = len(levels), shape[0]
    effects = levels[:, None] + 4 * deviations[:, None] * generator.standard_normal((methods, seeds))
    effects += 4 * shared * generator.standard_normal(seeds)
    luck = generator.standard_normal((methods, *shape, EPISODES))
    luck = ROOT * (luck + generator.standard_normal((*shape, EPISODES)))
    rates = _rate(effects[..., None] + _of_tasks(shape[1]))
    return np.asarray(luck < np.interp(rates, _BELOW, _PLACES)[..., None])


def level_of(rate: float, deviation: float, tasks: int) -> float:
    """Return the level that gives a mean rate of `rate` over seeds and tasks."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(61)
    low, high = -15.0, 15.0
    for _ in range(60):
        middle = (low + high) / 2
        means = _rate(middle + 4 * deviation * nodes[:, None] + _of_tasks(tasks)).mean(axis=1)
        low, high = (middle, high) if weights @ means < rate * weights.sum() else (low, middle)
    return low


def _of_tasks(tasks: int) -> Array:
    return np.linspace(-0.5, 0.5, tasks)


def _rate(logit: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-logit)))


# ---- intervals ---------------------------------------------------------------------------------------------


def interval_coverage(generator: np.random.Generator, simulations: int) -> Iterator[dict[str, Any]]:
    """Yield the coverage of the intervals of a rate, and of its difference to another rate.

    With one seed the truth is the rate of this run, so that seeds do not differ.
    """
    deviations = {1: (0.0,)}
    cells = [
        (seeds, deviation, rate)
        for seeds in (1, 2, 3, 5, 10)
        for deviation in deviations.get(seeds, (0.0, 0.05, 0.1, 0.15))
        for rate in (0.1, 0.5, 0.9, 0.98)
    ]
    for seeds, deviation, rate in track(cells, "intervals"):
        other = rate - 0.2 if rate > 0.5 else rate + 0.2
        levels = np.array([level_of(one, deviation, SKILLS) for one in (rate, other)])
        # Seeds are independent: the seeds of all simulations are drawn at once.
        shape = (simulations * seeds, SKILLS)
        success = outcomes(generator, levels, np.full(2, ROOT * deviation), ROOT * deviation, shape)
        for name, weights, truth, span in (
            ("rate", np.array([1.0, 0.0]), rate, (0, 1)),
            ("difference", np.array([1.0, -1.0]), rate - other, (-1, 1)),
        ):
            found = [
                _interval(generator, one, weights, span) for one in np.split(success, simulations, axis=1)
            ]
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
    generator: np.random.Generator, success: Outcomes, weights: Array, span: tuple[float, float]
) -> Estimate:
    """Return the interval of a weighted sum of the methods' mean success."""
    of_episodes = np.tensordot(weights, success, 1)
    of_runs = of_episodes.mean(axis=(1, 2))
    total, seeds = of_runs.sum(), len(of_runs)

    def other_episodes() -> Array:
        drawn = generator.integers(EPISODES, size=(500, of_episodes.size // EPISODES, EPISODES))
        drawn += np.arange(drawn.shape[1])[:, None] * EPISODES
        return np.asarray(of_episodes.ravel()[drawn.reshape(len(drawn), -1)].mean(axis=1))

    without_one = (total - of_runs) / (seeds - 1) if seeds > 1 else np.zeros(0)
    return interval(float(total / seeds), without_one, other_episodes, span)


# ---- tie groups --------------------------------------------------------------------------------------------


def false_splits(generator: np.random.Generator, boards: int) -> Iterator[dict[str, Any]]:
    """Yield the share of boards of equal methods that have more than one group.

    Besides plain boards there are harder ones: runs of every second method vary and other runs do not; a
    third of the rows has only the first seed; all rows have only the first seed.
    """
    asked = itertools.product(("equal",), (5, 10, 15), (3, 5), (0.0, 0.05, 0.15))
    harder = itertools.product(("unequal", "ragged"), (10,), (3, 5), (0.05, 0.15))
    single = itertools.product(("single",), (5, 10, 15), (1,), (0.0, 0.05, 0.15))
    for kind, methods, seeds, deviation in track([*asked, *harder, *single], "false splits"):
        own = np.full(methods, deviation)
        if kind == "unequal":
            own[::2] = 0.0
        split = 0
        for _ in range(boards):
            success = outcomes(generator, np.zeros(methods), own, deviation, (seeds, TRAINED))
            found = board_ranks(success, single=methods // 3 if kind == "ragged" else 0)
            split += bool(found.max() > 1)
        yield {
            "kind": kind,
            "methods": methods,
            "seeds": seeds,
            "deviation": deviation,
            "split": round(split / boards, 3),
        }


def power(generator: np.random.Generator, boards: int) -> Iterator[dict[str, Any]]:
    """Yield the share of the pairs of a better and a worse method that have ranks in the right order.

    Five of ten methods are better by a difference, all around a rate of one half.
    """
    cells = list(itertools.product((0.15, 0.2, 0.3), (3, 5), (0.0, 0.05, 0.1)))
    for difference, seeds, deviation in track(cells, "power"):
        rates = [0.5 + difference / 2, 0.5 - difference / 2]
        total = math.hypot(deviation, deviation)
        levels = np.repeat([level_of(rate, total, TRAINED) for rate in rates], 5)
        right = 0.0
        for _ in range(boards // 4):
            success = outcomes(generator, levels, np.full(10, deviation), deviation, (seeds, TRAINED))
            found = board_ranks(success)
            right += float((found[:5, None] < found[None, 5:]).mean())
        yield {
            "difference": difference,
            "seeds": seeds,
            "deviation": deviation,
            "power": round(right / (boards // 4), 2),
        }


def board_ranks(success: Outcomes, single: int = 0) -> NDArray[np.int64]:
    """Return the ranks of methods by mean success, (methods,); the first `single` have only one seed."""
    values = success.mean(axis=(2, 3))
    values[:single, 1:] = np.nan
    without_episode = (success.sum(axis=3, keepdims=True) - success).mean(axis=2) / (EPISODES - 1)
    order = np.argsort(-np.nanmean(values, axis=1), kind="stable")
    found = np.empty(len(values), dtype=np.int64)
    found[order] = ranks(values[order], without_episode[order])
    return found


# ---- committed records -------------------------------------------------------------------------------------


def seed_deviations(records: Path) -> dict[str, dict[str, float]]:
    """Return the deviation between seeds in `records`, beyond the noise of their episodes, for some metrics.

    For each metric: the number of methods with several seeds, and the root mean square and the greatest of
    their standard deviations.
    """
    runs: dict[Path, list[Scores]] = {}
    for path in sorted(records.rglob("*.json")):
        record = read_record(path)
        if not record.run.order:
            runs.setdefault(path.parent, []).append(Scores.from_record(record))
    found = {}
    for name in ("retention", "adaptation", "final_average"):
        excess = np.array([_excess(name, them) for them in runs.values() if len(them) > 1])
        found[name] = {
            "methods": len(excess),
            "root_mean_square": round(math.sqrt(max(float(excess.mean()), 0)), 3),
            "greatest": round(math.sqrt(max(float(excess.max()), 0)), 3),
        }
    return found


def _excess(metric: str, runs: list[Scores]) -> float:
    """Return the variance of a metric between runs less the jackknife variance of their episodes."""
    values = load_metric(metric).function(rates_of(runs, {}))
    episodes = len(runs[0].layout.episodes)
    weights = (1 - np.eye(episodes)) * episodes / (episodes - 1)
    counts = np.broadcast_to(weights[:, None], (episodes, len(runs[0].layout.tasks), episodes))
    of_episodes = [(episodes - 1) * load_metric(metric).function(run.rates(counts)).var() for run in runs]
    return float(values.var(ddof=1) - np.mean(of_episodes))


# ---- tables ------------------------------------------------------------------------------------------------

Row = dict[str, Any]
"""A row of the results."""
Lines = dict[str, Row]
"""Lines or columns of a table, with the values that a row of the results must have to belong there."""


def tables(results: Row) -> list[str]:
    """Return the tables of docs/guide/statistics.md: coverage, widths, false splits twice, power."""
    seeds = {_seeds(count): {"seeds": count} for count in (1, 2, 3, 5, 10)}
    deviations = {f"deviation {size:.2f}": {"deviation": size} for size in (0.0, 0.05, 0.1, 0.15)}
    equal: Lines = {f"{count} methods": {"kind": "equal", "methods": count} for count in (5, 10, 15)}
    harder: Lines = {
        "runs of every second method differ, others do not": {"kind": "unequal"},
        "a third of the rows have one seed": {"kind": "ragged"},
        "all rows have one seed": {"kind": "single", "methods": 10},
    }
    differences = {f"difference {size:.2f}": {"difference": size} for size in (0.15, 0.2, 0.3)}
    middle = [row for row in results["intervals"] if row["quantity"] == "rate" and row["rate"] == 0.5]
    splits, pairs = results["false_splits"], results["power"]
    return [
        _table("%", results["intervals"], seeds, deviations, _coverages),
        _table("width", middle, seeds, deviations, lambda found: f"{found[0]['width']:.2f}"),
        _table("%", splits, equal, _kinds(splits, "equal"), lambda found: _per_cent(found[0]["split"])),
        _table(
            "%",
            splits,
            harder,
            _kinds(splits, "unequal", "single"),
            lambda found: _per_cent(found[0]["split"]),
        ),
        _table("%", pairs, differences, _kinds(pairs), lambda found: f"{100 * found[0]['power']:.0f}"),
    ]


def _seeds(count: int) -> str:
    return f"{count} seeds" if count > 1 else "1 seed"


def _per_cent(share: float) -> str:
    return f"{100 * share:.1f}"


def _coverages(found: list[Row]) -> str:
    shares = [row["coverage"] for row in found]
    return f"{_per_cent(min(shares))} to {_per_cent(max(shares))}"


def _kinds(rows: list[Row], *kinds: str) -> Lines:
    """Return a column for each pair of a number of seeds and a deviation in the rows of these kinds."""
    pairs = {(row["seeds"], row["deviation"]) for row in rows if row.get("kind") in (kinds or (None,))}
    return {f"{_seeds(a)}, {b:.2f}": {"seeds": a, "deviation": b} for a, b in sorted(pairs)}


def _table(
    corner: str,
    rows: list[Row],
    lines: Lines,
    columns: Lines,
    cell: Callable[[list[Row]], str],
) -> str:
    """Return a Markdown table; a cell shows the rows that have the values of its line and column."""
    text = [f"| {' | '.join([corner, *columns])} |", f"| --- |{' --: |' * len(columns)}"]
    for name, line in lines.items():
        cells = []
        for column in columns.values():
            wanted = {**line, **column}.items()
            found = [row for row in rows if wanted <= row.items()]
            cells.append(cell(found) if found else "-")
        text.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(text)


if __name__ == "__main__":
    main()
