"""The definitions of the project's scenarios, which a file pins."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from clbench.base.strict_json import read_json


def pinned_file() -> Path:
    """Return the path of the file with the definitions, by id of the scenario."""
    envs = find_spec("clbench.envs")
    assert envs is not None
    assert envs.origin is not None
    return Path(envs.origin).with_name("definitions.json")


@cache
def pinned() -> Mapping[str, Mapping[str, str]]:
    """Return the definition of each scenario of the project, see `clbench.evaluation.definition`."""
    return {**read_json(pinned_file())}
