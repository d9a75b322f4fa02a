"""Writing the files of the leaderboard: the board, its pages and the verifications."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from clbench.base.errors import InputError
from clbench.base.leftovers import replacing
from clbench.base.text import print_plain


def write_all(texts: Mapping[Path, str]) -> list[Path]:
    """Write the texts to their paths, all or none, and return the paths.

    A file that has its text already is left alone. Nothing is replaced before everything is written beside
    its place: a full disk leaves the old files.

    Raises:
        InputError: The file system refuses one of them.
    """
    path = Path()
    try:
        with ExitStack() as stack:
            for path, text in texts.items():
                content = text.encode("utf-8")
                if path.is_file() and path.read_bytes() == content:
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                stack.enter_context(replacing(path)).write_bytes(content)
    except OSError as error:
        raise InputError(f"{error.filename2 or path} cannot be written: {error.strerror}.") from error
    return list(texts)


def print_written(paths: Iterable[Path]) -> None:
    """Print the paths of files that were written."""
    console = Console()
    for path in paths:
        print_plain(console, f"Written: {path}")
