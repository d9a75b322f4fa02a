"""A submission as its own package, installed and run as outsiders would, without a network."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from clbench.records.reader import read_record

SOURCE = Path(__file__).parent / "submission"
TOY = "clbench.testing:clbench/Toy-v0"
INSTALLED, BESIDE = "averaging-cl/weight_average", "beside:WeightAverage"


def _python(*arguments: str, folder: Path, path: Path | None = None) -> str:
    """Run a module in `folder`, with the packages installed in `path`, and return what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(path) if path else "", "COLUMNS": "200"}
    command = [sys.executable, "-m", *arguments]
    result = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the submission: building leaves nothing in the checkout."""
    folder = tmp_path_factory.mktemp("stranger") / "submission"
    shutil.copytree(SOURCE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def installed(copy: Path) -> Path:
    """A folder in which the submission is installed."""
    target = copy.parent / "site"
    options = ("--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", "--no-build-isolation")
    _python("pip", "install", *options, "--target", str(target), ".", folder=copy)
    return target


@pytest.mark.long
def test_an_installed_submission_is_listed_as_package_and_name(installed: Path, tmp_path: Path) -> None:
    output = _python("clbench", "list", folder=tmp_path, path=installed)
    assert INSTALLED in output
    assert "Fine-tune, and keep the moving average of the weights." in output


@pytest.mark.slow
def test_its_own_test_passes_where_it_is_installed(installed: Path, copy: Path, tmp_path: Path) -> None:
    shutil.copy(copy / "test_weight_average.py", tmp_path)
    arguments = ("pytest", "-q", "-p", "no:cacheprovider", "test_weight_average.py")
    assert "1 passed" in _python(*arguments, folder=tmp_path, path=installed)


@pytest.mark.slow
def test_it_runs_by_entry_point_and_from_the_working_directory_to_the_same_record(
    installed: Path, copy: Path, tmp_path: Path
) -> None:
    shutil.copy(copy / "weight_average.py", tmp_path / "beside.py")
    arguments = (INSTALLED, BESIDE, "--seeds", "1", "--workers", "1", "--records", "records")
    _python("clbench", "run", TOY, *arguments, folder=tmp_path, path=installed)
    records = [read_record(path) for path in sorted((tmp_path / "records").rglob("seed-0.json"))]
    one, other = records
    assert {record.run.method for record in records} == {INSTALLED, BESIDE}
    assert {record.status for record in records} == {"success"}
    assert (one.episodes, one.answers, one.policy) == (other.episodes, other.answers, other.policy)
    assert set(one.episodes["step"]) == {0, 60}  # it is evaluated at the ends of stages only
