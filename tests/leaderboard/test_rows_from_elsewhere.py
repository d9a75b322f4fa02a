"""Rows of policies that clbench did not train, on the board: of agents, and fine-tuned elsewhere."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents import ID, LEARNED, Knowing, trained
from helpers import sealed, unpacked
from served import write_policy

from clbench.base.entry_points import resolve
from clbench.runs.agents import evaluate_agent
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.serving.score import score

load = resolve("clbench:load_board")
show = resolve("clbench.leaderboard.cli:show")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
tier_of = resolve("clbench.leaderboard.board.tiers:tier_of")
verify = resolve("clbench.leaderboard.submission.verify:verify")
Request = resolve("clbench.leaderboard.submission.verify:Request")

NO_PRIOR = {"demonstrations": "never", "questions": "never", "reference": False}


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a board with a run of sft, an agent, and a policy that was fine-tuned elsewhere."""
    folder = tmp_path_factory.mktemp("board")
    records, policy_of = folder / "records", write_policy(folder)
    execute(RunSpec(ID, "sft", 0), records)
    for stage, known in enumerate(LEARNED):
        evaluate_agent(Knowing(*known), trained(stage, 7), method="me/knows", records=records)
        declared: dict[str, Any] = (
            {"data": f"demonstrations of target {stage}", "steps": 100} if stage else {}
        )
        score(ID, policy_of(stage), stage=stage, method="me/elsewhere", records=records, **declared)
    return folder


def record_of(method: str) -> Path:
    return Path("Toy-v0", f"me--{method}", "seed-0.json")


def test_they_have_divisions_of_their_own_and_take_no_part_in_others(board: Path) -> None:
    table = load(board / "records").set_index("method")
    divisions = {"sft": "prior-data-free", "me/knows": "online", "me/elsewhere": "external"}
    assert dict(table["division"]) == divisions
    assert list(table["letters"]) == ["a", "a", "a"]
    assert (table.loc["me/knows", "retention"], table.loc["me/knows", "environment_steps"]) == (0.5, 21)
    assert np.isnan(table.loc["me/elsewhere", "environment_steps"])
    for method in ("me/knows", "me/elsewhere"):
        row = table.loc[method]
        assert row["tier"] == "self-reported"
        for missing in ("question_retention", "steps", "bytes_kept", "relative_cost", "parameters"):
            assert np.isnan(row[missing]), missing
    assert np.isnan(table.loc["me/knows", "forward_transfer"])


class Other(Knowing):
    """Another agent, of which a name says nothing."""


@pytest.mark.long
def test_two_agents_of_one_name_make_no_row_together(tmp_path: Path) -> None:
    for seed, kind in enumerate((Knowing, Knowing, Other)):
        for stage, known in enumerate(LEARNED):
            evaluate_agent(
                kind(*known), trained(stage, 7), method="me/knows", seed=seed, records=tmp_path / "records"
            )
    table = compute_board(tmp_path / "records")
    assert [row.seeds for row in table.rows] == [(0, 1)]
    (left,) = table.not_shown
    assert "class of the agent differ" in left.reason


def test_the_page_says_what_is_declared_and_shows_no_run_command_for_them(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show(records=board / "records")
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    page = unpacked((board / "site" / "index.html").read_text(encoding="utf-8"))
    listed = (board / "site" / "LEADERBOARD.md").read_text(encoding="utf-8")
    for method, division, start in (("knows", "online", "0.75"), ("elsewhere", "external", "0.")):
        assert lines[lines.index(division) + 1].startswith(f"me/{method} 1 {start}")
        assert f"# me/{method} is a separate program: docs/guide/{division}.md" in page
        assert f"clbench run clbench/Toy-v0 me/{method}" not in page
        assert f"| - | me/{method} | {division} |" in listed
    assert "were fine-tuned elsewhere, on what their authors declare: not comparable with methods" in page
    assert "demonstrations of target 2" in page
    assert "not known" in page


@pytest.mark.parametrize(
    ("method", "who"),
    [("knows", "an agent that learned online"), ("elsewhere", "a policy served from elsewhere")],
)
def test_their_records_are_recomputed_and_cannot_be_replayed(method: str, who: str, board: Path) -> None:
    path = board / "records" / record_of(method)
    request = Request(tier="replayed", episodes=10, seed=0, scenario=ID)
    *passed, last = verify(path, board / "records", request)
    assert all(check.passed for check in passed)
    expected = f"{who} has none, so its highest tier is recomputed"
    assert (last.passed, last.found) == (True, expected)
    assert tier_of(path) == "recomputed"


@pytest.mark.parametrize(
    ("method", "uses"),
    [
        ("knows", {**NO_PRIOR, "online": False}),
        ("knows", {**NO_PRIOR, "demonstrations": "throughout", "online": True}),
        ("knows", {"online": True}),
        ("elsewhere", {"external": False}),
        ("elsewhere", {"external": True, "online": True}),
        ("elsewhere", {**NO_PRIOR, "external": True}),
    ],
)
def test_a_record_that_also_claims_another_division_is_refused(
    method: str, uses: dict[str, Any], board: Path, tmp_path: Path
) -> None:
    values = json.loads((board / "records" / record_of(method)).read_text(encoding="utf-8"))
    values["run"]["uses"] = uses
    path = tmp_path / record_of(method)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    table = compute_board(tmp_path)
    assert not table.rows
    who = {"knows": "an agent that learned online", "elsewhere": "a policy that was fine-tuned elsewhere"}
    assert table.not_shown[0].reason == f"run: uses of {who[method]} must hold nothing else."
