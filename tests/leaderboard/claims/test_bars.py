"""The bars of the rules: a verdict changes exactly where the rule says, a thousandth on either side of it."""

from types import SimpleNamespace
from typing import Any

import pytest
from stated_evidence import FORGETS, Ends, Figure, Given, Stated, judged, kept, shares

from clbench.scoring.intervals import Estimate

MODULE = "clbench.leaderboard.claims"

BOTH = shares(0.1, 0.1)
SFT: Given = {"retention of sft": (0.1, 0.2), "retention of sft@1": (0.1, 0.2)}
LESS = (0.1, 0.199)
AT_ONE = kept(LESS, LESS, rung="@1")
DROP = "retained success, pretrained - sft after the last target"
ANSWERS = "question accuracy, pretrained - {} after the last target"
EARLY = "success on the targets, mean over the evaluated steps, stop_gradient - sft"
LORA = ("lora", "lora+rank=4", "lora+rank=64")


def _lora(answers: tuple[Ends, Ends, Ends], skills: Ends = (-0.04, 0.1)) -> Given:
    found = {f"question retention, {label} - frozen": ends for label, ends in zip(LORA, answers, strict=True)}
    return {**found, **{f"retention, {label} - frozen": skills for label in LORA}}


def _drops(stop_gradient: Ends, sft: Ends = (0.011, 0.1)) -> Given:
    return {ANSWERS.format("stop_gradient"): stop_gradient, ANSWERS.format("sft"): sft}


def _costs(bytes_kept: float, added: float, time: Ends) -> Given:
    return {
        "bytes kept of consft": (bytes_kept, bytes_kept),
        "parameters added of consft": (added, added),
        "bytes kept of sft": (5, 5),
        "parameters added of sft": (5, 5),
        "time of consft": time,
    }


