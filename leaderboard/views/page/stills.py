"""Pictures of the scenario cards: stills of the tasks, and a film. Without cards, the page has none."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from pathlib import Path

from clbench.records.paths import table_parts
from clbench.spec.identifiers import folder_name
from clbench.spec.policies import DEFAULT_POLICY

from ...board.paths import CARDS, FILM

_SCENARIO = re.compile(r"clbench/[A-Za-z0-9_]+-v\d+")
_NAME = re.compile(r"[A-Za-z0-9_]+")


def stills(table: str, tasks: Iterable[str], cards: Path = CARDS) -> dict[str, str]:
    """Return the stills of the tasks that have one, as data URLs by task.

    Args:
        table: Name of a table. Only tables of the project's own scenarios have stills.
        tasks: Names of its tasks; a stranger may have written them.
        cards: Folder of the cards.
    """
    found = {task: _picture(table, f"{task}.webp", cards) for task in tasks if _NAME.fullmatch(task)}
    return {task: still for task, still in found.items() if still}


def film(table: str, cards: Path = CARDS) -> str | None:
    """Return the film of a scenario as a data URL; None if there is none, or for another policy.

    Args:
        table: Name of a table.
        cards: Folder of the cards.
    """
    return _picture(table, FILM, cards) if table_parts(table)[1] == DEFAULT_POLICY else None


def _picture(table: str, name: str, cards: Path) -> str | None:
    """Return a file of a scenario's card as a data URL; None if there is no such file."""
    scenario = table_parts(table)[0]
    if not _SCENARIO.fullmatch(scenario):
        return None
    path = cards / folder_name(scenario) / name
    if not path.is_file():
        return None
    return f"data:image/{path.suffix[1:]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
