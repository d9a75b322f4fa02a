"""Metrics of arrays: one implementation, honest gaps, and where the order of methods flips."""

import tracemalloc
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

import clbench
from clbench.base.errors import InputError, UnknownNameError
from clbench.metrics import Report, from_matrix
from clbench.metrics.definitions import DEFINITIONS, FAMILIES
from clbench.metrics.matrices import layout_of
from clbench.metrics.report import needed_cells
from clbench.scoring.metrics import METRICS, measure
from clbench.scoring.scores import Scores

# one skill, three targets, one task held out
MATRIX = [
    [1.0, 0.1, 0.0, 0.2, 0.3],
    [0.8, 0.6, 0.2, 0.1, 0.2],
    [0.7, 0.8, 0.9, 0.4, 0.4],
    [0.6, 0.9, 0.3, 1.0, 0.1],
]
JOINT = [[1.0, 0.1, 0.0, 0.2, 0.3], [1, 0.9, 0, 0, 0], [1, 0.9, 0.8, 0, 0], [1, 0.9, 0.8, 1.0, 0]]
TRIANGLE = [[0.8, np.nan, np.nan], [0.6, 0.9, np.nan], [0.5, 0.4, 0.7]]


def _report(matrices: Mapping[str, ArrayLike]) -> Report:
    return from_matrix(matrices, retained=["task 1"], held_out=["task 5"])


def test_every_value_is_that_of_a_record_with_the_same_rates(scores: Callable[..., Scores]) -> None:
    report = _report({"mine": MATRIX, "joint": JOINT, "sft": JOINT})
    references = {"joint": scores(JOINT), "sft": scores(JOINT)}
    for name in DEFINITIONS:
        assert report.of(name, "mine").value == pytest.approx(measure(name, scores(MATRIX), references)), name


def test_the_definitions_are_the_metrics_that_a_success_matrix_allows() -> None:
    layout = layout_of(["a", "b", "c", "d", "e"], ("a",), None, ("e",))
    allowed = {name for name, metric in METRICS.items() if needed_cells(metric, layout) is not None}
    assert set(DEFINITIONS) == allowed
    assert {one.family for one in DEFINITIONS.values()} == set(FAMILIES)


@pytest.mark.long
def test_a_metric_has_no_value_exactly_if_a_cell_that_it_needs_is_missing() -> None:
    layout = layout_of([f"task {n}" for n in range(1, 6)], ("task 1",), None, ("task 5",))
    whole: dict[str, ArrayLike] = {"": MATRIX, "joint": JOINT, "sft": JOINT}
    for stage, task in np.ndindex(4, 5):
        holed = np.array(MATRIX)
        holed[stage, task] = np.nan
        report = _report({**whole, "": holed})
        for name in DEFINITIONS:
            needed = needed_cells(METRICS[name], layout)
            assert needed is not None
            value = report.of(name, "")
            assert (value.value is None) == needed[stage, task] == (value.reason is not None)
            if value.reason:
                assert value.reason.startswith(f"The table lacks stage {stage}, task {task + 1}.")


def test_a_triangle_has_every_drop_but_those_that_need_targets_before_they_are_learned() -> None:
    report = from_matrix(TRIANGLE)
    assert report["forgetting_avalanche"].value == pytest.approx((0.3 + 0.5) / 2)
    assert report["forgetting_chaudhry"].value is None
    assert report["forgetting_chaudhry"].reason == (
        "The table lacks stage 1, task 2. `forgetting` is the same over the stages since a target was "
        "learned, with the retained skills counted in."
    )
    assert report["forgetting"].value == pytest.approx((0.3 + 0.5) / 2)
    assert report["isolated_forgetting_cora"].reason == "The table lacks stage 0, task 1 and 2 other cells."
    assert report["question_retention"].reason == METRICS["question_retention"].missing


def test_a_masked_rate_is_missing() -> None:
    rates = np.ma.masked_less([[0.6, -1], [0.2, 0.9]], 0)
    for matrix in (rates, [rates, rates]):
        report = from_matrix(matrix)
        assert report["adaptation"].value == pytest.approx(0.75)
        assert (report["forward_transfer_diaz_rodriguez"].value, report.unit) == (None, "share")


def test_seeds_give_the_mean_of_their_values_and_an_interval() -> None:
    other = np.array(TRIANGLE) - 0.2
    report = from_matrix(np.array([TRIANGLE, other, TRIANGLE]))
    value = report["performance_continual_world"]
    assert value.value == pytest.approx((1.6 / 3 + 1.0 / 3 + 1.6 / 3) / 3)
    assert value.low is not None
    assert value.high is not None
    assert 0 < value.low < 0.46 < value.high < 1
    assert from_matrix(TRIANGLE)["performance_continual_world"].low is None


