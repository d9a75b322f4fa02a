"""How numbers, intervals and names are written, and which metrics the tables have.

The same rows give the same bytes: no date, no absolute path, fixed digits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from clbench.base.text import counted, printable
from clbench.records.paths import table_parts
from clbench.scoring.intervals import Estimate
from clbench.scoring.metric import Metric
from clbench.scoring.metrics import METRICS, TITLES
from clbench.scoring.scores import WEAK, WEAK_WARNING
from clbench.spec.policies import DEFAULT_POLICY

from ..board.agreement import Concordance, Prediction, RankCorrelation
from ..board.certainty import TiedGain, side_of_zero
from ..board.rows import Row, standing_of
from ..board.summary import GAIN, REFERENCE, RowSummary
from ..board.tiers import TIERS

FIXED = (
    "final_average",
    "adaptation",
    "retention",
    "perturbed_retention",
    "forgetting",
    "forward_transfer",
    "question_retention",
    "zero_shot",
)
"""Metrics in the tables of scenarios whose stages have a fixed number of steps; the CSV file has all."""

TO_CRITERION = (
    "final_average",
    "gain",
    "adaptation",
    "perturbed_adaptation",
    "retention",
    "perturbed_retention",
    "kept_targets",
    "kept",
    "kept_share",
    "criterion_met",
    "steps_to_criterion",
    "speed",
    "question_retention",
    "instruction_capture",
    "relearning_steps",
)
"""Metrics in the tables of scenarios whose stages end when the target is learned."""

FITTING_FIXED = (
    "final_average",
    "adaptation",
    "retention",
    "forgetting",
    "forward_transfer",
    "question_retention",
)
"""Metrics of `FIXED` in a terminal of 108 columns."""

FITTING_TO_CRITERION = ("final_average", "gain", "adaptation", "retention", "kept")
"""Metrics of `TO_CRITERION` in a terminal of 108 columns."""

NAMED = 3
"""Number of methods that a sentence names; further ones are only counted."""

MISSING = "-"
"""Text for a value that could not be computed."""


@dataclass(frozen=True)
class Column:
    """A metric in a table."""

    metric: Metric
    """The metric."""
    title: str
    """Head of the column."""

    @property
    def form(self) -> str:
        """Format of its values. A gain, which is a difference, has its sign."""
        if self.metric.name == GAIN:
            return "+.2f"
        return ".0f" if self.metric.units == "optimiser steps" else ".2f"


def shown(rows: Sequence[RowSummary]) -> tuple[Column, ...]:
    """Return the columns of a table: the metrics of its kind of scenario that any of `rows` has."""
    to_criterion = _to_criterion(rows)
    names = TO_CRITERION if to_criterion else FIXED
    found = {name for name in METRICS if any(row.estimates[name].value is not None for row in rows)}
    return tuple(Column(METRICS[name], column_title(name, to_criterion)) for name in names if name in found)


def column_title(name: str, to_criterion: bool) -> str:
    """Return the title of a metric in the tables of a scenario.

    Args:
        name: Name of the metric.
        to_criterion: Whether the stages of the scenario end when the target is learned.
    """
    return (TITLES if to_criterion else {}).get(name) or title_of(name)


def fitting(rows: Sequence[RowSummary]) -> tuple[Column, ...]:
    """Return the columns of `rows` that fit into a terminal of 108 columns."""
    names = fitting_names(rows)
    return tuple(one for one in shown(rows) if one.metric.name in names)


def fitting_names(rows: Sequence[RowSummary]) -> tuple[str, ...]:
    """Return the metrics of such columns, including those for which no row has a value."""
    return FITTING_TO_CRITERION if _to_criterion(rows) else FITTING_FIXED


def _to_criterion(rows: Sequence[RowSummary]) -> bool:
    return bool(rows) and all(row.to_criterion for row in rows)


def table_title(table: str) -> str:
    """Return the short name of a table: "Fetch-v1, discrete diffusion"."""
    scenario, policy = table_parts(table)
    name = printable(scenario.removeprefix("clbench/"))
    return name if policy == DEFAULT_POLICY else f"{name}, {printable(title_of(policy))}"


def start_text(rate: float | None) -> str:
    """Return a sentence on what the pretrained policy can do, with a warning if it has little to forget.

    Args:
        rate: The policy's mean success on its skills. If it is None, because no row begins with the
            pretrained policy or no skill is retained, the sentence is empty.
    """
    if rate is None:
        return ""
    sentence = f"The pretrained policy has a success rate of {number_text(rate, '.2f')} on its skills."
    return sentence if rate >= WEAK else f"{sentence} {WEAK_WARNING}"


def machine_text(machine: str | None) -> str:
    """Return a sentence on a table that must not be compared with others; see `Summary.machines`."""
    if not machine:
        return ""
    return (
        f"All these records were made on {machine}, where the simulators behave differently than on "
        "x86-64: compare these records only with one another, not with the published board."
    )


def unpaired_text(found: Mapping[str, Sequence[int]] | None) -> str:
    """Return a sentence on methods whose runs did not begin like plain fine-tuning; empty if all did.

    Args:
        found: See `Summary.unpaired`.
    """
    if not found:
        return ""
    names = "; ".join(f"{method} (seeds {', '.join(map(str, seeds))})" for method, seeds in found.items())
    return (
        f"These runs started from a different pretrained policy than sft's: {names}. Their gain therefore "
        "compares runs that do not match. To fix this, run sft and these methods on one machine with a new "
        "--records folder."
    )


def agreement_text(found: Concordance | None) -> str:
    """Return a sentence on how alike the seeds order the methods; empty if it is not known."""
    if found is None:
        return ""
    alike = f"the {found.seeds} seeds agree on the order of the {found.rows} methods (without controls)"
    words = f"Kendall's W {found.w:.2f}, {chance_text(found.chance)}"
    if found.certain:
        return f"{alike[0].upper()}{alike[1:]} more than chance would explain: {words}."
    return f"It is not certain that {alike}: {words}."


def chance_text(chance: float) -> str:
    """Return a p-value."""
    return f"p = {chance:.2g}" if chance >= 0.001 else "p < 0.001"


def prediction_text(found: Sequence[Prediction]) -> str:
    """Return a sentence on what predicts forgetting among the methods; empty if nothing is known."""
    if not found:
        return ""
    words = {1: "", 0: " (not certain)", -1: " (in the opposite order)"}
    parts = [f"{one.predictor} {tau_text(one)}, {one.rows} methods{words[one.direction]}" for one in found]
    return (
        "Rank correlation (Kendall's tau) with the share that a method forgets in a stage: "
        f"{'; '.join(parts)}."
    )


def tau_text(found: RankCorrelation) -> str:
    """Return Kendall's tau with its range over redrawn seeds and the probability of chance."""
    ends = " to ".join(number_text(end, ".2f") for end in (found.low, found.high))
    return f"{number_text(found.tau, '.2f')}, {ends} with redrawn seeds, {chance_text(found.chance)}"


