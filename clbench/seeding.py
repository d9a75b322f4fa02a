"""Seeds by name: every random stream of a run follows from what it is for, never from what ran before."""

from __future__ import annotations

import hashlib

import numpy as np
import torch


def derive_seed(*parts: str | int) -> int:
    """Return the 31-bit seed that `parts`, as `("episode", 0, "push", 3)`, name."""
    digest = hashlib.sha256("\x1f".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1  # 31 bits: the widest that every library's seed takes


def numpy_generator(*parts: str | int) -> np.random.Generator:
    """Return the NumPy generator of the stream that `parts` name."""
    return np.random.default_rng(derive_seed(*parts))


def torch_generator(*parts: str | int) -> torch.Generator:
    """Return the PyTorch generator, on the CPU, of the stream that `parts` name."""
    return torch.Generator().manual_seed(derive_seed(*parts))
