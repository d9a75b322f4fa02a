"""Copies of the published records in folders of your own."""

from pathlib import Path

import pytest

from clbench.base.entry_points import resolve

add_published = resolve("clbench.leaderboard.publishing:add_published")


def test_the_ladder_comes_with_the_published_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    published, mine = tmp_path / "clbench/records", tmp_path / "mine/records"
    for path in (
        published / "Toy-v0/sft/seed-0.json",
        published / "Toy-v0/sft/seed-0.verified",
        published.parent / "ladder/Toy-v0/sft+step_factor=0.1/seed-0.json",
        published.parent / "tuning/Toy-v0/sft/seed-100.json",
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(path.name, encoding="utf-8")
    monkeypatch.setattr("clbench.leaderboard.publishing.PUBLISHED", published)
    assert add_published(mine) == 1
    copied = sorted(path.relative_to(mine.parent).as_posix() for path in mine.parent.rglob("seed-*"))
    assert copied == [
        "ladder/Toy-v0/sft+step_factor=0.1/seed-0.json",
        "records/Toy-v0/sft/seed-0.json",
        "records/Toy-v0/sft/seed-0.verified",
    ]
    assert add_published(mine) == 0
