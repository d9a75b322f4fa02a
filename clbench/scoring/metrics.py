"""All metrics by name, and their values for a run."""

from __future__ import annotations

import math
from collections.abc import Mapping

from clbench.base.entry_points import unknown
from clbench.base.errors import UnknownNameError
from clbench.scoring import ours, published  # noqa: F401 - each enters its metrics into the registry
from clbench.scoring.metric import REGISTRY, Metric
from clbench.scoring.scores import Scores, rates_of

METRICS: Mapping[str, Metric] = REGISTRY
"""All metrics by name, in the order of the columns of leaderboard.csv."""

TITLES = {"adaptation": "learned", "retention": "kept skills"}
"""Titles of metrics on boards with a criterion, where they are beside `kept` and `kept_targets`."""

_AVERAGES = ("final_average", "performance_continual_world", "average_incremental_accuracy")
_FORGETTING = (
    "forgetting",
    "forgetting_chaudhry",
    "forgetting_mammoth",
    "forgetting_avalanche",
    "forgetting_continual_world",
)
_FORWARD = ("forward_transfer", "forward_transfer_libero", "forward_transfer_diaz_rodriguez")
_NEGATIVE = (
    "negative_backward_transfer_libero",
    "negative_backward_transfer_clare",
    "negative_backward_transfer_arfm",
    "forgetting_avalanche",
)
USUAL_NAMES: Mapping[str, tuple[str, ...]] = {
    "acc": ("performance_continual_world",),
    "average_accuracy": ("performance_continual_world",),
    "final_average_accuracy": ("performance_continual_world",),
    "accuracy": (*_AVERAGES, "accuracy_diaz_rodriguez"),
    "aia": ("average_incremental_accuracy",),
    "auc": ("area_under_curve_libero",),
    "average_forgetting": _FORGETTING,
    "forgetting_measure": ("forgetting_chaudhry",),
    "fm": ("forgetting_chaudhry",),
    "bwt": ("backward_transfer", "backward_transfer_diaz_rodriguez"),
    "bwt+": ("positive_backward_transfer_diaz_rodriguez",),
    "fwt": _FORWARD,
    "nbt": _NEGATIVE,
    "negative_backward_transfer": _NEGATIVE,
    "learning_accuracy": ("adaptation",),
    "plasticity": ("adaptation", "intransigence"),
    "min_acc": ("minimum_accuracy",),
    "wc_acc": ("worst_case_accuracy",),
    "rem": ("remembering_diaz_rodriguez",),
    "zs": ("zero_shot",),
}
"""Names that papers use, in lower case, with the metrics that they may mean."""


def load_metric(name: str) -> Metric:
    """Return the metric with this name, with this title on the board, or with this name in papers.

    Spaces and hyphens count as underscores, and capitals as small letters.

    Raises:
        UnknownNameError: No metric has this name, and the message names the nearest one; or papers use the
            name for several metrics, and the message names them.
    """
    titles = {title.replace(" ", "_"): one for one, title in TITLES.items()}
    wanted = name.lower().replace(" ", "_").replace("-", "_")
    wanted = titles.get(wanted, wanted)
    if wanted in METRICS:
        return METRICS[wanted]
    candidates = USUAL_NAMES.get(wanted, ())
    if len(candidates) > 1:
        raise UnknownNameError(
            f"{name!r} has several definitions: {', '.join(candidates)}. Name one of them; "
            "docs/reference/metrics.md says what each is, and which are left out."
        )
    if not candidates:
        raise unknown("metric", name, METRICS)
    return METRICS[candidates[0]]


def measure(name: str, scores: Scores, references: Mapping[str, Scores] | None = None) -> float | None:
    """Return the value of a metric for one run, None if something that it needs is missing.

    Args:
        name: Name of the metric.
        scores: The run.
        references: Runs of reference methods with the same scenario and seed, by the method's name.
    """
    rates = rates_of([scores], {key: [run] for key, run in (references or {}).items()})
    value = float(load_metric(name).over_runs(rates))
    return value if math.isfinite(value) else None
