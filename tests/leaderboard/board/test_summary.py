"""The numbers of the board as JSON, from which the terminal shows a board without reading its records."""

import json

import pytest

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate

RowSummary = resolve("clbench.leaderboard.board.summary:RowSummary")
Summary = resolve("clbench.leaderboard.board.summary:Summary")


@pytest.mark.parametrize("seeds", [(3,), (0, 1, 2, 3)], ids=["one seed", "four seeds"])
def test_a_summary_is_the_same_after_json_and_what_one_seed_shows_stays_uncertain(
    seeds: tuple[int, ...],
) -> None:
    row = RowSummary(
        scenario="clbench/Toy-v0",
        method="sft",
        division="prior-data-free",
        letters="a",
        tier="replayed",
        seeds=seeds,
        to_criterion=True,
        estimates={"gain": Estimate(0.2, 0.1, 0.3, of_seeds=len(seeds) > 1)},
        costs={"steps": 3.0},
        order_sensitivity=None,
    )
    before = Summary(
        rows=(row,),
        starts={"clbench/Toy-v0": 1.0},
        unpaired={"clbench/Toy-v0": {"sft": [3]}},
        machines={"clbench/Toy-v0": "arm64"},
    )
    after = Summary.from_json(json.loads(json.dumps(before.to_json())))
    assert after == before
    assert after.rows[0].estimates["gain"].is_above(0.0) == (len(seeds) > 1)
