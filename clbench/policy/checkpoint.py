"""Checkpoints: safetensors for the tensors, JSON for the rest. Nothing is unpickled."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from clbench.base.errors import ClbenchError
from clbench.base.strict_json import read_json
from clbench.policy.kinds import new_policy
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.vision import PATCH, TOKENS
from clbench.spec.policies import POLICIES, kind_of

LARGEST = 65_536
"""Upper limit of every size in a `PolicyConfig`."""


class CheckpointError(ClbenchError, ValueError):
    """A file is not a readable checkpoint."""


class MisfitError(CheckpointError):
    """The tensors of a checkpoint do not fit the policy that is built for them.

    Args:
        folder: Folder of the checkpoint.
        names: Names of the tensors that the checkpoint or the policy lacks, or whose shapes or types differ.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        super().__init__(f"{folder}: tensors that do not fit the policy: {', '.join(names)}.")
        self.names = tuple(names)


def save_policy(policy: Policy, folder: Path) -> None:
    """Write `policy.safetensors` and `policy.json` to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    save_file(
        # a copy: safetensors refuses tensors that share memory, such as tied weights
        {name: value.detach().clone().contiguous() for name, value in policy.state_dict().items()},
        folder / "policy.safetensors",
    )
    (folder / "policy.json").write_text(
        json.dumps(dataclasses.asdict(policy.config), indent=1), encoding="utf-8"
    )


def load_policy(
    folder: Path, extend: Callable[[Policy], None] = lambda _: None, name: str | None = None
) -> Policy:
    """Read the policy that `save_policy` wrote to `folder`.

    Args:
        folder: Folder of the checkpoint.
        extend: Function that adds modules, such as adapters, to a plain policy before its tensors are loaded.
        name: Name of the policy, whose kind the checkpoint must have. None allows any built-in kind: a
            checkpoint never decides which module is imported.

    Raises:
        CheckpointError: A file is missing or torn, a size is out of range, the tensors do not have the names,
            shapes and types of a policy of these sizes, or a value is not finite.
    """
    try:
        config = PolicyConfig(**read_json(folder / "policy.json"))
        tensors = load_file(folder / "policy.safetensors")
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{folder}: cannot be read as a policy ({error}).") from error
    fault = _fault(config, tensors, None if name is None else kind_of(name))
    if fault:
        raise CheckpointError(f"{folder}: {fault}.")
    policy = new_policy(config)
    extend(policy)
    expected, found = _kinds(policy.state_dict()), _kinds(tensors)
    if expected != found:
        wrong = sorted(name for name in expected | found if expected.get(name) != found.get(name))
        raise MisfitError(folder, wrong)
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise CheckpointError(f"{folder}: holds values that are not finite.")
    policy.load_state_dict(tensors)
    return policy


def _kinds(tensors: Mapping[str, Tensor]) -> dict[str, tuple[Any, ...]]:
    return {name: (tuple(value.shape), value.dtype) for name, value in tensors.items()}


def _fault(config: PolicyConfig, tensors: Mapping[str, Tensor], kind: str | None) -> str | None:
    """Return why a policy of these sizes must not be built, else None: it could exceed the memory."""
    sizes = dataclasses.asdict(config)
    allowed = list(POLICIES) if kind is None else [kind]
    if sizes.pop("kind") not in allowed:
        return f"its kind must be {' or '.join(allowed)}, not {config.kind!r}"
    for name, size in sizes.items():
        least = 0 if name in ("image_size", "block") else 1
        if type(size) is not int or not least <= size <= LARGEST:
            return f"{name} must be a whole number from {least} to {LARGEST:,}, not {size!r}"
    if config.width % config.heads:
        return f"width {config.width} cannot be shared among {config.heads} heads"
    if config.block and config.chunk % config.block:
        return f"a chunk of {config.chunk} steps cannot be cut into blocks of {config.block}"
    if config.image_size % PATCH:
        return f"pictures of {config.image_size} pixels cannot be cut into patches of {PATCH}"
    if config.executed > config.chunk:
        return f"executed must be at most {config.chunk}, the steps of a chunk, not {config.executed}"
    if config.kind not in POLICIES:  # its sizes mean what its class makes of them
        return None
    if config.layers > len(tensors):
        return f"{config.layers:,} layers need at least as many tensors, but the file has {len(tensors):,}"
    held = sum(value.numel() for value in tensors.values())
    # one square matrix per layer and one vector per number, word and action: a tenth of a policy
    rows = config.layers * config.width + config.state_size + config.vocabulary_size
    rows += (config.image_size // PATCH) ** 2 * (config.width // 2) * TOKENS  # the vision's last layer
    least = config.width * (rows + config.action_size + config.chunk)
    if least > held:
        return f"a policy of its sizes has at least {least:,} numbers, but the file has {held:,}"
    return None
