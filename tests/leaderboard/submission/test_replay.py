"""Replaying: the policies that a run kept on a machine whose last bits differ."""

import json
import shutil
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file
from verification import verify

from clbench.base.cache import MANIFEST, cached


@pytest.fixture
def elsewhere(honest: Path, tmp_path: Path) -> Path:
    """Return a copy of the honest run whose policies all have another normalisation, by 1e-7."""
    for stage in (honest / "checkpoints").rglob("stage-*"):
        inputs = json.loads((stage / MANIFEST).read_text(encoding="utf-8"))["made_from"]

        def write(folder: Path, stage: Path = stage) -> None:
            shutil.copytree(stage, folder, dirs_exist_ok=True)
            tensors = load_file(stage / "policy.safetensors")
            tensors["state_mean"] += 1e-7
            save_file(tensors, folder / "policy.safetensors")

        place = tmp_path / "elsewhere" / stage.relative_to(honest)
        place.parent.mkdir(parents=True, exist_ok=True)
        cached(place, inputs, write)
    return tmp_path / "elsewhere"


def test_policies_of_another_processor_are_trained_on_from_their_own_normalisation(
    mine: Path, elsewhere: Path
) -> None:
    checks = verify(mine, "replayed", elsewhere)
    assert [check.passed for check in checks if check.name == "from stage to stage"] == [True]
