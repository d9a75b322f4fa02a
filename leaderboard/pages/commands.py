"""The commands that pages give to make missing records."""

from __future__ import annotations

from ..board.places import CONTROLS


def run_command(scenario: str, *labels: str) -> str:
    """Return the command that makes the records of `labels`, which all have the same changed settings."""
    methods = [label.partition("+")[0] for label in labels]
    changes = labels[0].split("+")[1:]
    settings = [f"--set.{name} {value}" for name, _, value in (change.partition("=") for change in changes)]
    folder = [f"--records {CONTROLS.as_posix()}"] if changes else []
    return " ".join(["clbench run", scenario, *methods, *settings, *folder])
