"""Forged records: each is denied the tier that sees its lie; docs/guide/security.md has the table."""

import importlib
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from verification import TOY, Edit, edit, failures, flip, verify

from clbench.records.reader import home_of, read_record
from clbench.records.record import SCHEMA
from clbench.runs.spec import RunSpec

tiers = importlib.import_module("clbench.leaderboard.board.tiers")

SECURITY = Path(__file__).parents[3] / "docs" / "guide" / "security.md"


class Forgery(NamedTuple):
    """A lie, and the lowest tier that refuses it."""

    tier: str | None
    """None if no repetition can see it."""
    reason: str
    """What its failed check says; empty if there is none."""
    change: Edit
    moves: bool = False
    """Whether the record then lies where its run belongs."""


def set_in(part: str, **changes: Any) -> Edit:
    """Return the edit that sets entries of a part, "fingerprint.versions" for example."""

    def change(values: dict[str, Any]) -> None:
        for name in part.split("."):
            values = values[name]
        values.update(changes)

    return change


def keep(values: dict[str, Any], table: str, kept: Any) -> None:
    """Leave out the rows of a table for which `kept(row by name)` is false."""
    columns = values[table]
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    values[table] = {name: [row[name] for row in rows if kept(row)] for name in columns}


def keep_entries(values: dict[str, Any], kept: Any) -> None:
    """Leave out the entries for which `kept(name)` is false."""
    for name in [name for name in values if not kept(name)]:
        del values[name]


def shorten(values: dict[str, Any], split: str, step: int) -> None:
    """Let the first success of a split at a step of a stage come a step earlier."""
    episodes = values["episodes"]
    rows = zip(episodes["split"], episodes["step"], episodes["success"], strict=True)
    episodes["length"][list(rows).index((split, step, 1))] -= 1


def succeed_at_once(values: dict[str, Any]) -> None:
    """Let the first success need no step."""
    episodes = values["episodes"]
    episodes["length"][episodes["success"].index(1)] = 0


def succeed(values: dict[str, Any], task: str, stage: int) -> None:
    """Turn all test episodes of a task at the end of a stage into successes."""
    episodes = values["episodes"]
    for row in range(len(episodes["success"])):
        if (episodes["task"][row], episodes["stage"][row], episodes["step"][row]) == (task, stage, 60):
            episodes["success"][row] = 1


def answer_more(values: dict[str, Any], step: int) -> None:
    """Let one more question be right at a step of the last stage."""
    answers = values["answers"]
    row = next(
        row
        for row, found in enumerate(zip(answers["stage"], answers["step"], strict=True))
        if found == (2, step) and answers["correct"][row] < answers["asked"][row]
    )
    answers["correct"][row] += 1


def raise_all(values: dict[str, Any], table: str, column: str) -> None:
    values[table][column] = [None if one is None else one + 0.125 for one in values[table][column]]


def repeat_row(values: dict[str, Any]) -> None:
    for column in values["episodes"].values():
        column.append(column[-1])


def leave_out_the_curve(values: dict[str, Any]) -> None:
    for table in ("episodes", "answers", "policy"):
        keep(values, table, lambda row: row["step"] in (0, 60))


def become_older_than_definitions(values: dict[str, Any]) -> None:
    """Write the record as schema 3 did."""
    values["schema"] = 3
    for part, name in (("fingerprint", "definition"), ("policy", "captured"), ("run", "policy")):
        del values[part][name]


def be_of_another_method(values: dict[str, Any]) -> None:
    values["run"] = asdict(RunSpec(TOY, "l2_sp", 0).resolve().info)


def rename_processor(values: dict[str, Any]) -> None:
    hardware = values["fingerprint"]["hardware"]
    hardware["processor"] = f"{hardware['processor'].partition(' ')[0]} Abacus"


