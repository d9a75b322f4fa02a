"""Size of the page, and time to make and show it from generated records: `python benchmarks/page.py`.

The records have the shape of Fetch-v1's. A method is two numbers: how well it learns, and how much it keeps.
The goal is less than 3 MB and 20 s. Where Chromium is installed, the published page is opened, too: it should
show its first text at most a second later than an empty page does.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from result_files import write_results

from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import AnswerRow, Costs, EpisodeRow, PolicyRow, Record, RunInfo, ScenarioInfo
from clbench.records.writer import write_record
from clbench.spec.protocol import Split
from clbench.spec.references import COMPARED, REFERENCES

COUNTS = {"methods": 15, "seeds": 5, "scenarios": 4}
GROUPS = {
    "retained": ["reach", "hover", "pick_and_place", "push", "push_left", "push_away"],
    "target": ["lift", "push_right", "pull", "press"],
    "held_out": ["hover_target", "push_left_away"],
}
STEPS = (37, 75, 150, 300)
EPISODES, ON_THE_WAY, VALIDATION, KINDS, ASKED = 20, 5, 10, 14, 72
BUDGET = {
    "test_episodes": EPISODES,
    "curve_episodes": ON_THE_WAY,
    "validation_episodes": VALIDATION,
    "test_questions": KINDS * ASKED,
}
PUBLISHED = Path(__file__).parents[1] / "leaderboard" / "site" / "index.html"
EMPTY = "data:text/html,<p>empty</p>"
PAINT = "performance.getEntriesByName('first-contentful-paint')"


def main() -> None:
    """Measure the page, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, help="where to keep the page")
    arguments = parser.parse_args()
    text, result = measure(**COUNTS)
    if arguments.output:
        arguments.output.write_text(text, encoding="utf-8")
    if chromium := shutil.which("chromium") or shutil.which("chromium-browser"):
        addresses = {"published page": PUBLISHED.as_uri(), "empty page": EMPTY}
        result["first_text_ms"] = {name: first_text(chromium, one) for name, one in addresses.items()}
    write_results("page", result)
    print(result)


def measure(methods: int, seeds: int, scenarios: int) -> tuple[str, dict[str, Any]]:
    """Return the page of generated records, and its rows, megabytes and seconds."""
    compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
    page, pictures = (resolve(f"clbench.leaderboard.views.page.html:{name}") for name in ("page", "pictures"))
    with tempfile.TemporaryDirectory() as folder:
        records = Path(folder) / "leaderboard" / "records"
        make_records(records, methods, seeds, scenarios)
        begin = time.perf_counter()
        board = compute_board(records)
        read = time.perf_counter()
        if board.not_shown:  # a page without rows is made in no time
            raise SystemExit(f"The records are refused: {board.not_shown[0].reason}")
        text = page(board, {})
        pictures(board)
        end = time.perf_counter()
    counts = {"methods": methods, "seeds": seeds, "scenarios": scenarios, "rows": len(board.rows)}
    seconds = {"board": read - begin, "page and pictures": end - read}
    return text, {**counts, "megabytes": len(text.encode()) / 1e6, "seconds": seconds}


def first_text(chromium: str, address: str) -> float:
    """Return the milliseconds until a browser shows the first text of a page, the median of five times."""
    from playwright.sync_api import sync_playwright  # only here: a browser is not needed otherwise

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        found: list[float] = []
        for _ in range(5):
            page = browser.new_page()
            page.goto(address)
            page.wait_for_function(f"{PAINT}.length")
            found.append(page.evaluate(f"{PAINT}[0].startTime"))
            page.close()
        browser.close()
    return statistics.median(found)


