"""The submission's own test, as a stranger would write it."""

from clbench.testing import check_method

from weight_average import WeightAverage


def test_weight_average_keeps_the_contract() -> None:
    check_method(WeightAverage)
