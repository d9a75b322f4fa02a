"""An arm of ConSFT that does not count makes no claim hold, and may keep one from failing."""

import pytest
from stated_evidence import Ends, Given, judged, kept, shares

ONE_COUNTS = shares(0.1, 0.099)
REPLAYED = kept((0.0, 0.1), (0.0, 0.1), "buffered_replay")
SPARSE = "update sparsity, {} - sft"
OVERFITS: Given = {"success on new targets, plain - perturbed, sft": (0.051, 0.1)}


@pytest.mark.parametrize("verdict", ["does not hold", "undecided"])
@pytest.mark.parametrize(
    ("identifier", "what", "below", "above", "given"),
    [
        ("C3", "retained success, {} - experience_replay", (-0.3, -0.051), (0.0, 0.1), REPLAYED),
        ("C4", SPARSE, (0.0, 0.049), (0.051, 0.2), {"update sparsity, sft@0.03 - sft@1": (0.0, 0.051)}),
        ("C7", "backward transfer of {}", (-0.3, -0.101), (0.0, 0.1), {}),
        ("C8", "loss in perturbed episodes, sft - {}", (0.0, 0.049), (0.051, 0.1), OVERFITS),
    ],
)
def test_a_claim_fails_only_if_the_arm_that_does_not_count_fails_too(
    identifier: str, what: str, below: Ends, above: Ends, given: Given, verdict: str
) -> None:
    other = below if verdict == "does not hold" else above
    ends = {what.format("consft"): below, what.format("consft_calibrated"): other}
    finding = judged(identifier, {**ONE_COUNTS, **given, **ends})
    assert finding.verdict == verdict
    shown = {figure.what: figure.high for figure in (*finding.figures, *finding.controls)}
    assert shown[what.format("consft_calibrated")] == other[1]


BOTH_COUNT, NONE_COUNTS = shares(0.2, 0.2), shares(0.05, 0.05)


@pytest.mark.parametrize(
    ("replay", "buffered", "verdict", "change"),
    [
        ((-0.04, 0.02), (-0.049, 0.1), "holds", '- buffered_replay" would have to move by 0.00'),
        ((0.04, 0.2), (-0.2, 0.3), "undecided", '- buffered_replay" contains -0.05'),
        (None, (-0.4, -0.2), "does not hold", '- buffered_replay" would have to move by 0.15'),
        ((0.0, 0.1), None, "undecided", "Records that give an interval for this figure: retained success, "),
    ],
)
def test_the_kind_of_replay_that_decides_is_named_whatever_is_known_of_the_other(
    replay: Ends | None, buffered: Ends | None, verdict: str, change: str
) -> None:
    kinds = (("experience_replay", replay), ("buffered_replay", buffered))
    given = {key: ends for name, one in kinds if one for key, ends in kept(one, one, name).items()}
    finding = judged("C3", {**BOTH_COUNT, **given})
    assert finding.verdict == verdict
    assert change in finding.change
    fails = "buffered_replay certainly keeps more skills than consft." in finding.sentences
    assert fails == (verdict == "does not hold")


def test_without_an_arm_that_counts_both_kinds_of_replay_are_shown() -> None:
    fewer = (-0.3, -0.2)
    given = {**kept(fewer, fewer, "experience_replay"), **kept(fewer, fewer, "buffered_replay")}
    finding = judged("C3", {**NONE_COUNTS, **given})
    assert finding.verdict == "cannot be shown here"
    assert given.keys() <= {figure.what for figure in (*finding.figures, *finding.controls)}


def test_an_arm_that_does_not_count_and_keeps_a_claim_from_failing_is_named_as_such() -> None:
    given = {**shares(0.05, 0.2), **kept((0.25, 0.35), (0.0, 0.1)), **kept((0.0, 0.1), (0.0, 0.1), rung="@1")}
    finding = judged("C2", given)
    assert finding.verdict == "undecided"
    assert finding.change == (
        'An interval of "retained success, consft - sft" that lies below 0.20: its arm does not count, but '
        "it keeps the claim from failing."
    )


def test_where_every_gain_must_fall_below_the_bar_the_widest_interval_decides() -> None:
    given = {**kept((-0.2, 0.26), (-0.05, 0.199)), **kept((-0.29, 0.32), (-0.27, 0.33), rung="@1")}
    finding = judged("C2", {**BOTH_COUNT, **given})
    assert finding.verdict == "undecided"
    assert '"retained success, consft_calibrated@1 - sft@1" contains 0.20' in finding.change


@pytest.mark.parametrize("ladder", [True, False])
def test_a_board_that_could_only_confirm_a_gain_says_so(ladder: bool) -> None:
    both = (-0.2, 0.1)
    given = {**BOTH_COUNT, **kept(both, both), **(kept(both, both, rung="@1") if ladder else {})}
    finding = judged("C2", given)
    assert finding.verdict == ("does not hold" if ladder else "undecided")
    assert finding.change.endswith("the claim can hold, but not fail.") != ladder


def test_where_the_larger_gain_is_open_the_one_that_makes_a_claim_hold_is_explained() -> None:
    finding = judged("C2", {**BOTH_COUNT, **kept((-0.1, 0.7), (0.21, 0.29))})
    assert finding.verdict == "holds"
    assert finding.figures[0].methods[0] == "consft_calibrated"
    assert not [one for one in finding.sentences if "no gain to explain" in one]


@pytest.mark.parametrize(
    ("identifier", "given", "change"),
    [
        ("C4", {"update sparsity, sft@0.03 - sft@1": (0.0, 0.01)}, "A measure of sparsity that responds"),
        ("C8", {"success on new targets, plain - perturbed, sft": (0.0, 0.01)}, "Starts farther from"),
    ],
)
def test_each_reason_why_a_claim_cannot_be_shown_says_what_would_remove_it(
    identifier: str, given: Given, change: str
) -> None:
    finding = judged(identifier, {**NONE_COUNTS, **given})
    assert finding.verdict == "cannot be shown here"
    assert "Weights that differ between samples" in finding.change
    assert change in finding.change


@pytest.mark.parametrize(
    ("time", "bar"), [((1.21, 1.7), "1.60"), ((1.1, 1.4), "1.20"), ((1.61, 1.9), "1.60")]
)
def test_a_time_of_a_step_is_compared_with_the_bar_that_decides(time: Ends, bar: str) -> None:
    change = judged("A7", {"time of aegis": time}).change
    assert change.endswith((f"contains {bar}.", f"to reach {bar}."))
