"""Verifications: files that anyone may write, and that count only if they are whole."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve

TIERS = "clbench.leaderboard.board.tiers"
tier_of, checks_of = resolve(f"{TIERS}:tier_of"), resolve(f"{TIERS}:checks_of")
verification_path, verification_text = (
    resolve(f"{TIERS}:{name}") for name in ("verification_path", "verification_text")
)


@pytest.mark.parametrize("checks", [5, None, "all"])
def test_a_verification_whose_checks_are_no_list_counts_as_none(
    checks: Any, add: Callable[..., Path]
) -> None:
    record = add()
    values = {"tier": "replayed", "record": hashlib.sha256(record.read_bytes()).hexdigest()}
    for found, tier in (([], "replayed"), (checks, "self-reported")):
        verification_path(record).write_text(verification_text({**values, "checks": found}), encoding="utf-8")
        assert tier_of(record) == tier
        assert checks_of(record) == []
