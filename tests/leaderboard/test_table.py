"""The table as a data frame: one row for each scenario and method, with every metric and cost."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest

from clbench.base.entry_points import resolve
from clbench.base.errors import NoRecordsError
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.scoring.metrics import METRICS

load = resolve("clbench:load_board")


def test_there_is_one_row_for_each_method_sorted_by_division_and_final_average(
    four_methods: Path, add_full: Callable[..., Path]
) -> None:
    add_full("better", 0, np.ones((3, 5)))
    frame = load(four_methods)
    assert list(frame.method) == ["better", "sft", "asks", "replay", "from_scratch"]
    assert list(frame.division) == [
        "prior-data-free",
        "prior-data-free",
        "prior questions",
        "prior demonstrations",
        "reference",
    ]
    assert list(frame.seeds) == [1, 2, 2, 2, 2]
    letters = frame.set_index("method").letters
    assert letters[letters.isna()].index.tolist() == ["from_scratch"]  # a reference does not compete


def test_a_row_has_every_metric_with_its_interval_and_the_costs(four_methods: Path) -> None:
    row = load(four_methods).set_index("method").loc["sft"]
    assert row.retention == pytest.approx(0.45)
    assert row.forgetting == pytest.approx(1.6 / 3)
    assert row.question_retention == pytest.approx(0.5)
    assert row.update_sparsity == pytest.approx(0.6)
    assert row.activation_drift == pytest.approx(3.0)
    assert row.steps == 800
    assert row.parameters == 1000
    assert np.isnan(row.intransigence)  # there is no joint
    assert np.isnan(row.perturbed_retention)
    to_criterion = {
        "criterion_met",
        "steps_to_criterion",
        "speed",
        "relearning_steps",
        "instruction_capture",
        "shift",
    }
    assert row[sorted(to_criterion)].isna().all()
    missing = {"intransigence", "perturbed_retention", "perturbed_adaptation", "gain", *to_criterion}
    of_whole_runs = {"update_sparsity", "activation_drift"}  # its seeds agree in them
    assert row[[f"{name}_low" for name in of_whole_runs]].isna().all()
    for name in set(METRICS) - missing - of_whole_runs:
        assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]


@pytest.mark.long
def test_without_from_scratch_forward_transfer_is_missing(four_methods: Path) -> None:
    assert load(four_methods).set_index("method").forward_transfer.notna().sum() == 3
    record_path(four_methods, "clbench/Toy-v0", "from_scratch", 1).unlink()
    assert load(four_methods).forward_transfer.isna().all()


@pytest.mark.long
def test_a_row_does_not_depend_on_the_other_rows(four_methods: Path, add_full: Callable[..., Path]) -> None:
    before = load(four_methods)
    add_full("another", 0)
    add_full("sft", 0, scenario="clbench/Other-v0")
    after = load(four_methods)
    kept = after[(after.scenario == "clbench/Toy-v0") & (after.method != "another")]
    kept = kept.reset_index(drop=True).drop(columns="letters")
    pandas.testing.assert_frame_equal(kept, before.drop(columns="letters"))


@pytest.mark.long
def test_the_relative_cost_counts_all_steps_with_the_time_of_one(
    four_methods: Path, add_full: Callable[..., Path]
) -> None:
    for method, steps, ratios in (
        ("sft", 400, (None, None)),
        ("slow", 600, (1.3, 1.5)),
        ("unknown", 400, (None, None)),
        ("torn", 400, ("fast", -1.0)),
        ("idle", 0, (None, None)),
    ):
        for seed, ratio in enumerate(ratios):
            add_full(method, seed, edit=measured(steps, ratio))
    costs = load(four_methods).set_index("method").relative_cost
    assert costs["sft"] == 1.0
    assert costs["slow"] == pytest.approx(1.5 * (1.3 * 1.5) ** 0.5)  # the geometric mean of the times
    assert costs["idle"] == 0.0
    assert np.isnan(costs["unknown"])
    assert np.isnan(costs["torn"])


def test_loading_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(NoRecordsError, match=r"nowhere.*`clbench leaderboard --published` copies"):
        load(tmp_path / "nowhere")


def measured(steps: int, ratio: float | str | None) -> Callable[[Record], None]:
    def edit(record: Record) -> None:
        record.costs.optimiser_steps = steps
        record.timing["step_ratio"] = ratio

    return edit
