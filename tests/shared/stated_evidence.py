"""Evidence with stated intervals, for tests of the rules of claims."""

from typing import Any

from clbench.base.entry_points import resolve
from clbench.scoring.intervals import NO_ESTIMATE, Estimate

CLAIMS = resolve("clbench.leaderboard.claims.judges:CLAIMS")
Figure = resolve("clbench.leaderboard.claims.evidence:Figure")

Ends = tuple[float, float]
Given = dict[str, Ends]


class Stated:
    """Evidence whose figures have stated intervals, by their names; all others are missing."""

    scenario, not_used = "clbench/Toy-v0", ()

    def __init__(self, given: Given, runs: dict[str, Any] | None = None) -> None:
        self.given, self.runs, self.asked = given, runs or {}, set[str]()

    def first_run(self, method: str) -> Any:
        return next(iter(self.runs.get(method, {}).values()), None)

    def figure(self, what: str, quantity: Any, *methods: str, **_: Any) -> Any:
        self.asked.add(what)
        ends = self.given.get(what)
        found = NO_ESTIMATE if ends is None else Estimate((ends[0] + ends[1]) / 2, *ends)
        return Figure(what, tuple(dict.fromkeys(methods)), found, (0, 1, 2))

    def metric(self, name: str, method: str, **_: Any) -> Any:
        return self.figure(f"{name.replace('_', ' ')} of {method}", None, method)

    def difference(self, name: str, method: str, other: str, **_: Any) -> Any:
        return self.figure(f"{name.replace('_', ' ')}, {method} - {other}", None, method, other)

    def pooled(self, method: str, what: str, *_: Any) -> Any:
        return self.figure(what, None, method)

    def diagnostic(self, method: str, what: str, *_: Any) -> Any:
        return self.figure(what, None, method)

    def diagnostic_ratio(self, method: str, other: str, what: str, *_: Any) -> Any:
        return self.figure(what, None, method, other)

    def cost(self, name: str, method: str, what: str, *_: Any) -> Any:
        return self.figure(what, None, method)

    def step_time(self, method: str) -> Any:
        return self.figure(f"time of {method}", None, method)

    def share_of_preparation(self, method: str) -> Any:
        return self.figure(f"preparation of {method}", None, method)


def judged(identifier: str, given: Given, runs: dict[str, Any] | None = None) -> Any:
    """Return the finding on a claim, after a look whether its rule asks for what is given."""
    evidence = Stated(given, runs)
    finding = CLAIMS[identifier].judge(evidence)
    assert given.keys() <= evidence.asked, given.keys() - evidence.asked
    return finding


FORGETS: Given = {"question accuracy, pretrained - sft@1 after the last target": (0.011, 0.1)}
"""Plain fine-tuning certainly loses answers at the scenario's learning rate."""


def shares(consft: float, calibrated: float) -> Given:
    """Return the shares of the weights of both arms that differ between samples."""
    what = "share of the weights of {} between 0.01 and 0.9, first nine tenths of the schedule"
    return {
        what.format(arm): (value, value)
        for arm, value in (("consft", consft), ("consft_calibrated", calibrated))
    }


def kept(consft: Ends, calibrated: Ends, other: str = "sft", rung: str = "") -> Given:
    what = f"retained success, {{}}{rung} - {other}{rung}"
    return {what.format("consft"): consft, what.format("consft_calibrated"): calibrated}
