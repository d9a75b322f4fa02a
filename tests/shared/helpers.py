"""Functions that several test files call; `pythonpath` in pyproject.toml lets them import this module."""

from collections.abc import Mapping
from typing import Any

from clbench.learning.method import Method
from clbench.learning.registry import load_method, new_method, read_changes
from clbench.records.content import content_hash


def build_method(spec: str, changes: Mapping[str, Any]) -> Method:
    """Return the method called `spec`, with changed hyper-parameters as a run reads them."""
    cls = load_method(spec)
    return new_method(spec, cls, read_changes(spec, cls, changes))


def sealed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's JSON with the hash of its content as `content`."""
    return {**values, "content": content_hash(values)}
