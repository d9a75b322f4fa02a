"""Paths that the leaderboard's commands and pages use, most of them relative to the working directory."""

from __future__ import annotations

import os
from pathlib import Path

SCENARIO = "clbench/Fetch-v1"
"""Default scenario of `clbench submit` and of the method pages, and the example in messages."""

CONTROLS = Path("leaderboard/controls")
"""Folder of records with changed settings. Commands on pages name it."""

LADDER = Path("leaderboard/ladder")
"""Folder of records with the learning rates of the ladder, next to the folder of records."""

CARDS = Path(__file__).parents[2] / "docs/reference/scenarios"
"""Folder of the scenario cards, beside the code. An installed wheel has their pictures alone."""

FILM = "film.gif"
"""File with a film of a scenario, in the folder of its card; `clbench film --output` makes it."""


def beside(records: Path, name: str) -> Path:
    """Return the path of a folder beside a folder of records, without following a link."""
    return sibling(records.absolute(), name)


def sibling(folder: Path, name: str) -> Path:
    """Return the path of a folder beside another one, relative if that one is, also for "." and ".."."""
    return Path(os.path.normpath(folder / ".." / name))
