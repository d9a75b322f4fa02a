"""Where records are kept, and what their files are called."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clbench.base.errors import InputError
from clbench.spec.identifiers import check_label, check_scenario_id, folder_name

RECORDS = Path("leaderboard/records")
"""Where the records of the board lie, seen from the working directory."""

TUNING = Path("leaderboard/tuning")
"""Where the records of tuning runs lie, seen from the working directory."""


def label_of(method: str, changes: Mapping[str, Any]) -> str:
    """Return the method with what was changed of it, as "experience_replay+replay=0.02"."""
    return "+".join([method, *(f"{name}={value}" for name, value in sorted(changes.items()))])


def record_name(scenario: str, label: str, seed: int, order: int = 0) -> Path:
    """Return where the record of a run lies, seen from the folder of records; no other run has this place.

    Args:
        scenario: Gymnasium id.
        label: The method and what was changed of it, see `label_of`.
        seed: Of the run.
        order: In which the targets were learned; 0 is the published one.

    Raises:
        ValueError: A name is refused.
    """
    check_scenario_id(scenario)
    check_label(label)
    name = f"seed-{seed}-order-{order}.json" if order else f"seed-{seed}.json"
    return Path(folder_name(scenario), folder_name(label), name)


def record_path(records: Path, scenario: str, label: str, seed: int, order: int = 0) -> Path:
    """Return where the record of a run lies below the folder `records`, see `record_name`.

    Raises:
        ValueError: A name is refused, or a symbolic link leads out of the folder.
    """
    path = records / record_name(scenario, label, seed, order)
    if not path.parent.resolve().is_relative_to(records.resolve()):
        raise InputError(f"{path.parent}: a symbolic link leads out of {records}.")
    return path