def test_the_interval_of_a_difference_is_that_of_a_rate_stretched_to_its_own_bounds() -> None:
    # two seeds: the first target falls from 1 to 0.6 and to 0.2, so that (change + 1) / 2 is 0.3 and 0.1
    change = from_matrix([[[1.0, 0.0], [0.6, 1.0]], [[1.0, 0.0], [0.2, 1.0]]])["backward_transfer"]
    rate = from_matrix([[[0.3]], [[0.1]]])["final_average"]
    assert change.value == pytest.approx(-0.6)
    assert rate.low is not None
    assert rate.high is not None
    assert 0 < rate.low < 0.2 < rate.high < 1
    assert change.low == pytest.approx(2 * rate.low - 1)
    assert change.high == pytest.approx(2 * rate.high - 1)


def test_per_cent_are_recognised_and_can_be_declared() -> None:
    whole = from_matrix(np.array(TRIANGLE) * 100)
    assert whole.unit == "percent"
    assert whole["adaptation"].value == pytest.approx(from_matrix(TRIANGLE)["adaptation"].value)
    small = from_matrix([[0.5, 0.1], [0.2, 0.9]], unit="percent")
    assert small["adaptation"].value == pytest.approx(0.007)
    assert from_matrix([[0.5, 0.1], [0.2, 0.9]]).unit == "share"


@pytest.mark.parametrize(
    ("matrix", "where"),
    [
        ([[0.9, 0.1, 0.1], [0.5, 1.05, 0.1], [0.4, 0.5, 0.9]], "stage 2, task 'task 2': found 1.05"),
        ([[0.9, 0.0, 0.0], [0.5, 85, 0.0], [0.4, 0.5, 0.9]], "stage 2, task 'task 2': found 85, and other"),
        ({"a": [[0.9, 0.0], [0.5, 1.0]], "b": [[90, 0], [50, 100]]}, "method 'b', stage 2, task 'task 2': f"),
        ([[0.9, 0.1], [0.5, 1.001]], "stage 2, task 'task 2': found 1.001: is it a share above 1"),
        ([[1.5, 0.5], [0.5, 1.8]], "stage 2, task 'task 2': found 1.8: is it a share above 1, or per cent"),
    ],
)
def test_rates_that_leave_their_unit_in_doubt_are_refused_unless_it_is_named(
    matrix: ArrayLike, where: str
) -> None:
    with pytest.raises(InputError, match=rf'{where}.*set --unit percent \(in Python, unit="percent"\)'):
        from_matrix(matrix)
    assert from_matrix(matrix, unit="percent").unit == "percent"


def test_low_rates_in_per_cent_are_recognised_beside_higher_ones() -> None:
    assert from_matrix([[41.5, 0, 0], [13.9, 24.5, 0.8], [4.8, 0, 11.3]]).unit == "percent"


def test_a_text_is_one_name_and_not_its_letters() -> None:
    names = ["reach", "push"]
    report = from_matrix([[0.5, 0.7]], tasks=names, retained="reach", target="push")
    assert report.matrices.layout.retained == ("reach",)
    assert report.matrices.layout.target == ("push",)
    assert from_matrix([[0.5]], tasks="reach").matrices.layout.target == ("reach",)


def test_the_order_of_two_methods_flips_between_definitions_and_both_sides_are_named() -> None:
    # the first keeps a little more in the end, the second falls later
    report = from_matrix(
        {
            "early": [[0.8, 0.0, 0.0], [0.2, 0.8, 0.0], [0.4, 0.6, 0.8]],
            "late": [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.3, 0.6, 0.8]],
        }
    )
    (flip,) = (flip for flip in report.flips if flip.family == "forgetting")
    assert (flip.first, flip.second) == ("early", "late")
    assert "forgetting_avalanche" in flip.first_is_better
    assert "negative_backward_transfer_libero" in flip.second_is_better


def test_every_pair_of_methods_is_looked_at_for_a_flip() -> None:
    report = from_matrix(
        {
            "early": [[0.8, 0.0, 0.0], [0.2, 0.8, 0.0], [0.4, 0.6, 0.8]],
            "best": [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.8, 0.8, 0.8]],
            "late": [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.3, 0.6, 0.8]],
        }
    )
    pairs = [(flip.first, flip.second) for flip in report.flips if flip.family == "forgetting"]
    assert pairs == [("early", "late")]


