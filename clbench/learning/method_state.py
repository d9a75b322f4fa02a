"""The state of a method as two files: what later hooks need, beside the policy of a stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from clbench.base.errors import WrongTypeError
from clbench.base.strict_json import StrictJSONError, check_json, read_json
from clbench.learning.method import MethodState
from clbench.policy.batch import Batch, QuestionBatch


class StateError(WrongTypeError):
    """`state` returned something that the files of a state cannot hold.

    Attributes:
        expected: What `state` may return.
        found: What it returned.
    """

    def __init__(self, expected: str, found: str):
        super().__init__(f"state() must return {expected}, not {found}.")
        self.expected = expected
        self.found = found


def check_state(state: Any) -> None:
    """Refuse a state of a form that the two files cannot hold.

    Raises:
        StateError: The state is refused; the message names the entry.
    """
    if not isinstance(state, dict):
        raise StateError("a dictionary", type(state).__name__)
    for name, value in state.items():
        if not isinstance(name, str):
            raise StateError("names that are text", repr(name))
        if isinstance(value, torch.Tensor):
            if value.layout is not torch.strided:
                raise StateError("dense tensors", f"a sparse one, {name!r}; store {name}.to_dense()")
        elif value is None or isinstance(value, str | float | int):
            try:
                check_json({name: None}, "an entry")
                check_json(json.loads(json.dumps(value)), repr(name))
            except StrictJSONError as error:
                expected = "finite numbers, short texts and short names (a tensor may hold any number)"
                raise StateError(expected, str(error).removesuffix(".")) from error
        else:
            expected = "a flat dictionary of tensors, strings, numbers, Booleans and None"
            raise StateError(expected, f"a {type(value).__name__}, {name!r}{_advice(name, value)}")


def _advice(name: str, value: Any) -> str:
    if isinstance(value, Batch | QuestionBatch):
        return "; store its tensors, {**vars(batch)}, and restore them, Batch(**state)"
    if isinstance(value, np.generic | np.ndarray):
        return f"; store {name}.item(), or torch.from_numpy({name})"
    return ""


def write_state(folder: Path, state: MethodState) -> None:
    """Write a checked state of a method to `method.safetensors` and `method.json` in `folder`."""
    tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
    copies = {name: value.detach().clone().contiguous() for name, value in tensors.items()}
    save_file(copies, folder / "method.safetensors")
    values = {name: value for name, value in state.items() if name not in tensors}
    (folder / "method.json").write_text(json.dumps(values), encoding="utf-8")


def read_state(folder: Path, device: torch.device | str = "cpu") -> MethodState:
    """Return the state of a method that `write_state` wrote to `folder`."""
    state: MethodState = {**read_json(folder / "method.json")}
    state.update(load_file(folder / "method.safetensors", device=str(device)))
    return state
