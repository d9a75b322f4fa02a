"""Results of benchmarks: one file each in results/, with the date, the commit and the hardware."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import clbench
from clbench.runs.fingerprint import fingerprint
from clbench.testing import TOY

FOLDER = Path(__file__).parent / "results"


def write_results(name: str, values: Mapping[str, Any], folder: Path | None = None) -> None:
    """Write `name`.json.

    Args:
        name: Name of the benchmark.
        values: Measured values by name.
        folder: Folder of the file: results/, unless the board reads it too.
    """
    _write(name, {**_circumstances(), **values}, folder or FOLDER)


def write_row(name: str, table: str, row: str, values: Mapping[str, Any]) -> None:
    """Write a row of a table in results/`name`.json; other rows stay, perhaps from other machines.

    Args:
        name: Name of the benchmark.
        table: Name of the table.
        row: Name of the row.
        values: Measured values by name.
    """
    found = read_results(name) or {table: {}}
    # the circumstances of a whole file are those of each of its rows
    rows = {one: {**found, **kept} for one, kept in found.pop(table).items()}
    _write(name, {table: {**rows, row: {**_circumstances(), **values}}}, FOLDER)


def read_results(name: str) -> Any:
    """Return results/`name`.json, or None if there is none."""
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _circumstances() -> dict[str, Any]:
    """Return when, with what code and on what machine a benchmark runs."""
    found = fingerprint(TOY)
    date = datetime.now(UTC).date().isoformat()
    return {
        "clbench": clbench.__version__,
        "date": date,
        "commit": found["commit"],
        "hardware": found["hardware"],
    }


def _write(name: str, result: Mapping[str, Any], folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