def test_the_gain_counts_in_no_flip_since_it_repeats_the_final_average() -> None:
    keeps, learns = [[1.0, 0.0], [0.9, 0.5]], [[1.0, 0.0], [0.1, 0.9]]
    report = from_matrix({"keeps": keeps, "sft": learns}, retained="task 1")
    assert report.of("gain", "keeps").value == pytest.approx(0.2)
    (flip,) = (flip for flip in report.flips if flip.family == "average")
    assert flip.first_is_better == ("final_average",)


def test_a_method_may_be_named_by_a_number() -> None:
    numbered: Any = {0: TRIANGLE, 1: TRIANGLE}
    report = from_matrix(numbered)
    assert report.of("final_average", 1) == report.of("final_average", "1")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="'2'"):
        report.of("final_average", 2)  # type: ignore[arg-type]


def test_rates_without_a_name_are_asked_for_without_one() -> None:
    with pytest.raises(UnknownNameError, match="name no method: ask for gain without 'mine'"):
        from_matrix(TRIANGLE).of("gain", "mine")


def test_a_tie_is_no_flip() -> None:
    assert from_matrix({"one": TRIANGLE, "other": TRIANGLE}).flips == ()


def test_a_reference_needs_its_own_name_and_the_same_seeds() -> None:
    assert from_matrix({"mine": TRIANGLE})["gain"].reason == "No method is called sft."
    reason = from_matrix({"mine": TRIANGLE, "SFT": TRIANGLE})["gain"].reason
    assert reason == "No method is called sft. Did you mean 'SFT'?"
    report = from_matrix({"mine": [TRIANGLE, TRIANGLE], "sft": TRIANGLE, "joint": [TRIANGLE, TRIANGLE]})
    assert report.of("gain", "mine").reason == "Method sft has no seed '0', no seed '1'."
    assert report.of("gain", "joint").value is None
    assert report.of("intransigence", "mine").value == pytest.approx(0)
    assert report.of("intransigence", "joint").reason == "joint is what the others are compared with."


@pytest.mark.parametrize("share", [0.15, 0.3])
def test_three_tenths_of_rates_up_to_1_leave_the_unit_in_doubt_and_fewer_do_not(share: float) -> None:
    small = round(20 * share)
    matrix = np.array([*[0.5] * small, *[40.0] * (20 - small), *[0.0] * 5]).reshape(5, 5)
    if share > 0.25:
        with pytest.raises(InputError, match="and other rates are at most 1"):
            from_matrix(matrix)
    else:
        assert from_matrix(matrix).unit == "percent"


@pytest.mark.parametrize("rate", [0.5, 1.0])
def test_exactly_a_quarter_of_rates_up_to_1_leaves_the_unit_in_doubt(rate: float) -> None:
    with pytest.raises(InputError, match="found 80, and other rates are at most 1"):
        from_matrix([[rate, 40.0], [60.0, 80.0]])


def test_a_single_low_rate_of_a_task_in_a_table_of_per_cent_is_no_share() -> None:
    assert from_matrix([[41.5, 0.0, 0.0], [13.9, 24.5, 0.0], [4.8, 11.0, 0.8]]).unit == "percent"


def test_shares_of_one_method_beside_many_in_per_cent_are_noticed() -> None:
    percent = np.array([[80.0, 0.0], [50.0, 90.0]])
    methods = {f"method {number}": percent for number in range(4)}
    assert from_matrix(methods).unit == "percent"
    with pytest.raises(InputError, match="and other rates are at most 1: is it a share"):
        from_matrix({**methods, "wrong": percent / 100})


def test_shares_of_one_seed_or_of_one_task_in_a_table_of_per_cent_are_noticed() -> None:
    percent = np.array([[80.0, 5.0, 10.0], [60.0, 70.0, 15.0], [50.0, 55.0, 90.0]])
    seeds = np.stack([percent] * 5)
    assert from_matrix(seeds).unit == "percent"
    seeds[4] /= 100
    with pytest.raises(InputError, match="and all rates of seed '4' are at most 1: is it a share"):
        from_matrix(seeds)
    percent = np.tile(percent, (1, 2))[:, :5]
    percent[:, 1] /= 100
    with pytest.raises(InputError, match="and all rates of task 'task 2' are at most 1: is it a share"):
        from_matrix(percent, held_out=["task 4", "task 5"])


def test_a_rate_of_3_is_per_cent_and_one_of_2_is_in_doubt() -> None:
    assert from_matrix([[3.0, 0.0], [2.5, 1.5]]).unit == "percent"
    with pytest.raises(InputError, match="found 2: is it a share above 1"):
        from_matrix([[2.0, 0.0], [1.5, 1.5]])


