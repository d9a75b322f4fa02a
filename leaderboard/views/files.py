"""Writing the files of the leaderboard: the board, its pages and the verifications."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from rich.console import Console

from clbench.base.errors import InputError
from clbench.base.leftovers import replacing
from clbench.base.text import print_plain


def write_all(texts: Mapping[Path, str]) -> dict[Path, bool]:
    """Write the texts to their paths, all or none.

    No file is replaced before all texts are written beside their places: a full disk leaves the old files.

    Returns:
        Whether each file was written; a file that already has its text is left alone.

    Raises:
        InputError: The file system refuses one of them.
    """
    written = dict.fromkeys(texts, False)
    path = Path()
    try:
        with ExitStack() as stack:
            for path, text in texts.items():
                content = text.encode("utf-8")
                if path.is_file() and path.read_bytes() == content:
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                stack.enter_context(replacing(path)).write_bytes(content)
                written[path] = True
    except OSError as error:
        raise InputError(f"{error.filename2 or path} cannot be written: {error.strerror}.") from error
    return written


def print_written(written: Mapping[Path, bool]) -> None:
    """Print which files `write_all` wrote, and which it left unchanged."""
    console = Console()
    for path, is_written in written.items():
        print_plain(console, f"{'Written' if is_written else 'Unchanged'}: {path}")