FORGERIES = {
    # ---- the record alone, or beside the installed code
    "a failure that ends before the horizon": Forgery(
        "recomputed", "ends of episodes: failed before the horizon", lambda values: flip(values, 1)
    ),
    "an episode longer than its horizon": Forgery(
        "recomputed",
        "ends of episodes: failed before the horizon or ran beyond it: left test episode 0 of stage 0",
        lambda values: values["episodes"]["length"].__setitem__(0, 13),
    ),
    "a success without a step": Forgery(
        "recomputed", "ends of episodes: failed before the horizon or ran beyond it: ", succeed_at_once
    ),
    "an episode counted twice": Forgery(
        "recomputed", "record: episodes: an episode is there twice", repeat_row
    ),
    "failures left out": Forgery(
        "recomputed",
        "episodes: there are none at stage 1",
        lambda values: keep(values, "episodes", lambda row: row["success"]),
    ),
    "a task left out after the last stage": Forgery(
        "recomputed",
        "record: episodes: the test episode 0 of left (and 2 others) is missing at stage 2",
        lambda values: keep(values, "episodes", lambda row: (row["stage"], row["task"]) != (2, "left")),
    ),
    "the curve left out": Forgery(
        "recomputed",
        "record: answers: there must be none",
        lambda values: keep(values, "episodes", lambda row: row["step"] in (0, 60)),
    ),
    "the curve left out, with its answers and changes": Forgery(
        "recomputed",
        "what was run: episodes before the ends of stages differ from the installed code",
        leave_out_the_curve,
    ),
    "a column cut short": Forgery(
        "recomputed",
        "the columns of episodes have different lengths",
        lambda values: values["episodes"]["success"].pop(),
    ),
    "more correct answers than questions": Forgery(
        "recomputed",
        "record: answers: row 13 has impossible numbers",
        lambda values: values["answers"]["correct"].__setitem__(-1, 51),
    ),
    "fewer questions than the budget asks": Forgery(
        "recomputed",
        "record: answers: at stage 2, step 60 other questions were asked than before any target",
        lambda values: values["answers"]["asked"].__setitem__(-1, 40),
    ),
    "another simulator": Forgery(
        "recomputed",
        "simulator: the rollouts of",
        set_in("fingerprint.rollouts", **{"clbench.testing:ToyWorld": "0"}),
    ),
    "another success rule and other questions": Forgery(
        "recomputed",
        "definition: task left, questions differ from the installed code",
        set_in("fingerprint.definition", **{"task left": "0", "questions": "1"}),
    ),
    "no definition": Forgery(
        "recomputed",
        f"a record of schema {SCHEMA}: fingerprint.definition must be an object",
        lambda values: values["fingerprint"].pop("definition"),
    ),
    "a larger budget": Forgery(
        "recomputed", "what was run: scenario.budget", set_in("scenario.budget", adaptation_steps=61)
    ),
    "an easier target": Forgery(
        "recomputed",
        "record: scenario: a task name occurs twice",
        lambda values: values["scenario"].update(target=["left", "down"]),
    ),
    "prior data that was not declared": Forgery(
        "recomputed", "record: run: uses do not match ", set_in("run.uses", demonstrations="throughout")
    ),
    "a setting that the method lacks": Forgery(
        "recomputed", "record: run: settings do not match ", set_in("run.settings", strength=1.0)
    ),
    "a changed setting shown as the default": Forgery(
        "recomputed", "record: run: settings do not match ", set_in("run.settings", step_factor=0.5)
    ),
    "another seed, at the path of this one": Forgery(
        "recomputed", "in the folder of records", set_in("run", seed=7)
    ),
    "another method's name, at the path of this one": Forgery(
        "recomputed", "record: run: uses do not match joint", set_in("run", method="joint")
    ),
    "validation episodes shown as test episodes": Forgery(
        "recomputed",
        "record: episodes: a tuning run has only validation episodes",
        set_in("run", split="validation"),
    ),
    # ---- what the policies of the stages say
    "a success at the end of a stage": Forgery(
        "replayed", "episodes: 1 of ", lambda values: flip(values, 0, 60)
    ),
    "a forgotten skill that is kept": Forgery(
        "replayed", "episodes: ", lambda values: succeed(values, "left", 2)
    ),
    "a shorter validation episode": Forgery(
        "replayed", "episodes: 1 of ", lambda values: shorten(values, "validation", 60)
    ),
    "higher returns": Forgery(
        "replayed", "episodes: ", lambda values: raise_all(values, "episodes", "return")
    ),
    "a correct answer at the end": Forgery(
        "replayed", "answers: different counts", lambda values: answer_more(values, 60)
    ),
    "another seed, at a path of its own": Forgery(
        "replayed", "pretraining does not give the same policy", set_in("run", seed=7), moves=True
    ),
    "another method's name, at a path of its own": Forgery(
        "replayed", "episodes: ", be_of_another_method, moves=True
    ),
    "another pretrained policy": Forgery(
        "replayed", "pretraining does not give the same policy", set_in("fingerprint", pretrained="0" * 16)
    ),
    "other instructions of the processor": Forgery(
        "replayed", " with NEON; here: ", set_in("fingerprint.hardware", instructions="NEON")
    ),
    "another maker of the processor": Forgery(
        "replayed",
        "policies: training does not give the same policy here as on the machine of the record (its "
        "processor: Abacus with ",
        set_in("fingerprint.hardware", processor="Abacus 9000"),
    ),
    "another arithmetic of the processor": Forgery(
        "replayed",
        ", arithmetic 0000000000000000; here: ",
        set_in("fingerprint.hardware", arithmetic="0" * 16),
    ),
    # ---- what only the whole run says
    "a success on the way": Forgery(
        "retrained", "whole run: repeated, episodes (success)", lambda values: flip(values, 0, 30)
    ),
    "a correct answer on the way": Forgery(
        "retrained", "whole run: repeated, answers (correct)", lambda values: answer_more(values, 30)
    ),
    "fewer changed weights": Forgery(
        "retrained",
        "whole run: repeated, policy (update_sparsity)",
        lambda values: values["policy"]["update_sparsity"].__setitem__(-1, 0.99),
    ),
    "fewer bytes kept": Forgery("retrained", "costs (bytes_kept)", set_in("costs", bytes_kept=1)),
    "fewer optimiser steps": Forgery(
        "retrained", "costs (optimiser_steps)", set_in("costs", optimiser_steps=60)
    ),
    "made-up diagnostics": Forgery(
        "retrained", "diagnostics (1)", set_in("diagnostics", **{"1": {"energy": 0.5}})
    ),
    "another version of PyTorch": Forgery(
        "retrained",
        "origin: the record states what is not so here: versions torch 1.0 is ",
        set_in("fingerprint.versions", torch="1.0"),
    ),
    "no hardware": Forgery(
        "retrained",
        "origin: the record states what is not so here: hardware instructions None",
        set_in("fingerprint", hardware=[]),
    ),
    "other authors": Forgery(
        "retrained",
        "origin: the record states what is not so here: method authors somebody is None here",
        set_in("fingerprint.method", authors="somebody"),
    ),
    # ---- what no repetition can see: the reasons are in docs/guide/security.md
    "another commit": Forgery(None, "", set_in("fingerprint.commit", id="0" * 40)),
    "another version of clbench": Forgery(None, "", set_in("fingerprint.versions", clbench="9.0")),
    "another version of Python": Forgery(None, "", set_in("fingerprint", python="3.12.0")),
    "another processor of the same maker": Forgery(None, "", rename_processor),
    "another time of day": Forgery(None, "", set_in("timing", started="2001-01-01T00:00:00+00:00")),
    "a faster run": Forgery(None, "", set_in("timing", seconds=0.01)),
    "no success rules": Forgery(
        None,
        "",
        lambda values: keep_entries(values["fingerprint"]["definition"], lambda name: "rule" not in name),
    ),
    "no definition, as before schema 4": Forgery(None, "", become_older_than_definitions),
    "another source of the method": Forgery(None, "", set_in("fingerprint.method", source="0" * 16)),
}
"""Lies of one record, by what they claim."""


