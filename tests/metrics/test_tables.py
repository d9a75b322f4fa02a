"""Tables as CSV files: two layouts with the same numbers, and errors that name the line and the cell."""

from pathlib import Path

import pytest

from clbench.base.errors import InputError
from clbench.metrics import from_csv, from_matrix
from clbench.metrics.tables import EXAMPLES, notes
from clbench.metrics.view import as_values

WIDE = """# where it comes from
method,seed,stage,reach,push,lift
mine,0,0,1.0,0.1,-
mine,0,1,0.8,0.6,
mine,0,2,0.7,0.4,0.9
sft,0,0,1.0,0.1,-
sft,0,1,0.5,0.7,
sft,0,2,0.2,0.3,0.9
"""
LONG = """stage, task, success, method, seed
0, reach, 1.0, mine, 0
0, push, 0.1, mine, 0

1, reach, 0.8, mine, 0
1, push, 0.6, mine, 0
2, reach, 0.7, mine, 0
2, push, 0.4, mine, 0
2, lift, 0.9, mine, 0
0, reach, 1.0, sft, 0
0, push, 0.1, sft, 0
1, reach, 0.5, sft, 0
1, push, 0.7, sft, 0
2, reach, 0.2, sft, 0
2, push, 0.3, sft, 0
2, lift, 0.9, sft, 0
"""


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return tmp_path / "table.csv"


def test_both_layouts_and_arrays_give_the_same_report(table: Path) -> None:
    nan = float("nan")
    mine = [[1.0, 0.1, nan], [0.8, 0.6, nan], [0.7, 0.4, 0.9]]
    sft = [[1.0, 0.1, nan], [0.5, 0.7, nan], [0.2, 0.3, 0.9]]
    reports = [from_matrix({"mine": mine, "sft": sft}, tasks=["reach", "push", "lift"], retained=["reach"])]
    for text in (WIDE, LONG, WIDE.replace("\n", "\r\n"), "\N{ZERO WIDTH NO-BREAK SPACE}" + LONG):
        table.write_bytes(text.encode())
        reports.append(from_csv(table, retained=["reach"]))
    first, *others = [{**as_values(report), "seeds": None} for report in reports]
    assert others == [first] * 4


def test_a_gain_compares_equal_seeds_whatever_their_order_in_the_table(table: Path) -> None:
    rates = {("mine", 0): 0.9, ("mine", 1): 0.4, ("sft", 2): 0.0, ("sft", 1): 0.3, ("sft", 0): 0.8}
    lines = [f"{method},{seed},1,{rate}" for (method, seed), rate in rates.items()]
    table.write_text("\n".join(["method,seed,stage,reach", *lines]), encoding="utf-8")
    gain = from_csv(table).of("gain", "mine")
    # 0.1 with both seeds, and also without either: it is known exactly, though seeds differ by 0.5
    assert gain.value == pytest.approx(0.1)
    assert (gain.low, gain.high) == (None, None)
    table.write_text("\n".join(["method,seed,stage,reach", *lines[:3], *lines[4:]]), encoding="utf-8")
    assert from_csv(table).of("gain", "mine").reason == "Method sft has no seed '1'."


def test_the_groups_and_the_unit_that_are_named_hold_for_a_table(table: Path) -> None:
    text = "stage,known,second,first,never\n1,0.9,0.1,0.8,0.3\n2,0.7,0.6,0.4,0.2\n"
    table.write_text(text, encoding="utf-8")
    targets = ["first", "second"]
    report = from_csv(table, retained="known", target=targets, held_out="never", unit="percent")
    found = [report[name].value for name in ("adaptation", "retention", "zero_shot")]
    assert found == pytest.approx([(0.008 + 0.006) / 2, 0.007, 0.002])
    assert report.unit == "percent"


