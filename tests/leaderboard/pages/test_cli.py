"""The commands that write pages: what they are asked for, and what they refuse."""

import re
import shutil
from collections.abc import Callable
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


@pytest.mark.parametrize("command", [claims, findings])
def test_how_the_published_records_came_about_is_told_only_on_pages_made_from_them(
    command: Callable[..., None], four_methods: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published = shutil.copytree(four_methods, tmp_path / "published")
    monkeypatch.setattr("clbench.leaderboard.publishing.PUBLISHED", published)

    def page() -> str:
        output = tmp_path / "docs" / "page.md"
        command(records=four_methods, controls=tmp_path / "controls", output=output)
        return output.read_text(encoding="utf-8")

    told = "more seeds after a first look"
    whole = page()
    assert told in whole
    (published / "Toy-v0" / "sft" / "seed-0.json").write_text("{}", encoding="utf-8")
    assert told not in page()
    shutil.rmtree(published)  # whoever has no published records has made none of the pages from them
    text = page()
    assert told not in text
    assert "\n\n\n" not in whole + text
    assert "`leaderboard/decoding.json`, which comes with clbench" in text


def test_the_commands_for_missing_records_name_the_folder_of_the_records(
    four_methods: Path, tmp_path: Path
) -> None:
    output = tmp_path / "claims.md"
    claims(records=four_methods, controls=tmp_path, scenario=TOY, output=output)
    commands = re.findall(r"- Missing: `(clbench run .*?)`", output.read_text(encoding="utf-8"))
    plain = [one for one in commands if "--set." not in one]
    assert plain
    assert all(one.endswith(f" --records {four_methods}") for one in plain)
