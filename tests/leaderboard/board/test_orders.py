"""Orders of the targets: runs in other orders appear with the row, and show how much depends on the order."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from helpers import complete_record, data_of, sealed

import clbench
from clbench.base.entry_points import resolve
from clbench.records.paths import record_path
from clbench.records.record import Record
from clbench.records.writer import write_record
from clbench.spec.scenario import target_order

compute_board = resolve("clbench.leaderboard.board.rows:compute_board")
Order, Orders = (resolve(f"clbench.leaderboard.board.orders:{name}") for name in ("Order", "Orders"))

SCENARIO = "clbench/Toy-v0"
BUDGET = {"curve_episodes": 20, "test_episodes": 20, "validation_episodes": 10}
TARGETS = ["target_0", "target_1", "target_2"]


@pytest.fixture
def add(make_record: Callable[..., Record], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that adds the record of a run with a final average, and returns its path."""

    def add(final: float, order: int = 0, seed: int = 0, method: str = "sft") -> Path:
        matrix = np.full((4, 6), final)
        record = make_record(matrix, groups=(2, 3, 1), method=method, seed=seed, complete=False)
        if order:
            record.run.order = order
            record.scenario.target = [TARGETS[place] for place in target_order(3, order)]
        complete_record(record)
        path = record_path(tmp_path / "leaderboard" / "records", SCENARIO, method, seed, order)
        write_record(record, path)
        return path

    return add


@pytest.fixture
def records(tmp_path: Path) -> Path:
    return tmp_path / "leaderboard" / "records"


def load(records: Path) -> pandas.DataFrame:
    frame = clbench.load_board(records)
    assert isinstance(frame, pandas.DataFrame)
    return frame


def test_order_sensitivity_is_the_range_of_the_final_average_over_the_seeds_that_all_orders_have(
    add: Callable[..., Path], records: Path
) -> None:
    for seed, final in enumerate((0.5, 0.7, 1.0)):
        add(final, seed=seed)
    for seed, final in enumerate((0.4, 0.5)):
        add(final, order=1, seed=seed)
        add(final + 0.3, order=2, seed=seed)
    add(0.0, order=2, seed=7)
    (row,) = load(records).itertuples()
    assert row.seeds == 3
    assert row.final_average == pytest.approx(2.2 / 3)  # of the published order alone
    assert row.order_sensitivity == pytest.approx(0.75 - 0.45)


@pytest.mark.parametrize("orders", [[0], [0, 1]])
def test_with_fewer_than_three_orders_there_is_no_order_sensitivity(
    orders: list[int], add: Callable[..., Path], records: Path
) -> None:
    for order in orders:
        add(0.5, order=order)
    assert math.isnan(load(records).order_sensitivity[0])


def test_without_a_seed_that_all_orders_have_there_is_no_order_sensitivity(
    add: Callable[..., Path], records: Path
) -> None:
    for order in range(3):
        add(0.5, order=order, seed=order)
    assert math.isnan(load(records).order_sensitivity[0])


def test_every_order_of_three_targets_counts_also_one_that_is_no_swap(
    add: Callable[..., Path], records: Path
) -> None:
    for order in range(6):
        add(0.5, order=order)
    board = compute_board(records)
    assert board.not_shown == ()
    assert [one.number for one in board.rows[0].orders.orders] == list(range(6))


def test_an_order_without_a_final_average_leaves_no_order_sensitivity() -> None:
    known = [Order(number, (), final) for number, final in enumerate((0.5, 0.7, 0.6))]
    assert Orders((0,), tuple(known)).sensitivity == pytest.approx(0.2)
    assert Orders((0,), (*known, Order(3, (), None))).sensitivity is None


def test_other_orders_change_nothing_else_of_a_row(add: Callable[..., Path], records: Path) -> None:
    add(0.5)
    add(0.6, method="lwf")
    before = load(records)
    for order in (1, 2, 3):
        add(0.9, order=order)
    after = load(records)
    dropped = "order_sensitivity"
    pandas.testing.assert_frame_equal(after.drop(columns=dropped), before.drop(columns=dropped))
    assert after.set_index("method").order_sensitivity.notna().to_dict() == {"sft": True, "lwf": False}


