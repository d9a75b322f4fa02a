"""Recordings: demonstrations from a file, which a task names in place of its expert.

The task has `expert="clbench.exchange.recorded:demonstrations_0123456789abcdef"`. The digits are a hash of
the demonstrations. The hash is part of everything that is made from the task: the id of its Minari dataset,
the keys of policies, and the definition of its scenario, which every record holds. Nothing ever plays such an
expert, so no other demonstrations can replace those in the file.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from typing import NoReturn

import numpy as np

from clbench.base.errors import InputError
from clbench.data.demonstrations import Demonstration

_NAME = re.compile(r"demonstrations_([0-9a-f]{16})")


class Recording:
    """The expert of a task whose demonstrations come from a file: it refuses to act.

    Args:
        recording: Hash of the demonstrations.
    """

    def __init__(self, recording: str) -> None:
        self.recording = recording

    def __call__(self, task: str) -> NoReturn:
        """Refuse to make an expert.

        Raises:
            InputError: Always.
        """
        raise InputError(
            f"{no_expert(task, self.recording)}, which is not kept for this version of the task and of "
            "clbench. Import it with `clbench demonstrations import`. If questions need states, let the "
            "`scenes` of the scenario name other tasks."
        )


def __getattr__(name: str) -> Recording:
    found = _NAME.fullmatch(name)
    if found is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return Recording(found[1])


def no_expert(task: str, recording: str) -> str:
    """Return the beginning of a message about a task without an expert.

    Args:
        task: Name of the task.
        recording: Hash of the demonstrations that it learns from.
    """
    return f"The task {task} has no expert: it learns from the recording {recording}"


def recording_hash(episodes: Iterable[Demonstration]) -> str:
    """Return the hash of demonstrations, which covers every bit of them and nothing else in a file."""
    digest = hashlib.sha256()
    for episode in episodes:
        for name, value in vars(episode).items():
            if name == "seed":  # no recording has one
                continue
            array = np.ascontiguousarray(value)
            digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()[:16]


def expert_of(recording: str) -> str:
    """Return the entry point that a task names to learn from a recording.

    Args:
        recording: Hash of the demonstrations.
    """
    return f"{__name__}:demonstrations_{recording}"
