"""Rows of policies that were fine-tuned elsewhere, on the board."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents import ID
from helpers import sealed, unpacked
from served import write_policy

from clbench.base.entry_points import resolve
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.serving.score import score

load = resolve("clbench:load_board")
show = resolve("clbench.leaderboard.cli:show")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
tier_of = resolve("clbench.leaderboard.board.tiers:tier_of")
verify = resolve("clbench.leaderboard.submission.verify:verify")
Request = resolve("clbench.leaderboard.submission.verify:Request")

RECORD = Path("Toy-v0/me--elsewhere/seed-0.json")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a board with a run of sft and a policy that was fine-tuned elsewhere."""
    folder = tmp_path_factory.mktemp("board")
    policy_of = write_policy(folder)
    execute(RunSpec(ID, "sft", 0), folder / "records")
    for stage in range(3):
        declared: dict[str, Any] = (
            {"data": f"demonstrations of target {stage}", "steps": 100} if stage else {}
        )
        score(
            ID, policy_of(stage), stage=stage, method="me/elsewhere", records=folder / "records", **declared
        )
    return folder


def test_it_has_its_own_division_and_takes_no_part_in_others(board: Path) -> None:
    table = load(board / "records").set_index("method")
    assert dict(table["division"]) == {"sft": "prior-data-free", "me/elsewhere": "external"}
    row = table.loc["me/elsewhere"]
    assert row["tier"] == "self-reported"
    for missing in ("question_retention", "steps", "bytes_kept", "environment_steps", "parameters"):
        assert np.isnan(row[missing]), missing


def test_the_page_says_what_is_declared_and_that_no_method_is_compared_with_it(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show(records=board / "records")
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[lines.index("external") + 1].startswith("a me/elsewhere 1 0.")
    page = unpacked((board / "site" / "index.html").read_text(encoding="utf-8"))
    assert "were fine-tuned elsewhere, on what their authors declare: not comparable with methods" in page
    assert "# me/elsewhere is a separate program: docs/guide/external.md" in page
    assert "clbench run clbench/Toy-v0 me/elsewhere" not in page
    assert "demonstrations of target 2" in page
    assert "not known" in page


def test_its_record_is_recomputed_and_cannot_be_replayed(board: Path) -> None:
    path = board / "records" / RECORD
    *passed, last = verify(
        path, board / "records", Request(tier="replayed", episodes=10, seed=0, scenario=ID)
    )
    assert all(check.passed for check in passed)
    expected = "a policy served from elsewhere has none, so its highest tier is recomputed"
    assert (last.passed, last.found) == (True, expected)
    assert tier_of(path) == "recomputed"


@pytest.mark.parametrize(
    "uses",
    [
        {"external": False},
        {"external": True, "online": True},
        {"demonstrations": "never", "questions": "never", "reference": False, "external": True},
    ],
)
def test_a_record_that_also_claims_another_division_is_refused(
    uses: dict[str, Any], board: Path, tmp_path: Path
) -> None:
    values = json.loads((board / "records" / RECORD).read_text(encoding="utf-8"))
    values["run"]["uses"] = uses
    path = tmp_path / RECORD
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    table = compute_board(tmp_path)
    assert not table.rows
    reason = "run: uses of a policy that was fine-tuned elsewhere must hold nothing else."
    assert table.not_shown[0].reason == reason