def test_a_file_of_ones_own_comes_before_an_example_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robocasa365.csv").write_text("stage,reach\n1,0.25\n", encoding="utf-8")
    assert from_csv("robocasa365.csv")["final_average"].value == 0.25


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("folder.csv", "'folder.csv' is a folder"),
        ("loop.csv", "no file 'loop.csv'"),
        ("x" * 300, "no file 'xxx"),
    ],
)
def test_what_is_no_file_is_refused_in_words(
    name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder.csv").mkdir()
    Path("loop.csv").symlink_to("loop.csv")
    with pytest.raises(InputError, match=message) as caught:
        from_csv(name)
    assert "Did you mean" not in str(caught.value)


def test_a_number_with_an_underscore_is_no_rate(table: Path) -> None:
    table.write_text("stage,reach\n1,1_0\n", encoding="utf-8")
    with pytest.raises(InputError, match="found '1_0'"):
        from_csv(table)


def test_stages_that_pandas_wrote_as_floats_are_whole_numbers(table: Path) -> None:
    table.write_text("stage,reach,push\n1.0,0.5,0.5\n2.0,0.5,0.5\n", encoding="utf-8")
    floats = from_csv(table)
    table.write_text("stage,reach,push\n1,0.5,0.5\n2,0.5,0.5\n", encoding="utf-8")
    assert floats["final_average"] == from_csv(table)["final_average"]


def test_the_notes_of_a_table_are_its_lines_that_begin_with_a_hash(table: Path) -> None:
    table.write_text(WIDE, encoding="utf-8")
    assert notes(table) == ["where it comes from"]


def test_every_example_names_its_source_and_can_be_read_by_its_name() -> None:
    names = [path.name for path in EXAMPLES.glob("*.csv")]
    assert "robocasa365.csv" in names
    for name in names:
        assert any(line.startswith("Source: ") for line in notes(EXAMPLES / name))
        assert from_csv(name)["final_average"].value is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stage,reach\n1,0,5\n", "line 2: expected 2 cells, found 3"),
        ("stage,reach\n1,half\n", "line 2, stage 1, task 'reach': expected a success rate such as 0.8 or 80"),
        ("stage,reach\n1,0.5\n1,0.6\n", "line 3: stage 1, task 'reach' was already given on line 2"),
        ("stage,reach\n1,0.5\n1,0.5\n", "line 3: stage 1, task 'reach' was already given on line 2"),
        (
            "stage,reach\nfirst,0.5\n",
            "line 2: stage must be a whole number, the number of targets learned so far, not 'first'",
        ),
        ("stage,reach,push\n1,0.5,0.5\n", "The stages are 1 to 1. Expected stages 1 to 2"),
        ("stage,reach\n1,500\n", "stage 1, task 'reach': expected per cent from 0 to 100, found 500"),
        ("phase,reach\n1,0.5\n", "the column 'stage' is missing"),
        ("stages,reach\n1,0.5\n", "Rename 'stages' to 'stage'"),
        ("stage,task,sucess\n1,reach,0.5\n", "the column 'success' is missing.*Rename 'sucess' to 'success'"),
        ("stage,task,success,sede\n1,reach,0.5,0\n", "unknown column 'sede'.*Did you mean 'seed'"),
        ("stage,reach,reach\n1,0.5,0.5\n", "two columns 'reach'"),
        ("stage,\n1,0.5\n", "a column has no name"),
        (",stage,reach\n0,1,0.5\n", "a column has no name; if it is pandas' index, write with index=False"),
        ("Unnamed: 0,stage,reach\n0,1,0.5\n", "a column has no name; if it is pandas' index"),
        ("stage;reach\n1;0,5\n", "expected commas between the cells, found semicolons"),
        ("stage\treach\n1\t0.5\n", "expected commas between the cells, found tabs"),
        ("stage,Task,Success\n1,reach,0.5\n", "rename the column 'Task' to 'task'"),
        ("Method,stage,reach\nsft,1,0.5\n", "rename the column 'Method' to 'method'"),
        ("method,stage,reach,push\nsft,1,1,0\n,2,1,1\n", "line 3: the method has no name"),
        ("stage,task,success\n1,,0.5\n", "line 2: the task has no name"),
        ("stage,reach\n", "expected a line with the names of the columns, and rows below it"),
        ('stage,reach\n1,"0.5\n', "not a CSV file"),
    ],
)
def test_a_wrong_table_is_refused_with_its_line_and_cell(table: Path, text: str, message: str) -> None:
    table.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=f"^table.csv.*{message}"):
        from_csv(table)


def test_a_file_that_is_no_text_is_refused(table: Path) -> None:
    table.write_bytes(b"stage,reach\n1,\xff\n")
    with pytest.raises(InputError, match="expected a text file in UTF-8"):
        from_csv(table)


def test_a_missing_file_is_refused_with_the_nearest_file_or_example(table: Path) -> None:
    table.write_text(WIDE, encoding="utf-8")
    with pytest.raises(InputError, match=r"There is no file .*Did you mean .*table\.csv"):
        from_csv(table.with_name("tabel.csv"))
    with pytest.raises(InputError, match=r"Did you mean 'robocasa365\.csv'"):
        from_csv("robocasa.csv")
