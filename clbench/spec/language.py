"""Words to ids: one tokenizer over a vocabulary that is fixed before any scenario is known.

A word of the vocabulary is one token. Any other word is spelled with pieces of words, longest first
(WordPiece, Wu et al. 2016, arXiv 1609.08144), so that instructions and questions may hold any English word.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING

from tokenizers import Tokenizer, models, normalizers, pre_tokenizers

from clbench.base.errors import InputError
from clbench.base.text import did_you_mean

if TYPE_CHECKING:  # PyTorch takes seconds to import, and environments do not need it
    from torch import Tensor

LENGTHS = (12, 24, 48)
"""Lengths of texts in tokens. A scenario uses the shortest one that all its texts fit, so that every forward
has one shape."""

TEXT_LENGTH = LENGTHS[0]
"""Length of the texts of the built-in scenarios."""

VOCABULARY_SIZE = 1024
"""Rows of the embedding and of the answer layer; there are fewer words and pieces. A new suite appends its
words to the vocabulary, which changes neither the shapes nor the initial weights of a policy."""

PADDING = "[padding]"


class UnknownWordError(InputError):
    """A word cannot be spelled, a text has too many tokens, or an answer is not in the vocabulary."""


@cache
def vocabulary() -> tuple[str, ...]:
    """Return the words in the order of their ids; id 0 is the padding."""
    text = files("clbench.spec").joinpath("vocabulary.txt").read_text(encoding="utf-8")
    return (PADDING, *text.split())


@cache
def pieces() -> tuple[str, ...]:
    """Return the pieces of words; those that continue a word begin with "##". The first has the last id."""
    return tuple(files("clbench.spec").joinpath("pieces.txt").read_text(encoding="utf-8").split())


@cache
def _ids() -> dict[str, int]:
    ids = {word: number for number, word in enumerate(vocabulary())}
    # counted from the end: new words do not move them
    return ids | {piece: VOCABULARY_SIZE - 1 - number for number, piece in enumerate(pieces())}


@cache
def _tokens() -> dict[int, str]:
    return {number: token for token, number in _ids().items()}


@cache
def _tokenizer(length: int) -> Tokenizer:
    tokenizer = Tokenizer(models.WordPiece(_ids(), unk_token=PADDING))
    tokenizer.normalizer = _normalizer()
    tokenizer.pre_tokenizer = _splitter()
    tokenizer.enable_padding(length=length, pad_id=0, pad_token=PADDING)
    return tokenizer


def encode(texts: Sequence[str], length: int = TEXT_LENGTH) -> Tensor:
    """Return the ids (len(texts), length), int64, of `texts`. Case, accents and punctuation do not count.

    Raises:
        UnknownWordError: A word cannot be spelled, or there are more than `length` tokens.
    """
    import torch

    return torch.tensor(word_ids(texts, length), dtype=torch.int64)


def word_ids(texts: Sequence[str], length: int = TEXT_LENGTH) -> list[list[int]]:
    """Return the result of `encode` as lists.

    Raises:
        UnknownWordError: A word cannot be spelled, or there are more than `length` tokens.
    """
    rows = []
    for text, encoding in zip(texts, _tokenizer(length).encode_batch(list(texts)), strict=True):
        tokens = [
            (text[start:end], number)
            for (start, end), number in zip(encoding.offsets, encoding.ids, strict=True)
            if end > start
        ]
        for word, number in tokens:
            if number == 0:
                raise UnknownWordError(f"{word!r} in {text!r} cannot be spelled with English letters.")
        if not 0 < len(tokens) <= length:
            raise UnknownWordError(
                f"{text!r} has {len(tokens)} words or pieces of words; the policy reads 1 to {length}."
            )
        rows.append(encoding.ids)
    return rows


def decode(words: Tensor) -> list[str]:
    """Return the texts of word ids (B, L), for a policy with a tokenizer of its own.

    They are in lower case, and without accents and punctuation.
    """
    tokens = _tokens()
    return [" ".join(tokens[one] for one in row if one).replace(" ##", "") for row in words.tolist()]


@lru_cache(maxsize=64)
def fitting_length(texts: tuple[str, ...]) -> int:
    """Return the shortest of `LENGTHS` that all texts fit.

    Raises:
        UnknownWordError: A word cannot be spelled, or a text has more tokens than the greatest length.
    """
    longest = max((sum(number > 0 for number in row) for row in word_ids(texts, LENGTHS[-1])), default=0)
    return next(length for length in LENGTHS if longest <= length)


def spelled_words(texts: Iterable[str]) -> list[str]:
    """Return the normalized words in `texts` that the vocabulary does not have, each once."""
    read = map(_normalizer().normalize_str, texts)
    words = (word for text in read for word, _ in _splitter().pre_tokenize_str(text))
    return [word for word in dict.fromkeys(words) if word not in vocabulary()]


@cache
def _normalizer() -> normalizers.Normalizer:
    return normalizers.Sequence([normalizers.NFKD(), normalizers.StripAccents(), normalizers.Lowercase()])


@cache
def _splitter() -> pre_tokenizers.PreTokenizer:
    return pre_tokenizers.Sequence(
        [pre_tokenizers.WhitespaceSplit(), pre_tokenizers.Punctuation(behavior="removed")]
    )


def word_id(word: str) -> int:
    """Return the id of a single word of the vocabulary.

    Raises:
        UnknownWordError: The vocabulary does not have it.
    """
    known = word.lower()
    if known not in vocabulary()[1:]:
        hint = did_you_mean(known, vocabulary()[1:])
        raise UnknownWordError(f"The word {word!r} is not in the vocabulary.{hint}")
    return vocabulary().index(known)
