"""The policy: a vision-language-action model small enough for a laptop, honest enough to forget."""

from clbench.policy.batch import Batch, QuestionBatch
from clbench.policy.checkpoint import CheckpointError, load_policy, save_policy
from clbench.policy.language import (
    TEXT_LENGTH,
    VOCABULARY_SIZE,
    UnknownWordError,
    encode,
    vocabulary,
    word_id,
)
from clbench.policy.policy import Policy, PolicyConfig

__all__ = [
    "TEXT_LENGTH",
    "VOCABULARY_SIZE",
    "Batch",
    "CheckpointError",
    "Policy",
    "PolicyConfig",
    "QuestionBatch",
    "UnknownWordError",
    "encode",
    "load_policy",
    "save_policy",
    "vocabulary",
    "word_id",
]