def title_of(name: str) -> str:
    """Return the title of a metric or a cost."""
    return name.replace("_", " ")


def number_text(value: float | None, form: str, missing: str = MISSING) -> str:
    """Return `value` in the format `form`. It is rounded twice, to hide the last bit of a sum."""
    if value is None:
        return missing
    text = format(round(value, 9), form)
    return text if text.strip("+-0.") else text.lstrip("+-")


def format_interval(estimate: Estimate, form: str = ".2f") -> str:
    """Return a value with its interval, if it has one: "0.14 [0.08, 0.22]"."""
    value, low, high = (number_text(one, form) for one in (estimate.value, estimate.low, estimate.high))
    return value if estimate.low is None else f"{value} [{low}, {high}]"


def format_over_seeds(estimate: Estimate, form: str = ".2f") -> str:
    """Return a value with its interval, if the interval describes other seeds: that of one seed does not."""
    return format_interval(estimate if estimate.of_seeds else Estimate(estimate.value, None, None), form)


def aligned(letters: str | None, rows: Iterable[RowSummary]) -> str:
    """Return the letters of a row, each in the column of its group: "a", "ab" and " b" below each other.

    Args:
        letters: Letters of the row.
        rows: All rows of its scenario and division.
    """
    every = sorted({letter for row in rows for letter in row.letters or ""})
    return "".join(letter if letter in letters else " " for letter in every) if letters else ""


