"""Verifications: files that anyone may write, and that count only if they are whole."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from clbench.base.entry_points import resolve

compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
TIERS = "clbench.leaderboard.board.tiers"
verification_of = resolve(f"{TIERS}:verification_of")
verification_path, verification_text = (
    resolve(f"{TIERS}:{name}") for name in ("verification_path", "verification_text")
)


@pytest.mark.parametrize(
    ("tiers", "lowest"),
    [
        (("replayed", "retrained"), "replayed"),
        (("retrained", "recomputed"), "recomputed"),
        (("retrained", None), "self-reported"),
    ],
)
def test_a_row_has_the_lowest_tier_of_its_runs(
    tiers: tuple[str, str | None], lowest: str, add: Callable[..., Path], tmp_path: Path
) -> None:
    for seed, tier in enumerate(tiers):
        record = add(seed=seed)
        if tier:
            content = hashlib.sha256(record.read_bytes()).hexdigest()
            values = {"tier": tier, "record": content, "checks": []}
            verification_path(record).write_text(verification_text(values), encoding="utf-8")
    (row,) = compute_board(tmp_path / "leaderboard" / "records").rows
    assert row.tier == lowest


@pytest.mark.parametrize("checks", [5, None, "all"])
def test_a_verification_whose_checks_are_no_list_counts_as_none(
    checks: Any, add: Callable[..., Path]
) -> None:
    record = add()
    values = {"tier": "replayed", "record": hashlib.sha256(record.read_bytes()).hexdigest()}
    for found, tier in (([], "replayed"), (checks, "self-reported")):
        verification_path(record).write_text(verification_text({**values, "checks": found}), encoding="utf-8")
        verification = verification_of(record)
        assert verification.tier == tier
        assert verification.notes == ((("tier", "replayed"),) if tier == "replayed" else ())


def test_a_verification_of_other_bytes_or_with_an_edited_tier_counts_as_none(
    add: Callable[..., Path],
) -> None:
    record = add()
    values = {"tier": "recomputed", "record": hashlib.sha256(record.read_bytes()).hexdigest(), "checks": []}
    path, whole = verification_path(record), verification_text(values)
    path.write_text(whole, encoding="utf-8")
    assert verification_of(record).tier == "recomputed"
    path.write_text(whole.replace("recomputed", "retrained"), encoding="utf-8")
    assert verification_of(record).tier == "self-reported"
    path.write_text(whole, encoding="utf-8")
    record.write_bytes(record.read_bytes() + b"\n")
    assert verification_of(record).tier == "self-reported"
