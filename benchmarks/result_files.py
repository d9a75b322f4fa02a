"""Results of benchmarks: one file each in results/, with clbench's version and the hardware."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import clbench
from clbench.runs.fingerprint import fingerprint
from clbench.spec.registry import load_scenario

FOLDER = Path(__file__).parent / "results"


def write_results(name: str, scenario: str, values: Mapping[str, Any], folder: Path = FOLDER) -> None:
    """Write `name`.json.

    Args:
        name: Name of the benchmark.
        scenario: Id of the scenario whose fingerprint names the hardware.
        values: Measured values by name.
        folder: Folder of the file: results/, unless the board reads it too.
    """
    hardware = fingerprint(load_scenario(scenario))["hardware"]
    result = {"clbench": clbench.__version__, "hardware": hardware, **values}
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def read_results(name: str) -> Any:
    """Return results/`name`.json, or None if there is none."""
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
