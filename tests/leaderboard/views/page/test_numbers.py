"""The cells of a table: text, sort key, interval and bar."""

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import Estimate
from clbench.scoring.metrics import METRICS

number = resolve("clbench.leaderboard.views.page.numbers:number")
Column = resolve("clbench.leaderboard.views.format:Column")


def test_the_bar_of_a_rate_goes_from_the_low_end_by_the_value_to_the_high_one() -> None:
    cell = number(Estimate(0.5, 0.25, 0.625), Column(METRICS["retention"], "retention"))
    assert (cell.text, cell.bar) == ("0.50", (25, 50, 62))
    assert cell.note == "95 % interval from 0.25 to 0.62"
    gain = number(Estimate(0.5, 0.25, 0.625), Column(METRICS["gain"], "gain"))
    assert (gain.text, gain.bar) == ("+0.50", ())
