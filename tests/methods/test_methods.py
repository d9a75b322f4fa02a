"""What each method is for, shown on the toy."""

import pytest

from clbench.metrics import measure
from clbench.run import RunSpec, execute
from clbench.scores import Scores

TOY = "clbench.testing:clbench/Toy-v0"
METHODS = ("sft", "experience_replay", "joint", "frozen", "from_scratch")


@pytest.fixture(scope="module")
def scores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Scores]:
    records = tmp_path_factory.mktemp("records")
    return {method: Scores.from_record(execute(RunSpec(TOY, method, 0), records)) for method in METHODS}


def _value(scores: dict[str, Scores], method: str, metric: str) -> float:
    value = measure(metric, scores[method])
    assert value is not None
    return value


def test_sft_learns_the_targets_and_forgets_the_skills(scores: dict[str, Scores]) -> None:
    assert _value(scores, "sft", "adaptation") >= 0.9
    assert _value(scores, "sft", "retention") <= 0.2


def test_replay_keeps_skills_that_sft_loses(scores: dict[str, Scores]) -> None:
    assert _value(scores, "experience_replay", "retention") > _value(scores, "sft", "retention") + 0.2


def test_joint_keeps_the_answers(scores: dict[str, Scores]) -> None:
    assert _value(scores, "joint", "question_retention") >= 0.9


def test_frozen_forgets_exactly_nothing_and_learns_nothing(scores: dict[str, Scores]) -> None:
    assert _value(scores, "frozen", "forgetting") == 0.0
    assert _value(scores, "frozen", "adaptation") == 0.0
    assert _value(scores, "frozen", "retention") == 1.0


def test_from_scratch_knows_nothing_but_the_last_target(scores: dict[str, Scores]) -> None:
    assert _value(scores, "from_scratch", "retention") == 0.0
    assert _value(scores, "from_scratch", "question_retention") < 0.2
