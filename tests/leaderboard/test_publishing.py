"""Copies of the published records in folders of your own."""

import importlib.util
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.base.entry_points import resolve

add_published = resolve("clbench.leaderboard.publishing:add_published")
show = resolve("clbench.leaderboard.cli:show")
inputs_of = resolve("clbench.leaderboard.publishing:inputs_of")


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


def test_a_link_in_the_place_of_the_site_is_not_followed(
    four_methods: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "index.html").write_text("mine", encoding="utf-8")
    (four_methods.parent / "site").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(SystemExit, match="2"):
        show(records=four_methods)
    assert "site is a symbolic link" in " ".join(capsys.readouterr().err.split())
    assert [path.read_text(encoding="utf-8") for path in (tmp_path / "elsewhere").iterdir()] == ["mine"]


def test_a_list_of_files_that_names_another_folder_removes_nothing(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    site = four_methods.parent / "site"
    site.mkdir()
    names = {"..": "", "\0": "", "a" * 300: ""}
    (site / "board.json").write_text(json.dumps({"files": names}), encoding="utf-8")
    _, page = shown()
    assert (site / "LEADERBOARD.md").read_text(encoding="utf-8") == page
    assert four_methods.is_dir()


def test_files_that_an_editor_leaves_beside_the_methods_do_not_stop_the_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.find_spec("clbench.methods")
    assert spec is not None
    assert spec.origin is not None
    usual, methods = importlib.util.find_spec, tmp_path / "methods"
    shutil.copytree(Path(spec.origin).parent, methods)
    spec.origin = str(methods / "__init__.py")
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda name, *rest: spec if name == "clbench.methods" else usual(name, *rest),
    )
    before = inputs_of(tmp_path / "records")["docstrings"]
    (methods / ".#sft.py").symlink_to("somebody@node8.815")
    (methods / "half_written.py").write_text("def half(", encoding="utf-8")
    assert inputs_of(tmp_path / "records")["docstrings"] == before
