"""What all commands do with what people type: a wrong name or value ends in one line with the right one."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from clbench.base.errors import ClbenchError, InputError


@contextmanager
def checked_input() -> Iterator[None]:
    """Check input inside: a wrong name or value ends with exit code 2 and says the nearest right one."""
    try:
        yield
    except ClbenchError as error:
        console = Console(stderr=True, soft_wrap=True)
        message = error.args[0] if error.args else type(error).__name__
        console.print(f"error: {message}", style="bold red", highlight=False, markup=False)
        sys.exit(2)


def add_cwd_to_path() -> None:
    """Look for modules, as those of module:Class, in the working directory too: a console script does not."""
    sys.path.insert(0, os.getcwd())


def at_least(least: int, option: str, value: int | None) -> None:
    """Refuse the value of an option that is too small.

    Raises:
        ValueError: It is.
    """
    if value is not None and value < least:
        raise InputError(f"{option} must be at least {least}, not {value}.")