def make_records(folder: Path, methods: int, seeds: int, scenarios: int) -> None:
    """Write the records of `methods` methods on each of `scenarios` scenarios with each of `seeds` seeds."""
    names = [*COMPARED, *(f"method_{number}" for number in range(methods))][:methods]
    for scenario, (number, method), seed in product(range(scenarios), enumerate(names), range(seeds)):
        generator = np.random.default_rng([scenario, number, seed])
        learns, keeps = np.random.default_rng([scenario, number]).random(2)
        record = made_record(f"clbench/Made{scenario}-v0", method, seed, 0.5 + learns / 2, keeps, generator)
        write_record(record, record_path(folder, record.run.scenario, method, seed))


def made_record(
    scenario: str, method: str, seed: int, learns: float, keeps: float, generator: np.random.Generator
) -> Record:
    """Return the record of a run in which each stage keeps the share `keeps` of the skills."""
    access = "throughout" if method == "joint" else "never"
    policy = generator.random((len(GROUPS["target"]) * len(STEPS), 2))
    points = list(product(range(1, len(GROUPS["target"]) + 1), STEPS))
    record = Record(
        status="success",
        run=RunInfo(
            scenario=scenario,
            method=method,
            seed=seed,
            device="cpu",
            split="test",
            settings={},
            changes={},
            uses={"demonstrations": access, "questions": access, "reference": method in REFERENCES},
        ),
        scenario=ScenarioInfo(
            id=scenario,
            retained=list(GROUPS["retained"]),
            target=list(GROUPS["target"]),
            held_out=list(GROUPS["held_out"]),
            evaluation_steps=list(STEPS),
            budget=dict(BUDGET),
        ),
        costs=Costs(optimiser_steps=1200, parameters=673700, parameters_added=0, bytes_kept=2304),
        diagnostics={
            str(stage): {
                **{f"share_{number}": float(generator.random()) for number in range(3)},
                "distance": [float(one) for one in 50 * generator.random(11)],
            }
            for stage in range(1, 5)
        },
        fingerprint={
            "definition": {"questions": "0123456789abcdef"},
            "versions": {f"package-{number}": f"{number}.4.2" for number in range(8)},
            "python": "3.11.7",
            "commit": {"id": "0123456789" * 4, "dirty": False},
            "hardware": {"machine": "x86_64", "system": "Linux", "processor": "a slow one"},
            "rollouts": {"world": "65ffb3394577ffdd"},
        },
    )
    for row in _episodes(learns, keeps, generator):
        record.add_episode(row)
    for (stage, step), kind in product([(0, 0), *points], range(KINDS)):
        correct = int(generator.binomial(ASKED, 0.95))
        record.add_answers(AnswerRow(stage, step, f"kind_{kind}", ASKED, correct))
    record.add_policy(PolicyRow(0, 0, 1.0, 0.0, None, None))
    for point, row in zip(points, policy, strict=True):
        record.add_policy(PolicyRow(*point, float(row[0]), float(row[1]), None, None))
    return record


def _episodes(learns: float, keeps: float, generator: np.random.Generator) -> list[EpisodeRow]:
    tasks = [name for names in GROUPS.values() for name in names]
    known = np.array([0.97] * 6 + [0.05] * 4 + [0.2] * 2)
    rows: list[EpisodeRow] = []

    def evaluate(stage: int, step: int, names: list[str], split: Split, count: int) -> None:
        for task, episode in product(names, range(count)):
            success = int(generator.random() < known[tasks.index(task)])
            rows.append(EpisodeRow(stage, step, task, split, episode, success, float(success), 50))

    evaluate(0, 0, tasks, "test", EPISODES)
    for stage, target in enumerate(GROUPS["target"], 1):
        for step in STEPS:
            known *= keeps ** (1 / len(STEPS))
            known[tasks.index(target)] = learns * min(1.0, step / STEPS[1])
            evaluate(stage, step, [target], "validation", VALIDATION)
            if step < STEPS[-1]:
                evaluate(stage, step, [*GROUPS["retained"], target], "test", ON_THE_WAY)
        evaluate(stage, STEPS[-1], tasks, "test", EPISODES)
    return rows


if __name__ == "__main__":
    main()
