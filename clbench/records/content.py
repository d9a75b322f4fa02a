"""The hash of a record's content, by which a reader detects damage.

It is the SHA-256 of the record's JSON in canonical form: every entry of the file except `content` itself,
with sorted names, no spaces, and everything but ASCII escaped. A file may be indented or its entries
reordered, but no value may change.

The hash finds damage and careless edits. It does not prove honesty, since a forger can compute it again:
`clbench verify` and the tiers of the leaderboard are for that.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def content_hash(values: Mapping[str, Any]) -> str:
    """Return the hash of a record's content, 64 hexadecimal digits.

    Args:
        values: The record as read from JSON, with its `schema`. The hash ignores an entry `content`.
    """
    content = {name: value for name, value in values.items() if name != "content"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode("ascii")).hexdigest()