def standing_text(row: Row, rows: Iterable[Row], named: int | None = None) -> str:
    """Return the place of a row in its division, and the methods that are not told apart from it.

    Args:
        row: The row.
        rows: All rows of its scenario.
        named: Number of methods that are named; further ones are only counted.
    """
    standing = standing_of(row, rows)
    if standing is None:
        return "a reference does not compete" if row.division == REFERENCE else "no final average"
    shown = list(standing.alike[:named])
    if len(standing.alike) > len(shown):
        shown.append(f"{len(standing.alike) - len(shown)} more")
    text = f"place {standing.place} of {standing.count}"
    if standing.alike:
        return f"{text}; not told apart from {', '.join(shown)}"
    others = {1: "", 2: "; told apart from the other one of its division"}
    return text + others.get(standing.count, "; told apart from the others of its division")


def tier_text(row: Row) -> str:
    """Return the tier of a row and the number of runs above it: "self-reported; 1 of 12 runs retrained"."""
    higher = _higher([row], " runs")
    return f"{row.tier}; {higher}" if higher else row.tier


def tiers_text(rows: Sequence[Row]) -> str:
    """Return a sentence on the runs that reached a higher tier than their row; empty if there is none."""
    higher = _higher(rows)
    return f"A row has the lowest tier of its runs. Runs with a higher tier: {higher}." if higher else ""


def _higher(rows: Sequence[Row], unit: str = "") -> str:
    """Return the number of runs with each tier above that of their row: "7 of 216 replayed, 18 retrained"."""
    reached = Counter(run.tier for row in rows for run in row.runs if run.tier != row.tier)
    of_all = f" of {sum(len(row.runs) for row in rows)}{unit}"
    found = [tier for tier in TIERS if reached[tier]]
    return ", ".join(f"{reached[tier]}{of_all if tier == found[0] else ''} {tier}" for tier in found)


def scaled(count: float) -> tuple[str, str]:
    """Return a number in three digits and the prefix of its unit: 1234.0 is ("1.23", "k")."""
    units = ("", "k", "M", "G", "T")
    digits = [float(f"{count / 1000**power:.3g}") for power in range(len(units))]
    # The rounded number decides: 999.9 k is 1 M.
    power = next((power for power, value in enumerate(digits) if value < 1000), len(units) - 1)
    return f"{digits[power]:g}" if power else number_text(count, ".0f"), units[power]


def bytes_text(count: float) -> str:
    """Return a number of bytes in three digits: "1.23 kB", or "0"."""
    digits, prefix = scaled(count)
    return f"{digits} {prefix}B" if count else "0"


def times_text(ratio: float) -> str:
    """Return a ratio with the sign of multiplication."""
    return number_text(ratio, ".2f") + "\N{MULTIPLICATION SIGN}"


def gain_text(name: str, words: str, gain: Estimate, tied: Sequence[TiedGain]) -> str:
    """Return a sentence on a gain that is told apart from 0: whether all its intervals are above 0.

    Args:
        name: Name of the scenario.
        words: The method, with the markup of the page.
        gain: Gain over plain fine-tuning at the setting that tuning chose.
        tied: Gains over the settings that tuning rated as highly.
    """
    doubt = "" if side_of_zero(gain, tied) == 1 else "not "
    chosen = " at the setting that tuning chose" if tied else ""
    parts = [f"{format_over_seeds(gain, '.3f')} over plain fine-tuning{chosen}"]
    for one in tied:
        at = no_tied_runs(one)
        if one.seeds:
            seeds = counted(one.seeds, "seed")
            value = format_over_seeds(one.gain, ".3f")
            at = f"{value} at {rate_text(one.factor)}, which scored the same in tuning ({seeds})"
        parts.append(f"{'and' if one.is_certain else 'but'} {at}")
    return f"On {name}, the gain of {words} is {doubt}certain: it is {', '.join(parts)}."


def no_tied_runs(tied: TiedGain) -> str:
    """Return in words that a setting of plain fine-tuning tied in tuning, and has no runs to compare with."""
    return (
        f"{rate_text(tied.factor)} scored the same in tuning, and the ladder beside these records has no "
        "runs of it (`clbench leaderboard --published` copies ours)"
    )


def rate_text(factor: float) -> str:
    """Return a learning rate in words: "0.1 times the scenario's learning rate"."""
    return "the scenario's learning rate" if factor == 1 else f"{factor:g} times the scenario's learning rate"