def test_a_matrix_with_two_rows_too_few_is_refused() -> None:
    with pytest.raises(InputError, match=r"The matrix has 2 rows\. Expected stages 1 to 3"):
        from_matrix(TRIANGLE[:2])


def test_a_difference_of_a_hundredth_is_no_tie_and_one_of_the_last_bits_is() -> None:
    def flips(difference: float) -> int:
        # one keeps more of the first target at the end, the other kept more on the way
        early = [[0.8, 0.0, 0.0], [0.2, 0.8, 0.0], [0.3 + difference, 0.6, 0.8]]
        late = [[0.8, 0.0, 0.0], [0.8, 0.8, 0.0], [0.3, 0.6, 0.8]]
        return len(
            [one for one in from_matrix({"early": early, "late": late}).flips if one.family == "forgetting"]
        )

    assert [flips(0.02), flips(1e-12), flips(0.0)] == [1, 0, 0]


def test_without_a_name_the_value_is_that_of_the_first_method() -> None:
    report = from_matrix({"first": TRIANGLE, "second": np.array(TRIANGLE) / 2})
    assert report["adaptation"] == report.of("adaptation", "first") != report.of("adaptation", "second")


def test_a_reason_names_the_missing_cells_of_a_reference() -> None:
    holed = np.array(JOINT)
    holed[2, 2] = np.nan
    reason = "The table lacks method joint, stage 2, task 3."
    assert _report({"mine": MATRIX, "joint": holed}).of("intransigence", "mine").reason == reason
    report = _report({"mine": [MATRIX, MATRIX], "joint": np.array([JOINT, holed])})
    assert report.of("intransigence", "mine").reason == reason.replace("joint, ", "joint, seed '1', ")
    holed = np.array(JOINT)
    holed[3, 0] = np.nan
    report = _report({"mine": MATRIX, "sft": holed})
    assert report.of("gain", "mine").reason == "The table lacks method sft, stage 3, task 1."
    assert report.of("gain", "sft").reason == "The table lacks stage 3, task 1."


def test_a_method_with_one_seed_is_compared_with_that_seed_of_the_reference() -> None:
    sft = np.array([[[0.4, 0.0], [0.2, 0.4]], [[0.9, 0.0], [0.9, 0.9]]])
    report = from_matrix({"sft": sft, "a": sft[:1] + 0.1, "b": sft[0] + 0.1})
    assert report.of("gain", "a").value == pytest.approx(0.1)
    assert report.of("gain", "b").reason == "Method sft has no matrix without a seed."
    report = from_matrix({"sft": sft[0], "a": sft[:1] + 0.1})
    assert report.of("gain", "a").value == pytest.approx(0.1)


def test_two_names_that_read_alike_are_refused() -> None:
    one, other = [[0.5]], [[0.6]]
    with pytest.raises(InputError, match="Two methods are called '1': rename one"):
        from_matrix({1: one, "1": other})  # type: ignore[dict-item]


def test_a_reason_counts_no_cells_of_a_seed_that_only_the_reference_has() -> None:
    holed = np.array(JOINT)
    holed[3, 0] = np.nan
    report = _report({"mine": [MATRIX, MATRIX], "sft": np.array([JOINT, holed, holed])})
    assert report.of("gain", "mine").reason == "The table lacks method sft, seed '1', stage 3, task 1."


def test_without_retained_skills_no_reason_says_that_a_success_on_one_is_missing() -> None:
    report = from_matrix([[0.5]])
    for name in ("retention", "kept_skills_over_stages"):
        assert str(report[name].reason).startswith("There are no retained skills")
    for name in ("kept", "kept_over_stages", "kept_share"):
        assert "neither a retained skill nor an earlier target" in str(report[name].reason)
    assert str(from_matrix([[0.5]], retained="task 1")["adaptation"].reason).startswith(
        "There are no targets"
    )


def test_what_a_large_table_lacks_is_found_without_much_memory() -> None:
    size = 40
    triangle = np.where(np.tri(size) > 0, 0.5, np.nan)
    tracemalloc.start()
    report = from_matrix(triangle)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50e6
    reason = f"The table lacks stage 1, task 2 and {size * (size - 1) // 2 - 1} other cells."
    assert report["forward_transfer_diaz_rodriguez"].reason == reason


def test_the_targets_can_be_put_in_the_order_in_which_they_were_learned() -> None:
    swapped = np.array(TRIANGLE)[:, ::-1]
    tasks = ["third", "second", "first"]
    report = from_matrix(swapped, tasks=tasks, target=["first", "second", "third"])
    assert report["adaptation"].value == pytest.approx(from_matrix(TRIANGLE)["adaptation"].value)


