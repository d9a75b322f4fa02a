"""Words to ids: one tokenizer over a vocabulary that is fixed before any scenario is known."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

from tokenizers import Tokenizer, models, normalizers, pre_tokenizers

from clbench.base.errors import InputError
from clbench.base.text import did_you_mean

if TYPE_CHECKING:  # PyTorch takes seconds to import, and environments do not need it
    from torch import Tensor

TEXT_LENGTH = 12
"""Words that the policy reads at most; shorter texts are padded, so that every forward has one shape."""

VOCABULARY_SIZE = 1024
"""Rows of the embedding and of the answers, more than there are words. A new suite appends its words to the
vocabulary, which changes neither the shapes nor the initial weights of a policy."""

PADDING = "[padding]"


class UnknownWordError(InputError):
    """A text holds a word that is not in the vocabulary."""


@cache
def vocabulary() -> tuple[str, ...]:
    """Return the words in the order of their ids; id 0 is the padding."""
    text = files("clbench.spec").joinpath("vocabulary.txt").read_text(encoding="utf-8")
    return (PADDING, *text.split())


@cache
def _tokenizer() -> Tokenizer:
    ids = {word: number for number, word in enumerate(vocabulary())}
    tokenizer = Tokenizer(models.WordLevel(ids, unk_token=PADDING))
    tokenizer.normalizer = normalizers.Sequence([normalizers.NFKC(), normalizers.Lowercase()])
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.WhitespaceSplit(), pre_tokenizers.Punctuation(behavior="removed")]
    )
    tokenizer.enable_padding(length=TEXT_LENGTH, pad_id=0, pad_token=PADDING)
    return tokenizer


def encode(texts: Sequence[str]) -> Tensor:
    """Return the word ids (len(texts), TEXT_LENGTH), int64, of `texts`. Case and punctuation do not count.

    Raises:
        UnknownWordError: A word is not in the vocabulary, or there are more than `TEXT_LENGTH` words.
    """
    import torch

    return torch.tensor(word_ids(texts), dtype=torch.int64)


def word_ids(texts: Sequence[str]) -> list[list[int]]:
    """Return the result of `encode` as lists.

    Raises:
        UnknownWordError: A word is not in the vocabulary, or there are more than `TEXT_LENGTH` words.
    """
    tokenizer = _tokenizer()
    rows = []
    for text, encoding in zip(texts, tokenizer.encode_batch(list(texts)), strict=True):
        words = [text[start:end] for start, end in encoding.offsets if end > start]
        for word, number in zip(words, encoding.ids, strict=False):
            if number == 0:
                hint = did_you_mean(word.lower(), vocabulary())
                raise UnknownWordError(f"The word {word!r} in {text!r} is not in the vocabulary.{hint}")
        if not 0 < len(words) <= TEXT_LENGTH:
            raise UnknownWordError(f"{text!r} has {len(words)} words; the policy reads 1 to {TEXT_LENGTH}.")
        rows.append(encoding.ids)
    return rows


def word_id(word: str) -> int:
    """Return the id of a single word of the vocabulary."""
    return word_ids([word])[0][0]
