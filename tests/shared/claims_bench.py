"""Records from which claims are judged, and the page made from them."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from helpers import write_unchecked

from clbench.base.entry_points import resolve
from clbench.records.paths import label_of, record_path
from clbench.records.reader import read_record
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.spec.protocol import check_steps
from clbench.testing import TOY

SCENARIO = TOY.id
IDS = [*(f"C{number}" for number in range(1, 9)), *(f"A{number}" for number in range(1, 8))]
IDS += [f"F{number}" for number in range(1, 7)]


class Bench:
    """Folders of records, and the page made from them."""

    def __init__(self, folder: Path, make_record: Callable[..., Record]) -> None:
        self.folder = folder
        self.make_record = make_record
        self.added = 0
        """Number of labels so far: seeds of which no two agree exactly differ in another place for each."""

    def add(
        self,
        label: str,
        *,
        seeds: int = 3,
        kept: Any = 0.2,
        earlier: float = 1.0,
        curve: float = 0.5,
        took: tuple[int, int] | None = None,
        displaced: float | None = None,
        right: tuple[int, int] = (500, 400),
        sparsity: Any = 0.5,
        drift: Any = 1.0,
        costs: dict[str, Any] | None = None,
        diagnostics: dict[str, Any] | None = None,
        edit: Callable[[Record], None] | None = None,
    ) -> None:
        """Add the records of a method, or of changed settings of one.

        Args:
            label: Name with changed settings, such as "lora", "lora+rank=4" or "sft@0.3" of the ladder.
            seeds: Number of seeds.
            kept: Success on the two skills at the end, a number or one for each seed; it is 1 before.
            earlier: Success on the first target at the end.
            curve: Success on a target on the way.
            took: Steps of each stage to the criterion; stages are equally long if None. One seed takes a
                check longer in its first stage: quantities of whole runs that agree have no interval.
            displaced: Success on each new target from displaced starts; no episode is perturbed if None.
            right: Questions of 500 answered rightly at the start and at the end.
            sparsity: Update sparsity at all points, a number or one for each seed. One seed has 0.001 more.
            drift: Activation drift, likewise.
            costs: Fields of `Record.costs` that differ.
            diagnostics: `Record.diagnostics`.
            edit: Changes each record before it is written.
        """
        name, _, factor = label.partition("@")
        method, *changes = name.split("+")
        changed: dict[str, Any] = dict(change.split("=") for change in changes)
        if factor:
            changed["step_factor"] = float(factor)
        odd, self.added = self.added % seeds, self.added + 1
        for seed in range(seeds):
            ends = _a_check_later(took) if took and seed == odd else took
            left = float(np.broadcast_to(kept, seeds)[seed])
            shape = (2, 1) if took else (2, 2)
            on_the_way = (
                {}
                if took
                else {"curves": np.full((2, 1), curve), "retained_curves": np.full((2, 1, 2), left)}
            )
            record = self.make_record(
                [[1, 1, 0, 0, 0], [1, left, 1, 0, 0], [left, left, earlier, 1, 0]],
                groups=(2, 2, 1),
                steps=(100,) if took else (50, 100),
                ends=ends,
                validation=None if took else np.ones((2, 2)),
                sparsity=np.full(shape, np.broadcast_to(sparsity, seeds)[seed] + 0.001 * (seed == odd)),
                drift=np.full(shape, np.broadcast_to(drift, seeds)[seed] + 0.001 * (seed == odd)),
                answers={
                    (0, "left"): (500, right[0]),
                    (1, "left"): (500, right[1]),
                    (2, "left"): (500, right[1]),
                },
                method=method,
                seed=seed,
                changes=changed,
                settings=changed,
                perturbed=None if displaced is None else np.full((3, 2), left),
                perturbed_learned=None if displaced is None else np.full(2, displaced),
                **on_the_way,
            )
            record.costs = dataclasses.replace(record.costs, **(costs or {}))
            record.diagnostics.update(diagnostics or {})
            if edit:
                edit(record)
            path = record_path(self.folder / self.kind(label), SCENARIO, label_of(method, changed), seed)
            write_unchecked(record, path)

    def kind(self, label: str) -> str:
        return "ladder" if "@" in label else "controls" if "+" in label else "records"

    def step_ratio(self, method: str, ratio: float) -> None:
        """Let the runs of a method have measured about this time of a step, divided by sft's."""
        folder = record_path(self.folder / "records", SCENARIO, method, 0).parent
        for number, path in enumerate(sorted(folder.iterdir())):
            record = read_record(path)
            record.timing["step_ratio"] = ratio + 0.001 * (number % 3 - 1)
            write_record(record, path)

    def judge(self, identifier: str) -> Any:
        """Return the finding on one claim."""
        return resolve("clbench.leaderboard.claims.judges:CLAIMS")[identifier].judge(self.evidence())

    def evidence(self) -> Any:
        """Return the evidence."""
        read = resolve("clbench.leaderboard.claims.evidence:read_evidence")
        return read(self.folder / "records", self.folder / "controls")(SCENARIO)

    def page(self) -> str:
        """Return the page."""
        (self.folder / "records").mkdir(parents=True, exist_ok=True)
        output = self.folder / "docs" / "claims.md"
        resolve("clbench.leaderboard.pages.cli:claims")(
            records=self.folder / "records",
            controls=self.folder / "controls",
            scenario=SCENARIO,
            output=output,
        )
        return output.read_text(encoding="utf-8")


def _a_check_later(took: tuple[int, int]) -> tuple[int, int]:
    checks = check_steps(100)
    return checks[checks.index(took[0]) + 1], took[1]


def verdicts(page: str) -> dict[str, str]:
    """Return the verdicts in the table at the top, on its first scenario and without their figures."""
    return {
        line.split("]")[0][3:]: re.split(r":| \|", line.split(" | ", 3)[3])[0]
        for line in page.splitlines()
        if line.startswith("| [")
    }


def section(page: str, identifier: str) -> str:
    """Return the page's text on a claim, without the backslashes of Markdown."""
    found = re.search(rf"^### {identifier}\n(.*?)(?=^#|\Z)", page, re.MULTILINE | re.DOTALL)
    assert found
    return found[1].replace("\\", "")
