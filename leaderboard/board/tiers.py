"""Tiers: how far a record was checked, and by whom.

The record itself is never touched. `clbench verify` writes its findings into a file next to the record. The
findings hold only for the bytes that it read: a record that is changed afterwards loses its tier, and so does
a record whose findings were changed or damaged.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clbench.base.strict_json import read_json
from clbench.records.content import content_hash

TIERS = ("self-reported", "recomputed", "replayed", "retrained")
"""Tiers of a record, from no check at all: its metrics were computed again from its episodes; some of its
episodes were run again; the whole run was repeated."""


def verification_path(record: Path) -> Path:
    """Return the path of the verification of the record at `record`."""
    return record.with_suffix(".verified")


def tier_of(record: Path) -> str:
    """Return the tier of the record at `record`, "self-reported" if no verification holds for its bytes."""
    return str(_verification(record).get("tier", TIERS[0]))


def checks_of(record: Path) -> list[Any]:
    """Return the checks that gave the record at `record` its tier, empty without a valid verification."""
    return [*_verification(record).get("checks", ())]


def verification_notes(record: Path) -> list[tuple[str, str]]:
    """Return who verified the record at `record`, when, and what each check found, as names with texts."""
    values = _verification(record)
    about = [(name, values.get(name)) for name in ("tier", "by", "time")]
    checks = [(one.get("name"), one.get("found")) for one in checks_of(record) if isinstance(one, dict)]
    return [
        (name, text) for name, text in (*about, *checks) if isinstance(name, str) and isinstance(text, str)
    ]


def verification_text(values: Mapping[str, Any]) -> str:
    """Return the text of the file of a verification; the hash in it reveals damage."""
    return json.dumps({**values, "content": content_hash(values)}, indent=1) + "\n"


def _verification(record: Path) -> dict[str, Any]:
    """Return the verification of a record, empty if it is damaged or does not hold for its bytes."""
    try:
        values = read_json(verification_path(record))
        whole = values["content"] == content_hash(values) and values["tier"] in TIERS
        whole = whole and isinstance(values.get("checks", []), list)
        if whole and values["record"] == hashlib.sha256(record.read_bytes()).hexdigest():
            return dict(values)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return {}