QUICK = [name for name, one in FORGERIES.items() if one.tier in ("recomputed", "replayed")]
SLOW = [name for name in FORGERIES if name not in QUICK]


def check_refusal(name: str, mine: Path, honest: Path) -> None:
    """Forge a record, verify it at the highest tier, and check how far it came."""
    tier, reason, change, moves = FORGERIES[name]
    edit(mine, change)
    if moves:
        home = mine.parents[2] / home_of(read_record(mine).run)
        home.parent.mkdir(exist_ok=True)
        mine = mine.rename(home)
    found = failures(verify(mine, "retrained", honest))
    below = tiers.TIERS[tiers.TIERS.index(tier) - 1] if tier else "retrained"
    assert tiers.tier_of(mine) == below
    assert reason in found
    assert bool(found) == bool(tier)


@pytest.mark.parametrize("name", QUICK)
def test_a_forged_record_is_denied_the_tier_that_sees_its_lie(name: str, mine: Path, honest: Path) -> None:
    check_refusal(name, mine, honest)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_a_lie_that_only_the_whole_run_shows_is_seen_there_or_named(
    name: str, mine: Path, honest: Path
) -> None:
    check_refusal(name, mine, honest)


@pytest.mark.skipif(not SECURITY.exists(), reason="documents are not part of an installed package")
def test_the_page_on_security_has_the_table_of_forgeries() -> None:
    pattern = r"^\| ([^|]*) \| (recomputed|replayed|retrained|none) \|"
    rows = re.findall(pattern, SECURITY.read_text(encoding="utf-8"), re.MULTILINE)
    assert rows == [(name, one.tier or "none") for name, one in FORGERIES.items()]
    assert len(rows) >= 30
