"""Seeds by name: a random stream depends on its name alone, never on the code that ran before."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # PyTorch takes seconds to import, and environments do not need it
    import torch


def derive_seed(*parts: str | int) -> int:
    """Return the 31-bit seed with the name `parts`, such as `("episode", 0, "push", 3)`."""
    digest = hashlib.sha256("\x1f".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1  # 31 bits: every library accepts such seeds


def numpy_generator(*parts: str | int) -> np.random.Generator:
    """Return the NumPy generator of the stream with the name `parts`."""
    return np.random.default_rng(derive_seed(*parts))


def torch_generator(*parts: str | int) -> torch.Generator:
    """Return the PyTorch generator, on the CPU, of the stream with the name `parts`."""
    import torch

    return torch.Generator().manual_seed(derive_seed(*parts))


@contextmanager
def seeded(*parts: str | int) -> Iterator[None]:
    """Seed the global generators of Python, NumPy and PyTorch inside the block, and restore them after it.

    Our own code draws from explicit generators; a method, or a library that it uses, may not.
    """
    import torch

    seed = derive_seed(*parts)
    with draws_restored():
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        yield


@contextmanager
def draws_restored() -> Iterator[None]:
    """Restore the global generators of Python, NumPy and PyTorch after the block, as if it drew nothing."""
    import torch

    python, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002 - to restore it
    # Reading the generator would start a GPU that nothing has used. Such a GPU has no draws to restore.
    idle = torch.cuda.is_available() and not torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    with torch.random.fork_rng([] if idle else range(torch.accelerator.device_count())):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy_state)  # noqa: NPY002


SPLIT_LABELS = {"train": "train", "validation": "selection", "test": "report"}
"""Names of the splits in seeds. They are older than the names of the splits, and they stay: other words would
draw other episodes."""
