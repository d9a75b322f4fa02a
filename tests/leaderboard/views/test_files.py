"""Writing files: what was written, and what had its text already."""

from pathlib import Path

import pytest

from clbench.base.entry_points import resolve

print_written = resolve("clbench.leaderboard.views.files:print_written")
write_all = resolve("clbench.leaderboard.views.files:write_all")


def test_a_file_that_has_its_text_is_left_alone_and_called_unchanged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    texts = {Path("old"): "text", Path("folder/new"): "text", Path("changed"): "text"}
    Path("old").write_text("text", encoding="utf-8")
    Path("changed").write_text("other", encoding="utf-8")
    before = Path("old").stat().st_ino
    print_written(write_all(texts))
    assert capsys.readouterr().out.splitlines() == [
        "Unchanged: old",
        "Written: folder/new",
        "Written: changed",
    ]
    assert all(path.read_text(encoding="utf-8") == "text" for path in texts)
    assert Path("old").stat().st_ino == before
