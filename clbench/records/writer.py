"""The writer of records."""

from __future__ import annotations

import dataclasses
import json
import os
import uuid
from pathlib import Path
from typing import Any

from clbench.records.record import SCHEMA, Record


def write_record(record: Record, path: Path) -> None:
    """Write `record` to `path` in one step: a reader sees the whole file or none.

    A symbolic link that is there is replaced, and what it leads to is left alone.
    """
    values = {"schema": SCHEMA, **dataclasses.asdict(record)}
    text = "{\n" + ",\n".join(f"{json.dumps(key)}: {_dump(value)}" for key, value in values.items()) + "\n}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with open(partial, "x", encoding="utf-8") as file:
            file.write(text)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _dump(value: Any) -> str:
    """Return JSON with one line for each entry of a dictionary, so that columns and settings read well."""
    if isinstance(value, dict) and value:
        rows = (f"  {json.dumps(key)}: {json.dumps(entry, allow_nan=False)}" for key, entry in value.items())
        return "{\n" + ",\n".join(rows) + "\n}"
    return json.dumps(value, allow_nan=False)
