"""An honest record with its policies, and a copy to forge."""

import shutil
from pathlib import Path

import pytest
from verification import TOY

from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


@pytest.fixture(scope="package")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the record of one run, and the policies that it kept."""
    folder = tmp_path_factory.mktemp("honest")
    execute(RunSpec(TOY, "sft", 0), folder / "records", checkpoints=folder / "checkpoints")
    return folder


@pytest.fixture
def mine(honest: Path, tmp_path: Path) -> Path:
    """Return the path of a copy of that record in a folder of its own."""
    shutil.copytree(honest / "records", tmp_path / "records")
    (path,) = (tmp_path / "records").rglob("*.json")
    return path
