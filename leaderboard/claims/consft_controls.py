"""The controls of ConSFT: the method without its ingredient, and what each says about a gain."""

from __future__ import annotations

from collections.abc import Sequence

from .claim import not_told_apart
from .evidence import Evidence, Figure, rung
from .figures import SCENARIO_RATE, retention_difference

CONTROLS = {
    "constant_weight": (
        "weighing single samples need not be what keeps skills",
        "the weights of single samples may matter",
    ),
    "shuffled_weights": (
        "it need not matter which samples get small weights",
        "it may matter which samples get small weights",
    ),
    "finch": (
        "a learning rate that follows the loss may suffice",
        "a learning rate that follows the loss does not suffice",
    ),
}
"""Controls of ConSFT: what follows if one is not told apart from it, and what if one is worse."""


def controls_of(evidence: Evidence, arm: str) -> tuple[Figure, ...]:
    """Return the gains in retained success over the controls: two of consft_calibrated, and one of `arm`."""
    first = [
        retention_difference(evidence, "consft_calibrated", name)
        for name in ("constant_weight", "shuffled_weights")
    ]
    return (*first, retention_difference(evidence, arm, "finch"))


def sft_at_the_rate_of(evidence: Evidence, arm: str) -> tuple[str, ...]:
    """Return the label of sft at the arm's learning rate, if tuning chose another for sft and runs exist."""
    runs = [evidence.first_run(label) for label in (arm, "sft")]
    factors = [run.record.run.settings.get("step_factor", SCENARIO_RATE) for run in runs if run is not None]
    if len(factors) < len(runs) or factors[0] == factors[1]:
        return ()
    label = rung("sft", factors[0])
    return (label,) if label in evidence.runs else ()


def controls_at_the_full_rate(evidence: Evidence) -> tuple[Figure, ...]:
    """Return the gains of consft_calibrated over two controls at the scenario's rate, if runs exist."""
    labels = [f"{name}+step_factor={SCENARIO_RATE}" for name in ("constant_weight", "shuffled_weights")]
    arm = rung("consft_calibrated", SCENARIO_RATE)
    return tuple(retention_difference(evidence, arm, label) for label in labels if label in evidence.runs)


def what_the_full_rate_says(gain: Figure, controls: Sequence[Figure]) -> list[str]:
    """Return in a sentence what an arm gains at the scenario's learning rate, and what the controls say."""
    if not gain.low > 0:
        return []
    said = f"At the scenario's learning rate, {gain.methods[0]} keeps {gain.value:.2f} more than sft"
    for one in controls:
        name = one.methods[1].partition("+")[0]
        explains, does_not = CONTROLS[name]
        said += f"; {not_told_apart(one, name, explains=explains, does_not=does_not).rstrip('.')}"
    return [f"{said}."]


def what_controls_say(gain: Figure, figures: Sequence[Figure], arms: Sequence[str]) -> list[str]:
    """Return what the controls of the arms that count say about a gain over sft, if there is one."""
    method, other = gain.methods[:2]
    if gain.is_unknown:
        return [f"The records cannot show whether {method} keeps more than {other}."]
    if gain.low <= 0:
        return [f"{method} does not certainly keep more than {other}: there is no gain to explain."]
    says = [(one, *CONTROLS[one.methods[1]]) for one in figures if one.methods[0] in arms]
    return [not_told_apart(figure, explains=yes, does_not=no) for figure, yes, no in says]