KEPT, LOST = (-0.009, 0.01), (-0.1, -0.011)
CASES: list[tuple[str, str, Given]] = [
    ("C1", "holds", {DROP: (0.051, 0.3)}),
    ("C1", "undecided", {DROP: (0.049, 0.3)}),
    ("C1", "undecided", {DROP: (0.0, 0.051)}),
    ("C1", "does not hold", {DROP: (0.0, 0.049)}),
    ("C2", "does not hold", {**BOTH, **SFT, **kept(LESS, LESS), **AT_ONE}),
    ("C2", "holds", {**BOTH, **SFT, **kept(LESS, (0.2, 0.3)), **AT_ONE}),
    ("C2", "undecided", {**BOTH, **SFT, **kept(LESS, (0.199, 0.3)), **AT_ONE}),
    ("C2", "holds in part", {**BOTH, **SFT, **kept(LESS, LESS), **kept((0.2, 0.3), LESS, rung="@1")}),
    ("C2", "undecided", {**BOTH, **SFT, **kept(LESS, LESS), **kept((0.199, 0.3), LESS, rung="@1")}),
    # an arm counts from a tenth of its weights on; one that does not may keep a claim from failing
    ("C2", "undecided", {**shares(0.1, 0.099), **SFT, **kept(LESS, (0.2, 0.3)), **AT_ONE}),
    ("C2", "does not hold", {**shares(0.1, 0.099), **SFT, **kept(LESS, LESS), **AT_ONE}),
    ("C2", "holds", {**shares(0.1, 0.099), **SFT, **kept((0.2, 0.3), LESS), **AT_ONE}),
    ("C2", "cannot be shown here", {**shares(0.099, 0.099), **SFT, **kept((0.2, 0.3), LESS), **AT_ONE}),
    (
        "C2",
        "undecided",
        {**shares(0.1, 0.099), **SFT, **kept(LESS, LESS), **kept(LESS, (0.2, 0.3), rung="@1")},
    ),
    # plain fine-tuning keeps too much at both settings
    *[
        (
            "C2",
            verdict,
            {**BOTH, **kept(LESS, LESS), **AT_ONE, "retention of sft": best, "retention of sft@1": at_one},
        )
        for best, at_one, verdict in (
            ((0.801, 0.9), (0.801, 0.9), "cannot be shown here"),
            ((0.801, 0.9), (0.799, 0.9), "does not hold"),
            ((0.799, 0.9), (0.801, 0.9), "does not hold"),
        )
    ],
    *[
        (
            "C3",
            verdict,
            {
                **BOTH,
                **kept(first, (-0.3, -0.051), "experience_replay"),
                **kept(second, (-0.3, 0.1), "buffered_replay"),
            },
        )
        for first, second, verdict in (
            ((-0.05, 0.1), (-0.05, 0.1), "holds"),
            ((-0.051, 0.1), (-0.05, 0.1), "undecided"),
            ((-0.05, 0.1), (-0.051, 0.1), "undecided"),
            ((-0.05, 0.1), (-0.3, -0.051), "does not hold"),
            ((-0.05, 0.1), (-0.3, -0.049), "undecided"),
        )
    ],
    *[
        (
            "C4",
            verdict,
            {
                **BOTH,
                "update sparsity, consft - sft": first,
                "update sparsity, consft_calibrated - sft": second,
                **({"update sparsity, sft@0.03 - sft@1": response} if response else {}),
            },
        )
        for first, second, response, verdict in (
            ((0.051, 0.2), (-0.1, 0.0), (0.0, 0.051), "holds"),
            ((0.049, 0.2), (-0.1, 0.0), (0.0, 0.051), "undecided"),
            ((-0.1, 0.049), (-0.1, 0.049), (0.0, 0.051), "does not hold"),
            ((-0.1, 0.051), (-0.1, 0.049), (0.0, 0.051), "undecided"),
            ((0.051, 0.2), (-0.1, 0.0), (0.0, 0.049), "cannot be shown here"),
            ((0.051, 0.2), (-0.1, 0.0), None, "undecided"),  # whether the measure responds is not known
            ((-0.1, 0.049), (-0.1, 0.049), None, "undecided"),
        )
    ],
    ("C6", "holds", _costs(5, 5, (1.0, 1.05))),
    ("C6", "undecided", _costs(5, 5, (1.0, 1.051))),
    ("C6", "does not hold", _costs(5, 5, (1.051, 1.1))),
    ("C6", "does not hold", _costs(6, 5, (1.0, 1.02))),
    ("C6", "does not hold", _costs(5, 6, (1.0, 1.02))),
    ("C6", "undecided", _costs(4, 5, (1.0, 1.02))),
    *[
        (
            "C7",
            verdict,
            {**BOTH, "backward transfer of consft": first, "backward transfer of consft_calibrated": second},
        )
        for first, second, verdict in (
            ((-0.1, 0.0), (-0.4, -0.2), "holds"),
            ((-0.101, 0.0), (-0.4, -0.2), "undecided"),
            ((-0.3, -0.101), (-0.4, -0.101), "does not hold"),
            ((-0.3, -0.099), (-0.4, -0.101), "undecided"),
        )
    ],
    *[
        (
            "C8",
            verdict,
            {
                **BOTH,
                "success on new targets, plain - perturbed, sft": loss,
                "loss in perturbed episodes, sft - consft": first,
                "loss in perturbed episodes, sft - consft_calibrated": second,
            },
        )
        for loss, first, second, verdict in (
            ((0.0, 0.049), (0.051, 0.1), (0.0, 0.0), "cannot be shown here"),
            ((0.0, 0.051), (0.051, 0.1), (0.0, 0.0), "holds"),
            ((0.0, 0.051), (0.049, 0.1), (0.0, 0.0), "undecided"),
            ((0.0, 0.051), (0.0, 0.049), (0.0, 0.049), "does not hold"),
            ((0.0, 0.051), (0.0, 0.051), (0.0, 0.049), "undecided"),
        )
    ],
    ("A2", "holds", {**_drops((0.0, 0.009)), EARLY: (-0.2, -0.051)}),
    ("A2", "undecided", {**_drops((0.0, 0.011)), EARLY: (-0.2, -0.051)}),
    ("A2", "undecided", {**_drops((0.0, 0.009)), EARLY: (-0.2, -0.049)}),
    ("A2", "does not hold", {**_drops((0.0, 0.009)), EARLY: (-0.049, 0.0)}),
    ("A2", "does not hold", {**_drops((0.011, 0.1)), EARLY: (-0.2, -0.051)}),
    ("A2", "cannot be shown here", {**_drops((0.0, 0.009), sft=(0.009, 0.1)), EARLY: (-0.2, -0.051)}),
    ("A3", "holds", _lora((LOST, LOST, LOST))),
    ("A3", "holds in part", _lora((LOST, LOST, (-0.1, -0.009)))),
    ("A3", "holds in part", _lora((KEPT, KEPT, LOST))),
    ("A3", "holds in part", _lora((KEPT, KEPT, KEPT), skills=(-0.2, -0.051))),
    ("A3", "undecided", _lora((KEPT, KEPT, KEPT), skills=(-0.051, -0.049))),
    ("A3", "does not hold", _lora((KEPT, KEPT, KEPT), skills=(-0.049, 0.0))),
    ("A3", "undecided", _lora((KEPT, KEPT, (-0.011, 0.01)))),
    *[
        (
            "A4",
            verdict,
            {"question retention, aegis - frozen": aegis, ANSWERS.format("sft"): sft},
        )
        for aegis, sft, verdict in (
            ((-0.01, 0.0), (0.011, 0.1), "holds"),
            ((-0.011, 0.0), (0.011, 0.1), "undecided"),
            ((-0.1, -0.011), (0.011, 0.1), "does not hold"),
            ((-0.01, 0.0), (0.009, 0.1), "cannot be shown here"),
        )
    ],
    *[
        ("A5", verdict, {"share of the energy that is shed, mean over steps, first stage": shed})
        for shed, verdict in (
            ((0.0, 0.0099), "holds"),
            ((0.0, 0.0101), "undecided"),
            ((0.0101, 0.1), "does not hold"),
        )
    ],
    ("F4", "holds", {"time of fast_dvla": (1.0, 1.05)}),
    ("F4", "undecided", {"time of fast_dvla": (1.0, 1.051)}),
    ("F4", "does not hold", {"time of fast_dvla": (1.051, 1.1)}),
    *[
        (
            "A6",
            verdict,
            {
                "distance of a batch to the anchor, aegis / aegis+direction=random": ratio,
                "distance that training moves the hidden states of questions, aegis / sft": drift,
            },
        )
        for ratio, drift, verdict in (
            ((0.1, 0.499), (0.1, 0.499), "holds"),
            ((0.1, 0.499), (0.1, 0.501), "holds in part"),
            ((0.1, 0.501), (0.1, 0.499), "undecided"),
            ((0.501, 0.9), (0.1, 0.499), "does not hold"),
        )
    ],
]