def show(records: Path) -> str:
    """Return the details of all rows of the page, without the breaks of their lines."""
    resolve("clbench.leaderboard.cli:show")(records=records)
    page = (records.parent / "site" / "index.html").read_text(encoding="utf-8")
    return " ".join(" ".join(row["html"] for row in data_of(page)["rows"].values()).split())


def test_the_page_and_the_csv_show_every_order_and_the_range(add: Callable[..., Path], records: Path) -> None:
    for order, final in enumerate((0.5, 0.7, 0.6)):
        add(final, order=order)
    page = show(records)
    names = ", ".join(TARGETS[place] for place in target_order(3, 1))
    assert f'<th scope="row">1</th><td>{names}</td><td class="numeric">0.70</td>' in page
    assert "Order sensitivity: 0.20, the highest minus the lowest." in page
    head, line = (records.parent / "site" / "leaderboard.csv").read_text(encoding="utf-8").splitlines()
    assert dict(zip(head.split(","), line.split(","), strict=True))["order_sensitivity"] == "0.2000"


def test_a_method_that_ran_in_other_orders_alone_has_no_row_and_the_reason_is_shown(
    add: Callable[..., Path], records: Path
) -> None:
    add(0.5)
    add(0.5, order=1, method="ewc")
    assert list(load(records).method) == ["sft"]
    show(records)
    board = (records.parent / "site" / "LEADERBOARD.md").read_text(encoding="utf-8").replace("\\", "")
    assert "ewc/seed-0-order-1.json: its method has no run with the targets in the published order" in board


def edit(path: Path, part: str, **values: Any) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    record[part].update(values)
    path.write_text(json.dumps(sealed(record)), encoding="utf-8")


@pytest.mark.parametrize(
    ("part", "values", "reason"),
    [
        ("run", {"order": 2}, "it belongs at Toy-v0/sft/seed-0-order-2.json"),
        ("run", {"order": 6}, "3 targets have orders 0 to 5, not 6"),
        ("run", {"order": 10**12}, "order must be from 0 to 99"),
        (
            "scenario",
            {"target": TARGETS},
            "the test episode 0 of target_0 (and 29 others) is missing at stage 1",
        ),
        ("scenario", {"budget": BUDGET}, "its scenario does not match most records: budget"),
    ],
)
def test_a_record_that_is_not_of_its_order_is_not_counted(
    part: str, values: dict[str, Any], reason: str, add: Callable[..., Path], records: Path
) -> None:
    add(0.5)
    add(0.5, seed=1)
    path = add(0.5, order=1)
    edit(path, part, **values)
    if values.get("order", 0) > 5:
        path.rename(path.with_name(f"seed-0-order-{values['order']}.json"))
    show(records)
    assert len(load(records)) == 1
    assert reason in (records.parent / "site" / "LEADERBOARD.md").read_text(encoding="utf-8").replace(
        "\\", ""
    )


def test_claims_are_judged_in_the_published_order_alone(
    add: Callable[..., Path], records: Path, tmp_path: Path
) -> None:
    claims = resolve("clbench.leaderboard.pages.cli:claims")
    folders = {"controls": tmp_path / "none", "scenario": SCENARIO}
    add(0.5)
    claims(records=records, output=tmp_path / "before.md", **folders)
    add(0.9, order=1)
    claims(records=records, output=tmp_path / "after.md", **folders)
    assert (tmp_path / "after.md").read_bytes() == (tmp_path / "before.md").read_bytes()


def test_targets_in_an_order_that_is_not_its_own_inverse_are_compared_in_the_published_one(
    add: Callable[..., Path], records: Path
) -> None:
    add(0.5)
    add(0.5, order=3)
    board = compute_board(records)
    assert board.not_shown == ()
    (row,) = board.rows
    assert [order.targets for order in row.orders.orders] == [
        ("target_0", "target_1", "target_2"),
        ("target_1", "target_2", "target_0"),
    ]
