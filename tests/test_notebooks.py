"""The notebooks of docs/notebooks/: every cell runs."""

import shutil
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ROOT / "docs" / "notebooks"

pytestmark = pytest.mark.skipif(
    not NOTEBOOKS.exists(), reason="documents are not part of an installed package"
)


def read(path: Path) -> Any:
    return nbformat.reads(path.read_text(encoding="utf-8"), 4)  # type: ignore[no-untyped-call]


def executed(name: str, folder: Path, *replaced: tuple[str, str]) -> Any:
    """Return a notebook with its results, after texts in its cells were replaced."""
    notebook = read(NOTEBOOKS / name)
    for old, new in replaced:
        assert any(old in cell.source for cell in notebook.cells)
        for cell in notebook.cells:
            cell.source = cell.source.replace(old, new)
    # no cell has a limit: on a busy machine one may take minutes
    NotebookClient(
        notebook, timeout=None, startup_timeout=600, resources={"metadata": {"path": str(folder)}}
    ).execute()
    return notebook


def kinds(notebook: Any) -> list[str]:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [kind for output in outputs if "data" in output for kind in output["data"]]


@pytest.mark.slow  # 35 s: it pretrains a toy and runs five methods in processes
def test_the_first_method_runs_and_is_compared(tmp_path: Path) -> None:
    toy = ("clbench.testing.fetch_toy:clbench/FetchToy-v0", "clbench.testing:clbench/Toy-v0")
    fewer = (('"experience_replay", "frozen"', '"frozen"'), ("(0.1, 10.0)", "(10.0,)"))
    notebook = executed("first_method.ipynb", tmp_path, toy, *fewer)
    assert kinds(notebook).count("text/html") >= 6  # the scenario, the record, its matrix, three tables
    assert "image/svg+xml" in kinds(notebook)
    streams = [
        output.text
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "stream"
    ]
    assert "__main__:Anchored seed 0: adaptation" in "".join(streams)


@pytest.mark.slow  # 7 s
@pytest.mark.skipif(not (ROOT / "leaderboard" / "records").exists(), reason="no records")
def test_the_board_is_read(tmp_path: Path) -> None:
    records = ROOT / "leaderboard" / "records" / "Fetch-v1"
    for method in ("sft", "experience_replay", "frozen"):
        shutil.copytree(records / method, tmp_path / "Fetch-v1" / method)
    notebook = executed("reading_the_board.ipynb", tmp_path, ("../../leaderboard/records", str(tmp_path)))
    assert "image/svg+xml" in kinds(notebook)
    assert "experience_replay" in str(notebook)


@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_committed_notebook_has_no_results_that_could_grow_old(path: Path) -> None:
    notebook = read(path)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    nbformat.validate(notebook)
