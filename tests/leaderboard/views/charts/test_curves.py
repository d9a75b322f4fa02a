"""Curves along the stages of a run, against means and intervals by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import stats

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import interval_of_seeds

MODULE = "clbench.leaderboard.views.charts.curves"
estimated, retained_curve, target_curves = (
    resolve(f"{MODULE}:{name}") for name in ("estimated", "retained_curve", "target_curves")
)
SUCCESS = np.array([[1.0, 0.8, 0.1, 0.0, 0.0], [0.6, 0.4, 0.9, 0.2, 0.0], [0.5, 0.3, 0.3, 0.8, 0.0]])


def test_curves_begin_before_the_first_step_and_each_stage_of_a_target(scores: Callable[..., Any]) -> None:
    on_the_way = {"curves": [[0.5], [0.7]], "retained_curves": [[[0.8, 0.8]], [[0.2, 0.4]]]}
    rates = scores(SUCCESS, steps=(50, 100), **on_the_way).rates()
    np.testing.assert_allclose(retained_curve(rates), [0.9, 0.8, 0.5, 0.3, 0.4])
    np.testing.assert_allclose(target_curves(rates), [0.1, 0.5, 0.9, 0.2, 0.7, 0.8])


def test_a_point_of_a_curve_has_the_interval_of_its_mean_over_seeds(scores: Callable[..., Any]) -> None:
    values = np.array([0.2, 0.4, 0.9])
    runs = [scores([[kept, 0.0, 0.0], [kept, 1.0, 0.0]], steps=(100,)) for kept in values]
    found = estimated({"skills": retained_curve}, runs, np.random.default_rng(0))["skills"]
    ends = interval_of_seeds(0.5, float(stats.sem(values)), 2, (0.0, 1.0))
    assert len(found) == 2  # before the first step, and at the only point
    for point in found:
        assert (point.value, point.low, point.high) == pytest.approx((0.5, *ends))
