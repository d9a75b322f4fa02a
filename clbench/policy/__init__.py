"""The policy: a vision-language-action model small enough for a laptop, honest enough to forget."""

from typing import TYPE_CHECKING

from clbench.lazy import lazy_names

if TYPE_CHECKING:
    from clbench.policy.batch import Batch as Batch
    from clbench.policy.batch import QuestionBatch as QuestionBatch
    from clbench.policy.checkpoint import CheckpointError as CheckpointError
    from clbench.policy.checkpoint import load_policy as load_policy
    from clbench.policy.checkpoint import save_policy as save_policy
    from clbench.policy.language import TEXT_LENGTH as TEXT_LENGTH
    from clbench.policy.language import VOCABULARY_SIZE as VOCABULARY_SIZE
    from clbench.policy.language import UnknownWordError as UnknownWordError
    from clbench.policy.language import encode as encode
    from clbench.policy.language import vocabulary as vocabulary
    from clbench.policy.language import word_id as word_id
    from clbench.policy.policy import Policy as Policy
    from clbench.policy.policy import PolicyConfig as PolicyConfig

_HOMES = {
    "batch": ("Batch", "QuestionBatch"),
    "checkpoint": ("CheckpointError", "load_policy", "save_policy"),
    "language": (
        "TEXT_LENGTH",
        "VOCABULARY_SIZE",
        "UnknownWordError",
        "encode",
        "vocabulary",
        "word_id",
    ),
    "policy": ("Policy", "PolicyConfig"),
}
"""In which module each name lives. It is imported when first used: an environment needs no PyTorch."""

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
