import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from clbench.base.errors import InputError
from clbench.data.demonstrations import dataset_id
from clbench.data.questions import (
    QuestionKind,
    Questions,
    load_questions,
    scenes_folder,
    scored_questions,
    sign,
    which,
)
from clbench.spec.language import word_id
from clbench.spec.registry import load_scenario

TOY = load_scenario("clbench.testing:clbench/Toy-v0")
FETCH = load_scenario("clbench/Fetch-v1")


def test_an_answer_is_the_first_truth_that_holds_and_none_in_close_cases() -> None:
    first, second = np.array([True, False, True, False]), np.array([False, True, True, False])
    assert which(first, second).tolist() == [0, 1, 0, -1]
    assert sign(np.array([0.3, -0.3, 0.2, -0.2, 0.1], np.float32), 0.25).tolist() == [0, 1, -1, -1, -1]


def test_every_kind_and_every_answer_of_it_is_as_frequent_and_right() -> None:
    train, _ = load_questions(TOY)
    batch = train.sample(4000, torch.Generator().manual_seed(0))
    counts = {
        answer: int((batch.answer == word_id(answer)).sum()) for answer in ("left", "right", "below", "above")
    }
    assert all(900 < count < 1100 for count in counts.values()), counts
    right = batch.answer == word_id("right")
    left = batch.answer == word_id("left")
    assert (batch.state[right, 0] > batch.state[right, 2]).all()
    assert (batch.state[left, 0] < batch.state[left, 2]).all()


def test_test_questions_are_about_other_episodes_than_training() -> None:
    train, report = load_questions(TOY)
    markers = [{tuple(row) for row in questions.scenes[:, 2:].tolist()} for questions in (train, report)]
    assert len(markers[0]) == 40
    assert len(markers[1]) == 10
    assert not markers[0] & markers[1]


def test_two_numbers_of_question_episodes_never_share_scenes(empty_caches: Path) -> None:
    half = dataclasses.replace(TOY, budget=dataclasses.replace(TOY.budget, question_episodes=20))
    folders = [scenes_folder(one) for one in (TOY, half)]
    whole, part = (load_file(folder / "scenes.safetensors")["train"] for folder in folders)
    assert len(whole) > len(part)
    assert whole[: len(part)].equal(part)


def test_the_answers_of_a_kind_are_as_frequent_whatever_the_number_of_answers_of_the_others() -> None:
    def third(states: Any) -> Any:
        return np.arange(len(states)) % 3

    def half(states: Any) -> Any:
        return np.arange(len(states)) % 2

    kinds = (
        QuestionKind("side", ("which side",), ("left", "right"), half),
        QuestionKind("place", ("where is it",), ("above", "below", "left"), third),
    )
    questions = Questions(kinds, torch.zeros(60, 4))
    batch = questions.ask(torch.ones(3000, dtype=torch.int64), torch.Generator().manual_seed(0))
    counts = [int((batch.answer == word_id(answer)).sum()) for answer in kinds[1].answers]
    assert all(900 < count < 1100 for count in counts), counts


def test_an_answer_is_asked_about_every_state_that_gives_it() -> None:
    kind = QuestionKind(
        "side", ("which side",), ("left", "right"), lambda states: states[:, 0].astype(int) % 2
    )
    questions = Questions((kind,), torch.arange(20.0)[:, None])
    batch = questions.ask(torch.zeros(1000, dtype=torch.int64), torch.Generator().manual_seed(0))
    assert sorted(set(batch.state[:, 0].tolist())) == list(range(20))


def test_every_evaluation_asks_the_same_questions_as_many_of_each_kind() -> None:
    _, report = load_questions(TOY)
    (kind, first), (_, second) = scored_questions(report, 50), scored_questions(report, 50)
    assert first.state.equal(second.state)
    assert torch.bincount(kind).tolist() == [25, 25]


def test_an_answer_that_no_state_gives_is_named() -> None:
    kind = QuestionKind(
        "place", ("where is it",), ("left", "right"), lambda states: np.zeros(len(states), np.int64)
    )
    with pytest.raises(
        ValueError,
        match=r"No state gives the answer 'right' to the question 'place': 'where is it'\. "
        "There are 5 states here; more question_episodes",
    ):
        Questions((kind,), torch.zeros(5, 4))


@pytest.mark.parametrize(("wordings", "answers"), [((), ("left",)), (("where is it",), ())])
def test_a_kind_of_question_needs_a_wording_and_an_answer(
    wordings: tuple[str, ...], answers: tuple[str, ...]
) -> None:
    with pytest.raises(InputError, match="The kind of question 'place' needs a wording and an answer"):
        QuestionKind("place", wordings, answers, lambda states: np.zeros(len(states), np.int64))


@pytest.mark.long
def test_fetch_questions_have_balanced_answers_for_training_and_test() -> None:
    few = dataclasses.replace(FETCH, budget=dataclasses.replace(FETCH.budget, question_episodes=96))
    for questions in load_questions(few):
        kind, batch = scored_questions(questions, 1400)
        for index, entry in enumerate(questions.kinds):
            for answer in entry.answers:
                share = float((batch.answer[kind == index] == word_id(answer)).float().mean())
                assert share == pytest.approx(1 / len(entry.answers), abs=0.2)


def test_the_scored_questions_stay_those_of_the_published_records() -> None:
    _, asked = scored_questions(load_questions(TOY)[1], 12)
    assert asked.answer.tolist() == [266, 3, 408, 50, 408, 50, 408, 3, 408, 50, 266, 3]


@pytest.mark.parametrize("name", ["source_hash", "simulator_versions"])
def test_scenes_and_demonstrations_of_other_code_or_versions_are_made_anew(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, budget = TOY.task("left"), TOY.budget
    before = dataset_id(left, budget), scenes_folder(TOY)
    for module in ("demonstrations", "questions"):
        monkeypatch.setattr(f"clbench.data.{module}.{name}", lambda *_: {"other": "1"})
    after = dataset_id(left, budget), scenes_folder(TOY)
    assert before[0] != after[0]
    assert before[1] != after[1]