@pytest.mark.parametrize(
    ("identifier", "verdict", "given"), CASES, ids=[f"{case[0]}-{n}" for n, case in enumerate(CASES)]
)
def test_a_verdict_changes_at_the_bar_of_its_rule(identifier: str, verdict: str, given: Given) -> None:
    assert judged(identifier, given).verdict == verdict


@pytest.mark.parametrize(
    ("uses", "time", "verdict"),
    [
        ("prepare", (1.2, 1.6), "holds"),
        ("prepare", (1.2, 1.601), "undecided"),
        ("prepare", (1.199, 1.6), "undecided"),
        ("prepare", (1.0, 1.199), "does not hold"),
        ("prepare", (1.601, 1.8), "does not hold"),
        ("throughout", (1.2, 1.3), "does not hold"),
    ],
)
def test_the_cost_of_aegis_includes_a_buffer_in_any_run(uses: str, time: Ends, verdict: str) -> None:
    read = [{"demonstrations": "never", "questions": one} for one in ("prepare", uses)]
    record = [SimpleNamespace(run=SimpleNamespace(uses=one)) for one in read]
    runs = {"aegis": {seed: SimpleNamespace(record=one) for seed, one in enumerate(record)}}
    finding = judged("A7", {"time of aegis": time}, runs)
    assert finding.verdict == verdict
    assert finding.change.startswith("Runs whose stages read no prior data.") == (uses == "throughout")


@pytest.mark.parametrize(
    ("demonstrations", "questions", "verdict"),
    [
        ("never", "never", "holds"),
        ("prepare", "never", "does not hold"),
        ("never", "throughout", "does not hold"),
    ],
)
def test_consft_needs_no_data_only_if_no_run_reads_any(
    demonstrations: str, questions: str, verdict: str
) -> None:
    uses = {"demonstrations": demonstrations, "questions": questions, "reference": False}
    record = SimpleNamespace(run=SimpleNamespace(uses=uses))
    runs = {"consft": {0: SimpleNamespace(record=record)}}
    finding = judged("C6", _costs(5, 5, (1.0, 1.05)), runs)
    assert finding.verdict == verdict
    assert finding.change.startswith("Runs that keep, add and read no more") == (verdict == "does not hold")


