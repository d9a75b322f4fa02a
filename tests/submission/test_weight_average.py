"""The submission's own test, as a stranger would write it."""

from weight_average import WeightAverage

from clbench.testing import check_method


def test_weight_average_keeps_the_contract() -> None:
    check_method(WeightAverage)
