"""The command `clbench leaderboard`."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console
from rich.text import Text

from ._rows import read_table
from ._table import csv_text, markdown, terminal, write_if_changed

WIDTH = 100
"""Least width: in a narrower one the last metrics would be cut off, and a long line only wraps."""


def show(*, records: Path = Path("leaderboard/records")) -> None:
    """Show the leaderboard, and write it as LEADERBOARD.md and leaderboard.csv beside the records.

    Args:
        records: Folder of the records.
    """
    if not any(records.rglob("*.json")):
        message = f"There are no records in {records}. Make some first: clbench run clbench/Fetch-v0 sft"
        Console(stderr=True, soft_wrap=True).print(Text(message))
        raise SystemExit(2)
    table = read_table(records)
    console = Console()
    if console.width < WIDTH:
        console = Console(width=WIDTH)
    console.print(terminal(table))
    folder = Path(os.path.normpath(records / ".."))
    for name, text in (("LEADERBOARD.md", markdown(table)), ("leaderboard.csv", csv_text(table))):
        write_if_changed(folder / name, text)
        console.print(Text(f"Written: {folder / name}"), soft_wrap=True)
