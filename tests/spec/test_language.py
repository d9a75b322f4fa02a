import pytest

from clbench.base.entry_points import resolve
from clbench.spec.language import TEXT_LENGTH, VOCABULARY_SIZE, UnknownWordError, encode, vocabulary, word_id
from clbench.spec.registry import load_scenario


def test_words_become_the_ids_of_the_vocabulary_padded_with_zero() -> None:
    ids = encode(["push the block"])
    assert ids.shape == (1, TEXT_LENGTH)
    assert [vocabulary()[number] for number in ids[0, :3].tolist()] == ["push", "the", "block"]
    assert not ids[0, 3:].any()


def test_case_and_punctuation_do_not_count() -> None:
    assert encode(["Push the block!"]).equal(encode(["push the  block"]))


def test_an_unknown_word_is_named_with_the_nearest() -> None:
    with pytest.raises(
        UnknownWordError, match=r"The word 'blokc' in 'push the blokc' .* Did you mean 'block'\?"
    ):
        encode(["push the block", "push the blokc"])


@pytest.mark.parametrize("text", ["", " ", " ".join(["block"] * (TEXT_LENGTH + 1))])
def test_a_text_without_words_or_with_too_many_is_refused(text: str) -> None:
    with pytest.raises(UnknownWordError, match="the policy reads 1 to 12"):
        encode([text])


def test_the_vocabulary_has_each_word_once() -> None:
    assert len(set(vocabulary())) == len(vocabulary()) <= VOCABULARY_SIZE
    assert word_id("block") == vocabulary().index("block")


def test_the_vocabulary_covers_every_instruction_question_and_answer_of_the_fetch_scenario() -> None:
    scenario = load_scenario("clbench/Fetch-v1")
    for task in scenario.tasks:
        encode(task.instructions)
    for kind in resolve(scenario.questions):
        encode(kind.wordings)
        encode(kind.answers)
