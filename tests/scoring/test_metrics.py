"""The registry of metrics: every metric describes itself, and keeps to its range and to batch axes."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clbench.cli import metric_pages
from clbench.records.record import Relearning
from clbench.scoring.metrics import METRICS, USUAL_NAMES, load_metric, measure
from clbench.scoring.scores import Scores, rates_of
from clbench.spec.protocol import check_steps


def test_an_unknown_metric_is_a_lookup_error_that_names_the_nearest() -> None:
    with pytest.raises(LookupError, match="Did you mean 'retention'"):
        load_metric("retentoin")


def test_a_metric_is_found_by_its_title_on_the_board() -> None:
    assert load_metric("learned") is METRICS["adaptation"]
    assert load_metric("kept skills") is load_metric("kept_skills") is METRICS["retention"]
    assert load_metric("final average") is load_metric("Final-Average") is METRICS["final_average"]
    assert load_metric("Learned") is METRICS["adaptation"]


def test_a_value_is_ahead_only_if_it_is_better_by_more_than_the_last_bit() -> None:
    retention, forgetting = METRICS["retention"], METRICS["forgetting"]
    assert retention.is_ahead(0.3, 0.2) is forgetting.is_ahead(0.2, 0.3) is True
    assert retention.is_ahead(0.2, 0.3) is forgetting.is_ahead(0.3, 0.2) is False
    assert retention.is_ahead(0.1 + 0.2, 0.3) is retention.is_ahead(None, 0.3) is None
    assert METRICS["shift"].is_ahead(0.3, 0.2) is None


@pytest.mark.parametrize(
    ("usual", "name"),
    [
        ("acc", "performance_continual_world"),
        ("average_accuracy", "performance_continual_world"),
        ("AIA", "average_incremental_accuracy"),
        ("WC-ACC", "worst_case_accuracy"),
        ("min ACC", "minimum_accuracy"),
        ("REM", "remembering_diaz_rodriguez"),
        ("forgetting measure", "forgetting_chaudhry"),
        ("FM", "forgetting_chaudhry"),
        ("BWT+", "positive_backward_transfer_diaz_rodriguez"),
        ("AUC", "area_under_curve_libero"),
        ("ZS", "zero_shot"),
    ],
)
def test_a_metric_is_found_by_the_name_that_papers_use(usual: str, name: str) -> None:
    assert load_metric(usual) is METRICS[name]


@pytest.mark.parametrize("usual", ["BWT", "FWT", "NBT", "average forgetting"])
def test_a_name_that_papers_use_for_several_metrics_lists_these_alone(usual: str) -> None:
    with pytest.raises(LookupError, match=f"'{usual}' has several definitions: ") as raised:
        load_metric(usual)
    assert 2 <= len(METRICS.keys() & set(re.findall(r"\w+", str(raised.value)))) < 6


def test_a_name_with_two_meanings_lists_both() -> None:
    with pytest.raises(LookupError, match=r"several definitions: adaptation, intransigence\. Name one"):
        load_metric("plasticity")
    with pytest.raises(LookupError, match="several definitions: final_average, performance_"):
        load_metric("accuracy")


LESS_IS_BETTER = {
    *("forgetting", "forgetting_chaudhry", "forgetting_mammoth", "forgetting_avalanche"),
    *("forgetting_continual_world", "isolated_forgetting_cora", "intransigence"),
    *(f"negative_backward_transfer_{source}" for source in ("libero", "clare", "arfm")),
    *("steps_to_criterion", "relearning_steps", "instruction_capture", "activation_drift"),
}
NEITHER = {"update_sparsity", "shift"}


def test_rows_are_ordered_by_the_right_end_of_every_metric() -> None:
    found = {name: metric.higher_is_better for name, metric in METRICS.items()}
    assert {name for name, better in found.items() if better is False} == LESS_IS_BETTER
    assert {name for name, better in found.items() if better is None} == NEITHER


def test_every_name_that_papers_use_leads_to_metrics_and_hides_none() -> None:
    assert {name for names in USUAL_NAMES.values() for name in names} <= METRICS.keys()
    assert not USUAL_NAMES.keys() & METRICS.keys()


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_describes_itself(name: str) -> None:
    metric = load_metric(name)
    assert metric.name == name
    assert metric.description.endswith(".")
    assert metric.formula
    assert metric.source
    assert metric.units
    assert metric.missing.endswith(".")
    assert metric.low < metric.high


Pairs = tuple[list[Scores], list[Scores]]


@pytest.fixture(scope="module")
def random_pairs(scores: Callable[..., Scores]) -> Pairs:
    """Twenty runs at random, and as many references."""
    generator = np.random.default_rng(1)
    runs, others = (
        [
            scores(
                generator.integers(0, 2, size=(4, 6, 2)),
                curves=generator.integers(0, 2, size=(3, 3, 2)),
                retained_curves=generator.integers(0, 2, size=(3, 3, 2, 2)),
                perturbed=generator.integers(0, 2, size=(4, 2, 2)),
                perturbed_learned=generator.integers(0, 2, size=(3, 2)),
                sparsity=generator.random((3, 4)),
                drift=generator.random((3, 4)),
                shift=generator.random(3),
                answers={(3, "left"): (10, int(generator.integers(11)))},
            )
            for _ in range(20)
        ]
        for _ in range(2)
    )
    return runs, others


@pytest.fixture(scope="module")
def pairs_with_a_criterion(scores: Callable[..., Scores]) -> Pairs:
    """The same number of runs whose stages end with a criterion."""
    generator = np.random.default_rng(2)
    runs, others = (
        [
            scores(
                generator.integers(0, 2, size=(4, 6, 2)),
                steps=(100,),
                captured=generator.random(3),
                ends=tuple(int(end) for end in generator.choice(check_steps(100), size=3)),
                relearning=Relearning("skill_0", 3, int(generator.choice(check_steps(100))), True),
            )
            for _ in range(20)
        ]
        for _ in range(2)
    )
    return runs, others


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_keeps_to_its_range_and_to_batch_axes(
    name: str, random_pairs: Pairs, pairs_with_a_criterion: Pairs
) -> None:
    metric = load_metric(name)
    runs, others = pairs_with_a_criterion if "no criterion" in metric.missing else random_pairs
    values = [
        measure(name, run, dict.fromkeys(metric.references, other))
        for run, other in zip(runs, others, strict=True)
    ]
    known = [value for value in values if value is not None]
    # a share of earlier success has no value where there is none
    assert len(known) >= (10 if name.endswith("_cora") or name == "kept_share" else 20)
    assert all(metric.low <= value <= metric.high for value in known)
    together = metric.function(rates_of(runs, dict.fromkeys(metric.references, others)))
    np.testing.assert_allclose(together, np.array(values, dtype=float))


def test_every_metric_is_of_a_module_whose_metrics_are_worked_out_by_hand() -> None:
    modules = {metric.function.__module__ for metric in METRICS.values()}
    assert modules == {"clbench.scoring.ours", "clbench.scoring.published"}


# ---- docs/reference/metrics.md -----------------------------------------------------------------------------

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "metrics.md"


@pytest.mark.skipif(not PAGE.exists(), reason="pages are not part of an installed package")
def test_the_page_of_the_metrics_is_made_from_the_registry() -> None:
    assert PAGE.read_text(encoding="utf-8") == metric_pages.page()


@pytest.mark.parametrize("name", METRICS)
def test_the_description_of_a_metric_has_its_formula_source_direction_and_missing_cases(name: str) -> None:
    metric, text = METRICS[name], metric_pages.text(METRICS[name])
    for part in (metric.formula, metric.source, metric.direction, metric.missing, metric.units):
        assert part in text


def test_a_ratio_and_a_pooled_metric_say_how_seeds_are_averaged() -> None:
    assert "Seeds: geometric mean over seeds\n" in metric_pages.text(METRICS["speed"])
    pooled = metric_pages.text(METRICS["forward_transfer"])
    assert "Seeds: averaged over seeds first, then computed once\n" in pooled


def test_every_drop_is_a_difference_of_success_rates_whether_or_not_it_can_be_negative() -> None:
    units = {name: metric.units for name, metric in METRICS.items()}
    drops = {name for name in units if name.startswith(("forgetting", "negative_", "backward_", "positive_"))}
    assert {units[name] for name in drops} == {"difference of success rates"}
    assert units["remembering_diaz_rodriguez"] == "1 less a difference of success rates"


def test_every_source_is_ours_or_can_be_looked_up() -> None:
    for name, metric in METRICS.items():
        assert re.search(r"arXiv \d{4}\.\d{4,5}|clbench|Mammoth, .* at|Avalanche 0", metric.source), name


def test_all_about_a_metric_is_exact() -> None:
    assert metric_pages.text(METRICS["retention"]) == (
        "retention\n"
        "Success on the retained skills after the last target.\n"
        "\n"
        "Formula: mean of R[K][s] over the retained skills s\n"
        "Source: clbench\n"
        "Version: 0\n"
        "Direction: higher is better\n"
        "Range: 0 to 1\n"
        "Units: success rate\n"
        "Compared with: nothing\n"
        "Seeds: mean over seeds\n"
        "None means: There are no retained skills, or the success on one after the last target is missing.\n"
    )
