"""The files of a method's state: everything that `check_state` accepts comes back."""

from pathlib import Path
from typing import Any

import pytest
import torch

from clbench.learning.method_state import StateError, check_state, read_state, write_state


def test_a_state_comes_back_though_its_tensors_share_memory_or_lie_otherwise(tmp_path: Path) -> None:
    weight = torch.arange(6.0).reshape(2, 3)
    tensors: dict[str, Any] = {"weight": weight, "again": weight, "row": weight[1], "turned": weight.T}
    values: dict[str, Any] = {"text": "x", "number": 0.5, "whole": 2, "true": True, "none": None}
    check_state(tensors | values)
    write_state(tmp_path, tensors | values)
    found = read_state(tmp_path)
    assert {name: found.pop(name).tolist() for name in tensors} == {  # type: ignore[union-attr]
        name: tensor.tolist() for name, tensor in tensors.items()
    }
    assert found == values


@pytest.mark.parametrize(
    ("state", "found"),
    [
        ([1], "not list"),
        ({1: 1.0}, "names that are text, not 1"),
        ({"grid": torch.eye(2).to_sparse()}, r"a sparse one, 'grid'; store grid\.to_dense\(\)"),
        ({"x" * 10**6: 1}, "short names"),
        ({"best": float("nan")}, "'best': a number that is not finite"),
        ({"seen": [1]}, "a list, 'seen'"),
    ],
    ids=["a list", "a number as a name", "a sparse tensor", "a long name", "a NaN", "a list as an entry"],
)
def test_what_the_files_cannot_hold_is_refused_by_name(state: Any, found: str) -> None:
    with pytest.raises(StateError, match=found):
        check_state(state)