def test_what_would_change_a_verdict_is_the_figure_nearest_to_the_bar() -> None:
    at_one = kept((-0.1, 0.19), LESS, rung="@1")
    best = kept((0.0, 0.1), (-0.1, 0.05))
    finding = judged("C2", {**BOTH, **SFT, **best, **at_one})
    assert finding.verdict == "does not hold"
    assert '"retained success, consft_calibrated@1 - sft@1" would have to move by 0.00' in finding.change


def test_an_undecided_verdict_hangs_on_the_largest_figure_that_is_open() -> None:
    best = kept((-0.19, 0.29), (-0.1, 0.05))
    at_one = kept(LESS, (-0.09, 0.62), rung="@1")
    finding = judged("C2", {**BOTH, **SFT, **best, **at_one})
    assert finding.verdict == "undecided"
    assert '"retained success, consft_calibrated@1 - sft@1"' in finding.change


@pytest.mark.parametrize(
    ("identifier", "given", "named"),
    [
        ("A2", {**_drops((0.0, 0.009)), EARLY: (-0.049, 0.0)}, EARLY),
        ("A2", {**_drops((0.011, 0.1)), EARLY: (-0.2, 0.0)}, ANSWERS.format("stop_gradient")),
        ("A2", {**_drops((0.0, 0.011)), EARLY: (-0.2, -0.051)}, ANSWERS.format("stop_gradient")),
        ("A2", {**_drops((0.0, 0.009)), EARLY: (-0.2, -0.049)}, EARLY),
        ("A3", _lora((LOST, LOST, LOST)), "question retention, lora+rank=4 - frozen"),
        ("A3", _lora((KEPT, KEPT, (-0.011, 0.01))), "question retention, lora+rank=64 - frozen"),
        ("A3", _lora((LOST, LOST, (-0.1, -0.009))), "question retention, lora+rank=64 - frozen"),
        ("A3", _lora((KEPT, KEPT, KEPT), skills=(-0.051, -0.049)), "retention, lora+rank=4 - frozen"),
    ],
)
def test_what_would_change_a_verdict_is_what_decides_it(identifier: str, given: Given, named: str) -> None:
    assert f'"{named}"' in judged(identifier, given).change


def test_the_worse_replay_decides() -> None:
    good, bad = (-0.05, 0.1), (-0.3, -0.06)
    given = {**kept(good, good, "experience_replay"), **kept(bad, bad, "buffered_replay")}
    finding = judged("C3", {**BOTH, **given})
    assert finding.verdict == "does not hold"
    assert '- buffered_replay" would have to move by' in finding.change


@pytest.mark.parametrize(("own", "shown"), [(0.1, True), (0.3, False)])
def test_consft_is_also_compared_with_plain_fine_tuning_at_its_own_learning_rate(
    own: float, shown: bool
) -> None:
    def run(factor: float) -> SimpleNamespace:
        settings = {"step_factor": factor}
        return SimpleNamespace(record=SimpleNamespace(run=SimpleNamespace(settings=settings)))

    runs = {label: {0: run(factor)} for label, factor in (("sft", own), ("consft", 0.3), ("sft@0.3", 0.3))}
    kept = {"retained success, consft - sft": (0.0, 0.1)}
    moved = {"backward transfer of consft": (-0.1, 0.0)}
    for identifier, given, what in (("C2", kept, "retained success"), ("C7", moved, "backward transfer")):
        names = [figure.what for figure in judged(identifier, {**BOTH, **given}, runs).controls]
        assert (f"{what}, consft - sft@0.3" in names) is shown


@pytest.mark.parametrize(("factor", "control"), [(0.1, "sft"), (0.101, "sft@0.03")])
def test_plain_fine_tuning_that_is_tuned_to_small_steps_is_its_own_control(
    factor: float, control: str
) -> None:
    settings = {"step_factor": factor}
    run = SimpleNamespace(record=SimpleNamespace(run=SimpleNamespace(settings=settings)))
    given: Given = {
        **BOTH,
        "update sparsity, consft - sft": (-0.1, 0.0),
        "update sparsity, consft_calibrated - sft": (-0.1, 0.0),
        f"update sparsity, {control} - sft@1": (0.0, 0.049),
    }
    assert judged("C4", given, {"sft": {0: run}}).verdict == "cannot be shown here"


