"""Stills of the tasks: the pictures of the scenario cards. Without cards, the page has no stills."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from pathlib import Path

from clbench.records.paths import parts_of
from clbench.spec.identifiers import folder_name

from ...board.places import CARDS

_SCENARIO = re.compile(r"clbench/[A-Za-z0-9_]+-v\d+")
_NAME = re.compile(r"[A-Za-z0-9_]+")


def stills(place: str, tasks: Iterable[str], cards: Path = CARDS) -> dict[str, str]:
    """Return the stills of the tasks that have one, as data addresses by task.

    Args:
        place: Name of a table, of the project's own scenarios or of another one, which has none.
        tasks: Names of its tasks; a stranger may have written them.
        cards: Folder of the cards.
    """
    scenario = parts_of(place)[0]
    if not _SCENARIO.fullmatch(scenario):
        return {}
    paths = {task: cards / folder_name(scenario) / f"{task}.webp" for task in tasks if _NAME.fullmatch(task)}
    return {
        task: f"data:image/webp;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
        for task, path in paths.items()
        if path.is_file()
    }
