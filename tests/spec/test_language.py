import pytest
from hypothesis import given
from hypothesis import strategies as st

from clbench.base.entry_points import resolve
from clbench.spec.language import (
    LENGTHS,
    TEXT_LENGTH,
    VOCABULARY_SIZE,
    UnknownWordError,
    decode,
    encode,
    fitting_length,
    pieces,
    spelled_words,
    vocabulary,
    word_id,
    word_ids,
)
from clbench.spec.registry import load_scenario


def test_words_become_the_ids_of_the_vocabulary_padded_with_zero() -> None:
    ids = encode(["push the block"])
    assert ids.shape == (1, TEXT_LENGTH)
    assert [vocabulary()[number] for number in ids[0, :3].tolist()] == ["push", "the", "block"]
    assert not ids[0, 3:].any()


def test_case_accents_and_punctuation_do_not_count() -> None:
    assert encode(["Push the block!"]).equal(encode(["push the  block"]))
    assert encode(["Fetch the caf\u00e9"]).equal(encode(["fetch the cafe"]))


def test_a_word_outside_the_vocabulary_is_spelled_with_the_longest_pieces_first() -> None:
    known = {VOCABULARY_SIZE - 1 - number: piece for number, piece in enumerate(pieces())}
    row = encode(["the zoning"])[0].tolist()
    assert [known[number] for number in row[1:] if number in known] == ["z", "##on", "##ing"]
    assert spelled_words(["push the zoning", "Zoning!"]) == ["zoning"]


@given(st.lists(st.text("abcdefghijklmnopqrstuvwxyz0123456789", min_size=1, max_size=20), min_size=1))
def test_any_english_word_can_be_read_back_from_its_tokens(words: list[str]) -> None:
    known = dict(enumerate(vocabulary())) | {
        VOCABULARY_SIZE - 1 - number: piece for number, piece in enumerate(pieces())
    }
    for word in words:
        tokens = [known[number] for number in word_ids([word], LENGTHS[-1])[0] if number]
        assert "".join(token.removeprefix("##") for token in tokens) == word
        assert (len(tokens) == 1) == (word in known.values())


def test_pieces_and_words_share_no_id() -> None:
    assert len(set(pieces())) == len(pieces()) <= VOCABULARY_SIZE - len(vocabulary())
    assert all(piece.startswith("##") or piece not in vocabulary() for piece in pieces())


def test_texts_are_read_back_without_case_accents_and_punctuation() -> None:
    assert decode(encode(["Push the block, please!", "the zoning zebra-caf\u00e9"])) == [
        "push the block please",
        "the zoning zebra cafe",
    ]


@given(
    st.lists(st.text("abcdefghijklmnopqrstuvwxyz0123456789", min_size=1, max_size=5), min_size=1, max_size=9)
)
def test_any_english_text_can_be_read_back_from_its_ids(words: list[str]) -> None:
    assert decode(encode([" ".join(words)], LENGTHS[-1])) == [" ".join(words)]


def test_a_word_of_other_letters_is_named() -> None:
    with pytest.raises(
        UnknownWordError, match="'\u043a\u0443\u0431' in 'push the \u043a\u0443\u0431' cannot be spelled"
    ):
        encode(["push the block", "push the \u043a\u0443\u0431"])


def test_a_word_is_looked_up_as_it_is_read_without_accents_and_ligatures() -> None:
    assert spelled_words(["push the bl\u00f3ck", "\ufb01nd the Z\u00f3ning"]) == ["zoning"]
    assert word_ids(["push the bl\u00f3ck"]) == word_ids(["push the block"])


def test_the_padding_is_no_answer_and_is_not_proposed() -> None:
    with pytest.raises(
        UnknownWordError, match=r"The word '\[padding\]' is not in the vocabulary\."
    ) as raised:
        word_id("[padding]")
    assert "Did you mean '[padding]'" not in str(raised.value)


def test_an_answer_outside_the_vocabulary_is_named_with_the_nearest() -> None:
    with pytest.raises(UnknownWordError, match=r"The word 'blokc' is not .* Did you mean 'block'\?"):
        word_id("blokc")


@pytest.mark.parametrize("length", LENGTHS)
def test_a_text_without_words_or_with_too_many_is_refused(length: int) -> None:
    for text in ("", " ", " ".join(["block"] * (length + 1))):
        with pytest.raises(UnknownWordError, match=f"the policy reads 1 to {length}"):
            encode([text], length)


def test_the_length_of_texts_is_the_shortest_that_all_fit() -> None:
    assert [fitting_length(("push", " ".join(["block"] * count))) for count in (12, 13, 24, 25, 48)] == [
        12,
        24,
        24,
        48,
        48,
    ]
    with pytest.raises(UnknownWordError, match="has 49 words or pieces of words; the policy reads 1 to 48"):
        fitting_length((" ".join(["block"] * 49),))


def test_the_vocabulary_has_each_word_once() -> None:
    assert len(set(vocabulary())) == len(vocabulary()) <= VOCABULARY_SIZE
    assert word_id("block") == vocabulary().index("block")


def test_the_vocabulary_covers_every_instruction_question_and_answer_of_the_fetch_scenario() -> None:
    scenario = load_scenario("clbench/Fetch-v1")
    for task in scenario.tasks:
        assert spelled_words(task.instructions) == []
    for kind in resolve(scenario.questions):
        assert spelled_words([*kind.wordings, *kind.answers]) == []
