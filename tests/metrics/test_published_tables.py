"""Published tables, each with its source in its notes: the figures that the sources state come out.

Cells are rounded: a figure computed from them may differ from the stated one in its last digit.
"""

from pathlib import Path

import pytest

from clbench.metrics import Report, from_csv

FOLDER = Path(__file__).parent / "published"
RETAINED = {
    "consft_libero": ("object", "goal"),
    "consft_robotwin": ("single arm", "coordinated"),
}
"""Prior skills of the tables that have some."""

STATED = [
    ("capymoa_hoeffding_tree", "", "performance_continual_world", 0.69),
    ("capymoa_hoeffding_tree", "", "forward_transfer_diaz_rodriguez", 0.05),
    ("capymoa_hoeffding_tree", "", "backward_transfer_diaz_rodriguez", -0.07),
    ("capymoa_fork", "", "performance_continual_world", 0.59),
    ("capymoa_fork", "", "forward_transfer_diaz_rodriguez", 0.07),
    ("capymoa_fork", "", "backward_transfer_diaz_rodriguez", -0.08),
    ("consft_libero", "sft", "retention", 0.09),
    ("consft_libero", "sft", "forgetting", 0.40),
    ("consft_libero", "consft", "retention", 0.34),
    ("consft_libero", "consft", "forgetting", 0.15),
    ("consft_robotwin", "sft", "retention", 0.14),
    ("consft_robotwin", "consft", "retention", 0.28),
]
"""Table, method, definition and the figure that the source states."""


def _report(table: str) -> Report:
    return from_csv(FOLDER / f"{table}.csv", retained=RETAINED.get(table, ()))


@pytest.mark.parametrize(("table", "method", "definition", "stated"), STATED)
def test_a_published_figure_comes_out(table: str, method: str, definition: str, stated: float) -> None:
    assert _report(table).of(definition, method).value == pytest.approx(stated, abs=0.0061)


def test_the_source_of_robocasa365_states_no_forgetting_and_the_definitions_differ() -> None:
    """Its source states the cells alone; these values are worked out by hand."""
    report = from_csv("robocasa365.csv")
    drops = [0.415 - 0.106, 0.245 - 0.017, 0.113 - 0.027]
    assert report["forgetting_avalanche"].value == pytest.approx(sum(drops) / 3)
    assert report["forgetting_continual_world"].value == pytest.approx(sum(drops) / 4)
    assert report["performance_continual_world"].value == pytest.approx((0.106 + 0.017 + 0.027 + 0.043) / 4)


def test_every_published_table_is_tested_and_names_its_source() -> None:
    assert {path.stem for path in FOLDER.glob("*.csv")} == {table for table, *_ in STATED}
    for path in FOLDER.glob("*.csv"):
        assert any(mark in path.read_text(encoding="utf-8") for mark in ("# Source: ", "arXiv ")), path
