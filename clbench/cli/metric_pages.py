"""The registry of the metrics as text: a table, all about one, and the page docs/reference/metrics.md."""

from __future__ import annotations

import inspect

from rich.table import Table

from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS

WIDTH = 150
"""Least width of the table: in a narrower one names would be torn apart, and a long line only wraps."""

NOT_HERE = {
    "Continual World's RT": "it needs a run for every pair of tasks",
    "the FWT of GEM, Mammoth and Avalanche": "it needs the success of an untrained network, which nobody "
    "evaluates",
    "min-ACC and WC-ACC at every step": "earlier targets are evaluated at the ends of the stages only, and "
    "`minimum_accuracy` and `worst_case_accuracy` say so",
    "windowed forgetting and windowed plasticity": "their window is counted in evaluations after each step",
    "recovery ratio": "no task is learned a second time, so that there is no relearning to time",
    "Diaz-Rodriguez's MS, SSS, CE, CL_score and CL_stability": "they need sizes and operations of every "
    "stage, and weights that the paper leaves to the user",
    "COOM's AP": "it needs the earlier targets while later ones are learned",
    "MEAL's two F": "they need the earlier targets while later ones are learned",
    "MEAL's FT": "its ratio by the baseline has no value where learning from scratch fails, and how seeds "
    "enter it is not settled here; `forward_transfer` is Continual World's",
    "NBT of ReGen and the normalised NBT of arXiv 2603.03818": "which stages and tasks they average, and "
    "what stands for a success of 0, is not settled",
    "CLARE's and LifeLong-RFT's FWT": "it is the mean of R[k][k], our `adaptation`",
    "Sequoia's score": "it needs online performance and a cap on the run time",
}
"""Published definitions that are left out, and why."""


def direction(metric: Metric) -> str:
    """Return which way is better."""
    return {True: "higher is better", False: "lower is better", None: "neither is better"}[
        metric.higher_is_better
    ]


def span(metric: Metric) -> str:
    """Return the least and the greatest possible value."""
    return f"{metric.low:g} to {metric.high:g}"


def facts(metric: Metric) -> dict[str, str]:
    """Return all about a metric, by title."""
    seeds = "averaged before it is computed" if metric.pooled else "the mean of their values"
    return {
        "Formula": metric.formula,
        "Source": metric.source,
        "Version": str(metric.version),
        "Direction": direction(metric),
        "Range": span(metric),
        "Units": metric.units,
        "References": ", ".join(metric.references) or "none",
        "Seeds": seeds,
        "None means": metric.missing,
    }


def remarks(metric: Metric) -> str:
    """Return what its docstring says after the first line."""
    return inspect.cleandoc(metric.function.__doc__ or "").partition("\n")[2].strip()


def text(metric: Metric) -> str:
    """Return all about a metric as plain text."""
    lines = [
        metric.name,
        metric.description,
        "",
        *(f"{key}: {value}" for key, value in facts(metric).items()),
    ]
    more = remarks(metric)
    return "\n".join([*lines, *(["", more] if more else [])]) + "\n"


def table() -> Table:
    """Return all metrics as a table of the terminal."""
    grid = Table(title="Metrics")
    for column in ("name", "version", "direction", "range", "source", "what it tells"):
        grid.add_column(column, overflow="fold", no_wrap=column in ("name", "direction", "range"))
    for metric in METRICS.values():
        grid.add_row(
            metric.name,
            str(metric.version),
            direction(metric),
            span(metric),
            metric.source,
            metric.description,
        )
    return grid


def page() -> str:
    """Return docs/reference/metrics.md. The same registry gives the same bytes."""
    lines = [
        "# Metrics",
        "",
        "Made by `clbench metrics --markdown docs/reference/metrics.md` from the registry.",
        "",
        "R[l][s] is the success rate on task s at the end of stage l, stage 0 is the pretrained policy, "
        "target k is learned in stage k, and K is the last stage. `None`, an empty field of the table, "
        "stands where there is no value; it is never 0.",
        "",
    ]
    lines += [f"- [{name}](#{name}): {_escaped(metric.description)}" for name, metric in METRICS.items()]
    for metric in METRICS.values():
        lines += ["", f"## {metric.name}", "", _escaped(metric.description), ""]
        lines += [f"- **{key}**: {_escaped(value)}" for key, value in facts(metric).items()]
        more = remarks(metric)
        lines += ["", _escaped(more)] if more else []
    lines += ["", "## Not here, and why", ""]
    lines += [f"- {_escaped(name)}: {_escaped(why)}." for name, why in NOT_HERE.items()]
    return "\n".join(lines) + "\n"


def _escaped(words: str) -> str:
    """Return `words` so that Markdown does not take its brackets and stars for marks."""
    for mark in "[]*|":
        words = words.replace(mark, f"\\{mark}")
    return words
