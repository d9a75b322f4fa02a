"""The page of the findings, made from the records in a temporary folder."""

from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve


@pytest.fixture
def page(even_board: Callable[..., Path], tmp_path: Path) -> Callable[[], str]:
    """Return a function that makes the page, without the backslashes of Markdown."""

    def make() -> str:
        output = tmp_path / "docs" / "findings.md"
        resolve("clbench.leaderboard.pages.cli:findings")(
            records=tmp_path / "records", controls=tmp_path / "controls", output=output
        )
        return output.read_text(encoding="utf-8").replace("\\", "")

    return make
