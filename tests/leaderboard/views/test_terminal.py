"""The table in the terminal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from clbench.records.record import Record


def test_the_terminal_shows_all_rows_in_108_columns(
    add_full: Callable[..., Path], shown: Callable[[], tuple[str, str]]
) -> None:
    add_full("experience_replay", 0)
    printed, _ = shown()
    table, _, _ = printed.partition("Written: ")  # the paths below it are as long as they are
    assert max(map(len, table.splitlines())) <= 108
    for word in ("experience_replay", "from_scratch", "prior demonstrations", "reference", "0.45±."):
        assert word in printed
    row = next(line for line in printed.splitlines() if "experience_replay" in line)
    assert len(row.split()) == 3 + 6 + 3  # group, name, seeds; six metrics; cost, bytes, tier: none cut off
    assert "…" not in printed


def test_bytes_have_three_digits_and_go_on_to_the_next_unit(
    four_methods: Path, add_full: Callable[..., Path], shown_with_page: Callable[[], tuple[str, str]]
) -> None:
    counts = {0: "0", 999: "999", 1234: "1.23k", 999_900: "1M", 45_678_901: "45.7M", 3 * 10**15: "3000T"}
    for number, count in enumerate(counts):
        add_full(f"size_{number}", 0, edit=set_in("costs", "bytes_kept", count))
    printed = [line.split() for line in shown_with_page()[0].splitlines()]
    page = (four_methods.parent / "site" / "index.html").read_text(encoding="utf-8")
    for number, (count, text) in enumerate(counts.items()):
        (size,) = (line[-2] for line in printed if f"size_{number}" in line)
        assert size == text
        unit = f" {text[-1]}B" if text[-1].isalpha() else ""
        assert f'<span title="{count:,} bytes">{text.rstrip("kMGT")}{unit}</span>' in page


def set_in(name: str, key: str, value: Any) -> Callable[[Record], None]:
    def edit(record: Record) -> None:
        part = getattr(record, name)
        if isinstance(part, dict):
            part[key] = value
        else:
            setattr(part, key, value)

    return edit