def test_a_table_of_pandas_has_a_row_for_every_metric_and_method() -> None:
    frame = from_matrix({"one": TRIANGLE, "other": TRIANGLE}).frame()
    assert len(frame) == 2 * len(METRICS)
    row = frame[(frame.metric == "forgetting_avalanche") & (frame.method == "other")].iloc[0]
    assert (row.family, row.source) == ("forgetting", METRICS["forgetting_avalanche"].source)
    assert row.value == pytest.approx(0.4)
    assert set(frame[frame.family.notna()].metric) == set(DEFINITIONS)
    runs: list[Any] = [TRIANGLE, np.array(TRIANGLE) - 0.2]
    seeds = from_matrix(runs).frame().set_index("metric").loc["adaptation"]
    assert seeds.low < seeds.value < seeds.high


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"matrix": [0.5, 0.5]}, r"shape \(2,\): expected \(stages, tasks\) or \(seeds, stages, tasks\)"),
        (
            {"matrix": [[0.5, 0.5, 0.5]]},
            r"The matrix has 1 row\. Expected stages 1 to 3.*retained or held out",
        ),
        (
            {"matrix": [[0.5, 0.5], [0.5, 0.4]], "retained": ["task 1", "task 2"]},
            "has 2 rows. Expected stage 0 alone: no task is left as a target. Name fewer ones as retained",
        ),
        ({"matrix": [[-0.5]]}, r"stage 1, task 'task 1': expected a share from 0 to 1, found -0\.5"),
        ({"matrix": [[500]]}, r"stage 1, task 'task 1': expected per cent from 0 to 100, found 500"),
        ({"matrix": [[0.5]], "tasks": ["a", "b"]}, "There are 2 names for 1 task"),
        ({"matrix": {"a": [[0.5]], "b": TRIANGLE}}, r"'a' \(1, 1\), 'b' \(3, 3\)"),
        ({"matrix": {}}, "expected at least one method"),
        ({"matrix": [[0.5, 0.5], [0.5]]}, "The matrix is not an array of numbers: expected rows of equal"),
        ({"matrix": {"a": [["high"]]}}, "The matrix of method 'a' is not an array of numbers"),
        (
            {"matrix": [[0.5]], "unit": "percentage"},
            r"must be 'share' or 'percent', not 'percentage'\. Did you mean 'percent'",
        ),
        ({"matrix": TRIANGLE, "target": ["task 1"]}, "Task 'task 2' is in no group"),
        ({"matrix": TRIANGLE, "target": ["task 1"] * 2}, "Task 'task 1' is named twice"),
    ],
)
def test_a_wrong_matrix_is_refused_with_what_was_expected(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        from_matrix(**arguments)  # type: ignore[arg-type]


def test_matrices_of_other_stages_or_tasks_are_refused_with_their_shapes() -> None:
    with pytest.raises(InputError, match=r"the same stages and tasks; .* 'a' \(3, 2\), 'b' \(2, 2\)"):
        from_matrix({"a": np.full((3, 2), 0.5), "b": np.full((2, 2), 0.5)})


def test_an_unknown_task_metric_or_method_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'sft'"):
        from_matrix({"sft": TRIANGLE}).of("adaptation", "stf")
    with pytest.raises(UnknownNameError, match="Did you mean 'task 1'"):
        from_matrix(TRIANGLE, retained=["task1"])
    with pytest.raises(UnknownNameError, match="Did you mean 'forgetting_mammoth'"):
        from_matrix(TRIANGLE)["forgetting_mamoth"]


def test_the_front_door_leads_here() -> None:
    assert clbench.metrics.from_matrix is from_matrix


def test_a_mean_that_exceeds_1_in_its_last_bit_is_a_share() -> None:
    above = [[1.0, 0.5], [0.8, 1.0000000000000002]]
    assert from_matrix(above)["performance_continual_world"].value == pytest.approx(0.9)
    assert from_matrix([[1.0000000000000002]])["final_average"].value == 1.0
    with pytest.raises(InputError, match="per cent"):
        from_matrix([[1.0, 0.5], [0.8, -0.1]], unit="percent")


def test_a_mean_in_single_precision_that_exceeds_1_is_a_share() -> None:
    always = np.nextafter(np.float32(1), np.float32(2))  # such as the sum of 11 times 1 / 11
    assert from_matrix([[always]])["final_average"].value == 1.0
    assert from_matrix([[100 * always]]).unit == "percent"
