"""The state of a method as two files: what later hooks need, beside the policy of a stage."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from clbench.base.strict_json import check_json, read_json
from clbench.learning.method import MethodState


def write_state(folder: Path, state: MethodState) -> None:
    """Write the state of a method to `method.safetensors` and `method.json` in `folder`."""
    tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
    copies = {name: value.detach().clone().contiguous() for name, value in tensors.items()}
    save_file(copies, folder / "method.safetensors")
    values = {name: value for name, value in state.items() if name not in tensors}
    text = json.dumps(values)
    check_json(json.loads(text))  # refuse here, with a name, what reading the file would refuse
    (folder / "method.json").write_text(text, encoding="utf-8")


def read_state(folder: Path, device: torch.device | str = "cpu") -> MethodState:
    """Return the state of a method that `write_state` wrote to `folder`."""
    state: MethodState = {**read_json(folder / "method.json")}
    state.update(load_file(folder / "method.safetensors", device=str(device)))
    return state
