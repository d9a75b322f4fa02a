"""Rows of agents, which learn by trial and error, on the board."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents import ID, LEARNED, Knowing, trained
from helpers import sealed, unpacked

from clbench.base.entry_points import resolve
from clbench.runs.agents import evaluate_agent
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec

load = resolve("clbench:load_board")
show = resolve("clbench.leaderboard.cli:show")
compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
tier_of = resolve("clbench.leaderboard.board.tiers:tier_of")
verify = resolve("clbench.leaderboard.submission.verify:verify")
Request = resolve("clbench.leaderboard.submission.verify:Request")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a board with a run of sft and a run of an agent."""
    folder = tmp_path_factory.mktemp("board")
    execute(RunSpec(ID, "sft", 0), folder / "records")
    for stage, known in enumerate(LEARNED):
        evaluate_agent(Knowing(*known), trained(stage, 7), method="me/knows", records=folder / "records")
    return folder


def test_an_agent_has_its_own_division_and_takes_no_part_in_others(board: Path) -> None:
    table = load(board / "records").set_index("method")
    assert dict(table["division"]) == {"sft": "prior-data-free", "me/knows": "online"}
    assert list(table["letters"]) == ["a", "a"]
    row = table.loc["me/knows"]
    assert (row["retention"], row["environment_steps"], row["tier"]) == (0.5, 21, "self-reported")
    for missing in (
        "question_retention",
        "forward_transfer",
        "steps",
        "bytes_kept",
        "relative_cost",
        "parameters",
    ):
        assert np.isnan(row[missing]), missing


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


def test_the_page_marks_an_agent_and_shows_no_run_command_for_it(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    show(records=board / "records")
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[lines.index("online") + 1].startswith("a me/knows 1 0.75")
    page = unpacked((board / "site" / "index.html").read_text(encoding="utf-8"))
    assert "# me/knows is a separate program: docs/guide/online.md" in page
    assert "clbench run clbench/Toy-v0 me/knows" not in page
    assert "| - | me/knows | online |" in (board / "site" / "LEADERBOARD.md").read_text(encoding="utf-8")


def test_the_record_of_an_agent_is_recomputed_and_cannot_be_replayed(board: Path) -> None:
    path = board / "records/Toy-v0/me--knows/seed-0.json"
    request = Request(tier="replayed", episodes=10, seed=0, scenario=ID)
    *passed, last = verify(path, board / "records", request)
    assert all(check.passed for check in passed)
    assert (last.passed, last.found) == (
        True,
        "an agent that learned online has none, so its highest tier is recomputed",
    )
    assert tier_of(path) == "recomputed"


@pytest.mark.parametrize(
    "uses",
    [
        {"demonstrations": "never", "questions": "never", "reference": False, "online": False},
        {"demonstrations": "throughout", "questions": "never", "reference": False, "online": True},
        {"online": True},
    ],
)
def test_a_record_that_claims_online_learning_and_prior_data_is_refused(
    uses: dict[str, Any], board: Path, tmp_path: Path
) -> None:
    values = json.loads((board / "records/Toy-v0/me--knows/seed-0.json").read_text(encoding="utf-8"))
    values["run"]["uses"] = uses
    path = tmp_path / "Toy-v0/me--knows/seed-0.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(sealed(values)), encoding="utf-8")
    table = compute_board(tmp_path)
    assert not table.rows
    assert table.not_shown[0].reason == "run: uses of an agent that learned online must hold nothing else."
