"""Many commands that do the same runs in one folder, some of which are killed at random."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

COMMANDS = 8
METHODS = ("sft", "frozen", "lora", "l2_sp")
SEEDS = 13
KILLS = 24

SCENARIOS = """
import dataclasses
from clbench.spec.registry import register
from clbench.testing import TOY

BUDGET = dataclasses.replace(TOY.budget, demonstrations=TOY.budget.demonstrations + 1)
OTHER = dataclasses.replace(TOY, id="me/Other-v0", budget=BUDGET)
register(OTHER.id, "two_versions:OTHER")
"""
"""The toy, and another version of it that shares the folder of demonstrations."""

pytestmark = pytest.mark.slow


def _start(records: Path) -> subprocess.Popen[str]:
    scenarios = "clbench.testing:clbench/Toy-v0,two_versions:me/Other-v0"
    command = [sys.executable, "-m", "clbench", "run", scenarios, *METHODS, "--seeds", str(SEEDS)]
    with open(records.parent / f"{random.getrandbits(64)}.log", "w", encoding="utf-8") as log:
        return subprocess.Popen(
            [*command, "--workers", "1", "--records", str(records)],
            stderr=log,
            text=True,
            start_new_session=True,
            cwd=records.parent,
        )


def _kill(process: subprocess.Popen[str], workers_too: bool) -> None:
    if workers_too:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.wait()


def _go(records: Path, kills: int) -> None:
    """Keep `COMMANDS` commands at work until all runs are done, and kill some of them."""
    chance = random.Random(0)
    records.parent.mkdir(parents=True)
    running = [_start(records) for _ in range(COMMANDS)]
    while running:
        time.sleep(chance.uniform(0.5, 3.0))
        running = [process for process in running if process.poll() is None]
        if kills and running:
            kills -= 1
            _kill(running.pop(chance.randrange(len(running))), workers_too=chance.random() < 0.5)
            running.append(_start(records))


def test_every_run_is_done_once_and_has_one_good_record(
    empty_caches: Path,
    write_module: Callable[[str, str], None],
    lasting_records: Callable[[Path], dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_module("two_versions", SCENARIOS)
    monkeypatch.setenv("PYTHONPATH", str(empty_caches))
    for name, kills in (("cold", KILLS), ("warm", KILLS), ("alone", 0)):
        _go(empty_caches / name / "records", kills)
    found = {name: lasting_records(empty_caches / name / "records") for name in ("cold", "warm", "alone")}
    assert len(found["alone"]) == 2 * len(METHODS) * SEEDS
    assert found["cold"] == found["warm"] == found["alone"]
    assert all(record["status"] == "success" for record in found["alone"].values())
    for name, kills in (("cold", KILLS), ("warm", KILLS), ("alone", 0)):
        logs = [path.read_text(encoding="utf-8") for path in (empty_caches / name).glob("*.log")]
        ends = Counter(
            line.partition(":")[0] for log in logs for line in log.splitlines() if ": adaptation " in line
        )
        assert len(ends) == 2 * len(METHODS) * SEEDS
        assert sum(ends.values()) - len(ends) <= kills, ends.most_common(5)
        assert not any("failed" in log for log in logs)
    for name in found:
        assert _start(empty_caches / name / "records").wait() == 0
    assert list(empty_caches.rglob(".*")) == []
