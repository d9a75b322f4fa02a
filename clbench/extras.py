"""Extras: packages that only some commands need."""

from __future__ import annotations

from importlib.util import find_spec


def require(module: str, extra: str, purpose: str) -> None:
    """Refuse to go on without an extra, before any work is done.

    Args:
        module: What would be imported.
        extra: Name of the extra of clbench that brings it.
        purpose: What needs it, as the subject of a sentence.

    Raises:
        LookupError: It is not installed; the message says how to get it.
    """
    if find_spec(module) is None:
        raise LookupError(f"{purpose} needs the package {module}: pip install 'clbench[{extra}]'")
