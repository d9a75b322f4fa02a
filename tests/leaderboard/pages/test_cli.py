"""The commands that write pages: what they are asked for, and what they refuse."""

from pathlib import Path

import pytest

from clbench.base.entry_points import resolve

TOY = "clbench/Toy-v0"
claims, findings, method_pages, scenario_card = (
    resolve(f"clbench.leaderboard.pages.cli:{name}")
    for name in ("claims", "findings", "method_pages", "scenario_card")
)


def test_a_scenario_may_be_named_with_its_module(four_methods: Path, tmp_path: Path) -> None:
    pages = []
    for name in (TOY, f"clbench.testing:{TOY}", "clbench/Fetch-v1"):
        claims(records=four_methods, controls=tmp_path, scenario=name, output=tmp_path / "claims.md")
        pages.append((tmp_path / "claims.md").read_text(encoding="utf-8"))
    assert pages[0] == pages[1] != pages[2]


@pytest.mark.parametrize("command", [claims, findings, method_pages])
def test_a_page_that_cannot_be_written_is_named_in_one_line(
    command: object, four_methods: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert callable(command)
    with pytest.raises(SystemExit) as ended:
        command(records=four_methods, controls=tmp_path, output=tmp_path / "file" / "page.md")
    assert ended.value.code == 2
    assert f"error: {tmp_path / 'file' / 'page.md'}" in capsys.readouterr().err


def test_without_records_the_command_for_cards_asks_for_a_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        scenario_card(records=tmp_path, output=tmp_path / "cards")
    assert f"No scenario has records in {tmp_path}. Name one, for example " in capsys.readouterr().err


def test_cards_for_a_folder_that_is_a_file_are_refused_before_any_expert_is_measured(
    four_methods: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match="2"):
        scenario_card(f"clbench.testing:{TOY}", records=four_methods, output=tmp_path / "file")
    said = capsys.readouterr().err
    assert said == f"error: --output {tmp_path / 'file'} cannot be written to: Not a directory.\n"
