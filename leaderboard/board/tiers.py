"""Tiers: how far a record was checked, and by whom.

The record itself is never touched. `clbench verify` writes its findings into a file next to the record. The
findings hold only for the bytes that it read: a record that is changed afterwards loses its tier, and so does
a record whose findings were changed or damaged.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Verification:
    """What the file of a verification says about a record, if it holds for its bytes."""

    tier: str = TIERS[0]
    """One of `TIERS`."""
    notes: tuple[tuple[str, str], ...] = ()
    """Tier, verifier, time and what each check found, as names with texts."""


def verification_of(record: Path) -> Verification:
    """Return the verification of the record at `record`, a self-reported one if none holds for its bytes."""
    values = _read(record)
    about = [(name, values.get(name)) for name in ("tier", "by", "time")]
    checks = [one for one in values.get("checks", ()) if isinstance(one, dict)]
    named = (*about, *((one.get("name"), one.get("found")) for one in checks))
    notes = [(name, text) for name, text in named if isinstance(name, str) and isinstance(text, str)]
    return Verification(str(values.get("tier", TIERS[0])), tuple(notes))


def tier_of(record: Path) -> str:
    """Return the tier of the record at `record`, "self-reported" if no verification holds for its bytes."""
    return verification_of(record).tier


def verification_text(values: Mapping[str, Any]) -> str:
    """Return the text of the file of a verification; the hash in it reveals damage."""
    return json.dumps({**values, "content": content_hash(values)}, indent=1) + "\n"


def _read(record: Path) -> dict[str, Any]:
    """Return the values in the file of a verification, empty if it is damaged or does not hold."""
    try:
        values = read_json(verification_path(record))
        whole = values["content"] == content_hash(values) and values["tier"] in TIERS
        whole = whole and isinstance(values.get("checks", []), list)
        if whole and values["record"] == hashlib.sha256(record.read_bytes()).hexdigest():
            return dict(values)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return {}
