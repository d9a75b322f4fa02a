"""The metrics as text: a list, everything about one metric, and the page docs/reference/metrics.md."""

from __future__ import annotations

import inspect
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.text import Text

from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS

LEFT_OUT = {
    "Continual World's RT": "it needs a run for every pair of tasks",
    "the FWT of GEM, Mammoth and Avalanche": "it needs the success of an untrained policy, and stage 0 of a "
    "run of clbench is a pretrained one; if stage 0 of your own table is untrained, it is the mean over the "
    "targets k from 2 of R[k-1][k] - R[0][k]",
    "min-ACC and WC-ACC at every step": "earlier targets are evaluated at the ends of the stages only, and "
    "`minimum_accuracy` and `worst_case_accuracy` say so",
    "windowed forgetting and windowed plasticity": "their window counts evaluations after each step",
    "recovery ratio": "it compares the times of the first and the second learning of a skill, and the first "
    "is part of the pretraining; `relearning_steps` counts the steps of the second",
    "Diaz-Rodriguez's MS, SSS, CE, CL_score and CL_stability": "they need sizes and operations of every "
    "stage, and weights that the paper leaves to the user",
    "COOM's AP": "it needs the earlier targets while later ones are learned",
    "MEAL's two F": "they need the earlier targets while later ones are learned",
    "MEAL's FT": "its ratio to the baseline has no value where learning from scratch fails, and how to "
    "combine seeds is not settled here; `forward_transfer` is Continual World's",
    "NBT of ReGen and the normalised NBT of arXiv 2603.03818": "which stages and tasks they average, and "
    "what stands for a success of 0, is not settled",
    "CLARE's and LifeLong-RFT's FWT": "it is the mean of R[k][k], our `adaptation`",
    "Sequoia's score": "it needs online performance and a cap on the run time",
}
"""Published definitions that clbench leaves out, and why."""


def span(metric: Metric) -> str:
    """Return the range of possible values."""
    return f"{metric.low:g} to {metric.high:g}"


def facts(metric: Metric) -> dict[str, str]:
    """Return the facts about a metric by title."""
    seeds = "geometric mean over seeds" if metric.ratio else "mean over seeds"
    return {
        "Formula": metric.formula,
        "Source": metric.source,
        "Version": str(metric.version),
        "Direction": metric.direction,
        "Range": span(metric),
        "Units": metric.units,
        "Compared with": ", ".join(metric.references) or "nothing",
        "Seeds": "averaged over seeds first, then computed once" if metric.pooled else seeds,
        "None means": metric.missing,
    }


def remarks(metric: Metric) -> str:
    """Return the docstring of a metric without its first line."""
    return inspect.cleandoc(metric.function.__doc__ or "").partition("\n")[2].strip()


def text(metric: Metric) -> str:
    """Return everything about a metric as plain text."""
    lines = [
        metric.name,
        metric.description,
        "",
        *(f"{key}: {value}" for key, value in facts(metric).items()),
    ]
    more = remarks(metric)
    return "\n".join([*lines, *(["", more] if more else [])]) + "\n"


def listing() -> Group:
    """Return all metrics for the terminal, in lines that fit any width."""
    lines: list[RenderableType] = []
    for metric in METRICS.values():
        lines.append(Text.assemble((metric.name, "bold"), f": {metric.direction}, {span(metric)}"))
        lines.append(Padding(Text(f"{metric.description} Source: {metric.source}."), (0, 0, 0, 4)))
    return Group(*lines)


def page() -> str:
    """Return docs/reference/metrics.md. The same registry gives the same bytes."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,  # Markdown, whose marks `escaped` escapes
    )
    environment.filters["escaped"] = escaped
    template = environment.get_template("metrics.md.jinja")
    return template.render(metrics=METRICS.values(), facts=facts, remarks=remarks, left_out=LEFT_OUT)


def escaped(words: str) -> str:
    """Escape the characters that Markdown takes for links, emphasis and cells of a table."""
    for mark in "[]*|":
        words = words.replace(mark, f"\\{mark}")
    return words
