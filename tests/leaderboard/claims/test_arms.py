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
