"""Verifying and forging records, for tests."""

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers import sealed

TOY = "clbench.testing:clbench/Toy-v0"
ALL = 10**6
"""More episodes than a toy run has."""

Edit = Callable[[dict[str, Any]], None]


def verify(path: Path, tier: str, honest: Path | None = None, **rest: Any) -> list[Any]:
    """Return the checks of a verification, with the kept policies if their folder is given."""
    checkpoints = honest / "checkpoints" if honest else None
    request = importlib.import_module("clbench.leaderboard.submission.subject").Request(
        **{
            "tier": tier,
            "episodes": ALL,
            "seed": 0,
            "method": None,
            "scenario": TOY,
            "checkpoints": checkpoints,
            "pretrain": False,
            **rest,
        }
    )
    records = next(folder for folder in path.parents if folder.name == "records")
    checks: list[Any] = importlib.import_module("clbench.leaderboard.submission.verify").verify(
        path, records, request
    )
    return checks


def failures(checks: list[Any]) -> str:
    return "\n".join(f"{check.name}: {check.found}" for check in checks if not check.passed)


def edit(path: Path, change: Edit) -> None:
    """Change a record as a forger does, who also makes its hash again."""
    values = json.loads(path.read_text(encoding="utf-8"))
    change(values)
    path.write_text(json.dumps(sealed(values)), encoding="utf-8")


def flip(values: dict[str, Any], success: int, step: int | None = None, split: str = "test") -> None:
    """Turn the first episode with this outcome into its opposite, at this step of a stage if one is given."""
    episodes = values["episodes"]
    rows = [
        row
        for row, outcome in enumerate(episodes["success"])
        if outcome == success and episodes["split"][row] == split and step in (None, episodes["step"][row])
    ]
    episodes["success"][rows[0]] = 1 - success
