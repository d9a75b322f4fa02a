"""Claims of AEGIS: what a page says of a method that was not tuned."""

import pytest
from claims_bench import Bench

from clbench.records.record import Record
from clbench.runs.tuning import tuned

AEGIS = "clbench.leaderboard.claims.aegis"


def test_the_learning_rate_of_a_method_that_was_not_tuned_is_compared_with_tuned_ones(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_a_high_rate(record: Record) -> None:
        record.scenario.budget["learning_rate"] = 3e-3

    for method in ("sft", "frozen", "lora", "aegis"):
        bench.add(method, right=(500, 400), edit=at_a_high_rate)
    untuned = [one for name in ("A3", "A4") for one in bench.judge(name).sentences if "not tuned" in one]
    # 3e-4 is the rate of these scenarios; lora: 0.1 of it on Fetch-v1, all of it on PointMaze-v1, 0.03 on
    # MetaWorld-v1; aegis: 0.055, 0.03 and 0.0165
    assert untuned == [
        "lora was not tuned here: its learning rate is 10 to 333 times those that tuning chose elsewhere.",
        "aegis was not tuned here: its learning rate is 182 to 606 times those that tuning chose elsewhere. "
        "It may keep answers at smaller rates.",
    ]
    everywhere = {name: tuned("clbench/Fetch-v1")[name] for name in ("lora", "aegis")}
    monkeypatch.setattr(f"{AEGIS}.tuned", lambda table: everywhere)
    tuned_here = [one for name in ("A3", "A4") for one in bench.judge(name).sentences]
    assert not any("not tuned" in one for one in tuned_here)


def test_a_learning_rate_is_compared_where_the_packages_of_tuned_scenarios_are_missing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.add("lora")
    monkeypatch.setattr("clbench.base.dependencies.is_installed", lambda package: False)
    assert bench.judge("A3").verdict == "undecided"


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (0.1, "its learning rate is one that tuning chose elsewhere."),
        (0.05, "its learning rate is 0.5 times those that tuning chose elsewhere."),
        (
            0.33,
            "its learning rate is 3 times those that tuning chose elsewhere. It may keep answers at",
        ),
    ],
)
def test_only_a_higher_learning_rate_is_said_to_leave_room_below(
    factor: float, says: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_a_rate(record: Record) -> None:
        record.scenario.budget["learning_rate"] = 3e-4 * factor

    tuned_there = tuned("clbench/Fetch-v1")["lora"]  # a tenth of 3e-4
    monkeypatch.setattr(f"{AEGIS}.tuned_scenarios", lambda: ["clbench/Fetch-v1"])
    monkeypatch.setattr(
        f"{AEGIS}.tuned", lambda table: {"aegis": tuned_there} if table == "clbench/Fetch-v1" else {}
    )
    for method in ("sft", "frozen", "aegis"):
        bench.add(method, right=(500, 400), edit=at_a_rate)
    (said,) = (one for one in bench.judge("A4").sentences if "not tuned" in one)
    assert says in said
    assert ("It may keep" in said) is ("It may keep" in says)