@pytest.mark.parametrize(
    ("steps", "verdict"),
    [((10, 50, 100), "holds"), ((10, 60, 100), "holds in part"), ((60, 100), "undecided")],
)
def test_a_loss_after_half_of_the_stage_is_not_rapid_if_somebody_looked_before(
    steps: tuple[int, ...], verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, lost = (Figure("a point", ("sft",), Estimate(0.1, low, 0.2), (0, 1)) for low in (0.0, 0.05))
    points = [kept, lost, lost][-len(steps) :]
    monkeypatch.setattr(f"{MODULE}.aegis.answer_curve", lambda _, method: points if method == "sft" else [])
    monkeypatch.setattr(f"{MODULE}.aegis.learning_curve", lambda *_: (steps, [0.5] * len(steps)))
    assert judged("A1", {ANSWERS.format("sft"): (0.05, 0.2)}).verdict == verdict


def test_only_a_method_that_certainly_keeps_more_answers_than_plain_fine_tuning_is_said_to() -> None:
    given = _lora(((-0.05, -0.02), (-0.04, -0.019), LOST))
    given["question retention, sft - frozen"] = (-0.2, -0.045)
    assert judged("A3", given).sentences == (
        "lora+rank=4: fewer answers are lost than with sft.",
        "The direction of the update was not measured.",
    )


# ---- claims of how fast a target is learned ----------------------------------------------------------------

CO_TRAINING, SFT_STEPS = "co_training+step_factor=1.0", "steps to the criterion, {} / sft@1"
RANDOM = "steps to the criterion, fast_dvla@1 / fast_dvla+direction=random+step_factor=1.0"
WITHOUT = "steps to the criterion, fast_dvla@1 / fast_dvla+orthogonal=0.0+step_factor=1.0"
OBJECTIVE = f"steps to the criterion, fast_dvla@1 / {CO_TRAINING}"
HELPS: Given = {SFT_STEPS.format(CO_TRAINING): (0.5, 0.95)}
REPLACED: Given = {**HELPS, OBJECTIVE: (0.9, 1.049)}
NO_HELP: Given = {SFT_STEPS.format(CO_TRAINING): (0.951, 1.0)}
VECTOR = SFT_STEPS.format("fast_dvla@1")
FAST, SLOW, OPEN = (0.5, 0.949), (0.951, 1.2), (0.949, 0.951)
SAVED, TIME = SFT_STEPS.format(CO_TRAINING), f"time of {CO_TRAINING}"


@pytest.mark.parametrize(
    ("identifier", "verdict", "given", "median"),
    [
        ("F1", "holds", {SAVED: FAST, TIME: (1.101, 1.2)}, 20),
        ("F1", "holds in part", {SAVED: FAST, TIME: (1.099, 1.2)}, 20),
        ("F1", "does not hold", {SAVED: SLOW}, 20),
        ("F1", "undecided", {SAVED: OPEN}, 20),
        ("F1", "cannot be shown here", {SAVED: OPEN}, 19.5),
        ("F1", "does not hold", {SAVED: SLOW}, 19.5),
        ("F2", "holds", {**REPLACED, VECTOR: FAST, RANDOM: FAST}, 20),
        ("F2", "undecided", {**REPLACED, VECTOR: FAST, RANDOM: OPEN}, 20),
        ("F2", "undecided", {**REPLACED, VECTOR: OPEN, RANDOM: FAST}, 20),
        ("F2", "does not hold", {**REPLACED, VECTOR: SLOW, RANDOM: FAST}, 20),
        ("F2", "does not hold", {**REPLACED, VECTOR: FAST, RANDOM: SLOW}, 20),
        ("F2", "undecided", {**REPLACED, VECTOR: FAST, RANDOM: FAST, OBJECTIVE: (0.9, 1.051)}, 20),
        ("F2", "does not hold", {**REPLACED, VECTOR: FAST, RANDOM: FAST, OBJECTIVE: (1.051, 1.2)}, 20),
        ("F2", "cannot be shown here", {**REPLACED, **NO_HELP, VECTOR: FAST, RANDOM: FAST}, 20),
        ("F2", "cannot be shown here", {**REPLACED, VECTOR: OPEN, RANDOM: FAST}, 19.5),
        ("F2", "holds", {**REPLACED, VECTOR: FAST, RANDOM: FAST}, 19.5),
        ("F3", "holds", {**HELPS, WITHOUT: FAST}, 20),
        ("F3", "undecided", {**HELPS, WITHOUT: OPEN}, 20),
        ("F3", "does not hold", {**HELPS, WITHOUT: SLOW}, 20),
        ("F3", "cannot be shown here", {**NO_HELP, WITHOUT: FAST}, 20),
        ("F5", "holds", {**HELPS, RANDOM: FAST, VECTOR: FAST}, 20),
        ("F5", "does not hold", {**HELPS, RANDOM: FAST, VECTOR: SLOW}, 20),
        ("F5", "undecided", {**HELPS, RANDOM: OPEN, VECTOR: FAST}, 20),
        ("F5", "does not hold", {**HELPS, RANDOM: SLOW, VECTOR: FAST}, 20),
        ("F5", "cannot be shown here", {**NO_HELP, RANDOM: FAST, VECTOR: FAST}, 20),
    ],
)
def test_a_saving_of_steps_counts_from_a_twentieth_on(
    identifier: str, verdict: str, given: Given, median: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Figure("median", ("sft@1",), Estimate(median, None, None))
    monkeypatch.setattr(f"{MODULE}.fast_dvla.median_stage", lambda *_: stage)
    assert judged(identifier, {**FORGETS, **given}).verdict == verdict


def test_a_random_vector_that_is_as_good_decides_on_the_vector(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Figure("median", ("sft@1",), Estimate(20, None, None))
    monkeypatch.setattr(f"{MODULE}.fast_dvla.median_stage", lambda *_: stage)
    assert f'"{RANDOM}"' in judged("F2", {**FORGETS, **REPLACED, VECTOR: FAST, RANDOM: SLOW}).change
    assert f'"{VECTOR}"' in judged("F2", {**FORGETS, **REPLACED, VECTOR: SLOW, RANDOM: FAST}).change


@pytest.mark.parametrize(("time", "says"), [((1.06, 1.2), True), ((1.04, 1.2), False)])
def test_steps_are_said_to_cost_more_time_in_all_only_where_both_lower_ends_do(
    time: Ends, says: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = Figure("median", ("sft@1",), Estimate(20, None, None))
    monkeypatch.setattr(f"{MODULE}.fast_dvla.median_stage", lambda *_: stage)
    finding = judged("F1", {**FORGETS, SAVED: SLOW, TIME: time})
    assert ("The steps to the criterion certainly cost more time in all." in finding.sentences) is says


# ---- claims of a curve of answers --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("curve", "end", "verdict"),
    [
        (((0.0, 0.1), (0.011, 0.1), (0.02, 0.1)), (0.02, 0.1), "holds"),
        (((0.0, 0.1), (0.009, 0.1), (0.02, 0.1)), (0.011, 0.1), "holds in part"),
        (((0.0, 0.1), (0.009, 0.1), (0.02, 0.1)), (0.009, 0.1), "undecided"),
        (((0.0, 0.1), (0.009, 0.1), (0.0, 0.1)), (0.0, 0.009), "does not hold"),
    ],
)
def test_answers_are_lost_rapidly_where_some_are_before_the_end_of_the_stage(
    curve: tuple[Ends, ...], end: Ends, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answers(evidence: Stated, method: str) -> list[Any]:
        points = [Figure("a point", (method,), Estimate(ends[0], *ends), (0, 1)) for ends in curve]
        return points if method == "sft" else []

    monkeypatch.setattr(f"{MODULE}.aegis.answer_curve", answers)
    monkeypatch.setattr(f"{MODULE}.aegis.learning_curve", lambda *_: ((25, 50, 100), [0.89, 0.9, 1.0]))
    finding = judged("A1", {ANSWERS.format("sft"): end})
    assert finding.verdict == verdict
    lost = next((step for step, ends in zip((25, 50, 100), curve, strict=True) if ends[0] > 0.01), None)
    says = (
        "sft does the target in 0.9 of the episodes after 50 steps; it has certainly lost 0.01 of the "
        f"answers after {lost} of 100 steps."
    )
    assert finding.sentences == ((says,) if lost else ())
