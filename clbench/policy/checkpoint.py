"""Checkpoints: safetensors for the tensors, JSON for the rest. Nothing is ever unpickled."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from clbench.policy.policy import Policy, PolicyConfig


class CheckpointError(ValueError):
    """A file is not a checkpoint that can be read."""


def save_policy(policy: Policy, folder: Path) -> None:
    """Write `policy.safetensors` and `policy.json` to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    save_file(
        {name: value.contiguous() for name, value in policy.state_dict().items()},
        folder / "policy.safetensors",
    )
    (folder / "policy.json").write_text(
        json.dumps(dataclasses.asdict(policy.config), indent=1), encoding="utf-8"
    )


def load_policy(folder: Path, extend: Callable[[Policy], None] = lambda _: None) -> Policy:
    """Read the policy that `save_policy` wrote to `folder`.

    Args:
        folder: Where it lies.
        extend: Adds to a plain policy what it had more when it was saved, as adapters.

    Raises:
        CheckpointError: A file is missing or torn, or its tensors do not have the shapes that it says.
    """
    try:
        config = PolicyConfig(**json.loads((folder / "policy.json").read_text(encoding="utf-8")))
        tensors = load_file(folder / "policy.safetensors")
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: cannot be read as a policy ({error}).") from error
    policy = Policy(config)
    extend(policy)
    expected = {name: tuple(value.shape) for name, value in policy.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if expected != found:
        wrong = sorted(name for name in expected | found if expected.get(name) != found.get(name))
        raise CheckpointError(f"{folder}: tensors that do not fit the policy: {', '.join(wrong)}.")
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise CheckpointError(f"{folder}: holds values that are not finite.")
    policy.load_state_dict(tensors)
    return policy
