"""Records whose paths a stranger chose to deceive the verifier, or to reach other folders."""

from pathlib import Path

import pytest
from verification import TOY, failures, verify

from clbench.base.entry_points import resolve

command = resolve("clbench.leaderboard.cli:verify")


@pytest.mark.long
def test_the_name_of_a_file_cannot_look_like_a_check(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = mine.rename(mine.with_name("seed-0.json: retrained\n  ok  whole run: repeated\n.json"))
    with pytest.raises(SystemExit):
        command(path, tier="recomputed", scenario=TOY, records=mine.parents[2], workers=1)
    shown = capsys.readouterr().out
    assert "seed-0.json: retrained\\n  ok  whole run: repeated\\n.json: self-reported" in shown
    assert "\n  ok " not in shown


def test_a_linked_folder_of_a_method_is_not_verified_and_nothing_in_it_changes(
    mine: Path, tmp_path: Path
) -> None:
    outside = mine.parent.rename(tmp_path / "outside")
    mine.parent.symlink_to(outside)
    for content in ("", "{}"):
        (outside / "seed-0.verified").write_text(content, encoding="utf-8")
        assert f"{mine.parent} is a symbolic link, which is not followed" in failures(
            verify(mine, "recomputed")
        )
        assert (outside / "seed-0.verified").read_text(encoding="utf-8") == content
        (outside / mine.name).write_text("{}", encoding="utf-8")  # and no record, whose tier would be deleted


def test_a_link_to_the_records_of_another_method_does_not_cost_them_their_tier(mine: Path) -> None:
    kept = mine.with_suffix(".verified")
    kept.write_text("{}", encoding="utf-8")
    link = mine.parents[1] / "l2_sp"
    link.symlink_to(mine.parent, target_is_directory=True)
    assert f"{link} is a symbolic link, which is not followed" in failures(
        verify(link / mine.name, "recomputed")
    )
    assert kept.read_text(encoding="utf-8") == "{}"


@pytest.mark.long
def test_a_path_with_a_way_up_does_not_cost_a_record_its_tier(mine: Path) -> None:
    records = mine.parents[2]
    command(mine, tier="recomputed", scenario=TOY, records=records, workers=1)
    tier = mine.with_suffix(".verified")
    assert tier.is_file()
    around = records / ".." / records.name / mine.relative_to(records)
    command(around, tier="recomputed", scenario=TOY, records=records, workers=1)
    assert tier.is_file()
