"""The snippets of the README, run unchanged; the commands run on the toy, which takes seconds."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import blocks_of

from clbench.base.entry_points import resolve
from clbench.records.reader import read_record
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores

README = Path(__file__).parents[1] / "README.md"
CLAIMS = README.parent / "docs" / "reference" / "claims.md"
BOARD = README.parent / "docs" / "guide" / "board.md"


def _python(code: str, folder: Path) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


def _console(block: str, folder: Path) -> str:
    line = block.strip().replace("clbench/Fetch-v1", "clbench.testing:clbench/Toy-v0")
    line = re.sub(r"--seeds \d+", "--seeds 1", line)
    command = [sys.executable, "-m", *line.split()]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory in which the README's method was saved and run."""
    folder = tmp_path_factory.mktemp("stranger")
    (folder / "my_method.py").write_text(blocks_of(README, "python")[1])
    _console(blocks_of(README, "console")[0], folder)
    return folder


@pytest.mark.slow
def test_the_first_snippet_steps_through_the_scenario(tmp_path: Path) -> None:
    lines = _python(blocks_of(README, "python")[0], tmp_path).splitlines()
    assert lines[0].startswith("0 reach - ")
    assert lines[1].startswith("(28,)")
    assert lines[2] == "['push_right', 'press', 'lift', 'carry_back']"


@pytest.mark.slow
def test_the_second_snippet_is_a_method_that_keeps_all_answers(folder: Path) -> None:
    from clbench import read_record

    answers = read_record(folder / "leaderboard/records/Toy-v0/my_method.HeadOnly/seed-0.json").answers
    correct: dict[tuple[int, int], int] = {}
    for stage, step, right in zip(answers["stage"], answers["step"], answers["correct"], strict=True):
        correct[stage, step] = correct.get((stage, step), 0) + right
    assert len(correct) == 7
    assert len(set(correct.values())) == 1


@pytest.mark.slow
def test_three_commands_lead_from_nothing_to_a_row_on_the_board(tmp_path: Path) -> None:
    (block,) = blocks_of(README, "shell")
    new, check, submit = block.strip().splitlines()
    (toy,) = re.findall(
        r"`(--scenario clbench\.testing[^`]*)`", README.read_text(encoding="utf-8").replace("\n", " ")
    )
    command = [sys.executable, "-m"]
    subprocess.run([*command, *new.split()], cwd=tmp_path, check=True, capture_output=True)
    plain = ["-p", "no:cacheprovider", "-p", "no:xdist"]
    test = shlex.split(check.removeprefix("python -m "), comments=True)
    subprocess.run([*command, *test, *plain], cwd=tmp_path, check=True, capture_output=True)
    words = [*submit.split(), *toy.split()]
    printed = subprocess.run(
        [*command, *words], cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout
    assert "Division prior-data-free: place 1 of 1." in printed
    record = read_record(tmp_path / "try/records/FetchToy-v0/gentle_tuning.GentleTuning/seed-0.json")
    rates = Scores.from_record(record).rates()
    assert rates.retained[0].mean() >= 0.7  # a newcomer's first numbers are no zeros
    assert (measure("adaptation", Scores.from_record(record)) or 0.0) >= 0.5
    assert "gentle" in (tmp_path / "try/site/LEADERBOARD.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_third_snippet_draws_the_table(folder: Path) -> None:
    output = _console(blocks_of(README, "console")[1], folder)
    assert "my_method:HeadOnly" in output
    written = (folder / "leaderboard" / "site" / "LEADERBOARD.md").read_bytes()
    _console(blocks_of(README, "console")[1], folder)
    assert (folder / "leaderboard" / "site" / "LEADERBOARD.md").read_bytes() == written
    printed = _python(blocks_of(README, "python")[2].replace("/Fetch-v1", "/Toy-v0"), folder)
    assert "HeadOnly" in printed
    assert "pretrained" in printed


@pytest.mark.slow
def test_the_pictures_of_the_guide_are_drawn(folder: Path) -> None:
    (code,) = blocks_of(BOARD, "python")
    assert "HeadOnly" in _python(code.replace("/Fetch-v1", "/Toy-v0"), folder)
    assert all((folder / name).stat().st_size for name in ("matrix.png", "curves.png", "plane.pdf"))


def test_the_readme_states_how_many_claims_there_are_and_how_many_are_decided() -> None:
    claims = resolve("clbench.leaderboard.claims.judges:CLAIMS")
    lines = re.findall(r"^\| \[(\w+)\].*? \| .*? \| .*? \| (.*) \|$", CLAIMS.read_text("utf-8"), re.MULTILINE)
    assert {identifier for identifier, _ in lines} == set(claims)
    rows = [(one, cell.partition(":")[0]) for one, cells in lines for cell in cells.split(" | ")]
    papers = {identifier for identifier, claim in claims.items() if not claim.uncounted}
    hold, in_part, fail = (
        len({identifier for identifier, found in rows if found == verdict} & papers)
        for verdict in ("holds", "holds in part", "does not hold")
    )
    text = " ".join(README.read_text(encoding="utf-8").split())
    stated = (
        f"judge {len(papers)} claims of papers. On at least one board, {hold} hold, {in_part} hold in "
        f"part, and {fail} do not hold."
    )
    assert stated in text
