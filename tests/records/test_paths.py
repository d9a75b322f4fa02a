"""Paths of records: every run has a path of its own, inside the folder."""

from pathlib import Path
from typing import Any

import pytest

from clbench.records.paths import label_of, record_path


def test_every_run_has_a_path_of_its_own_below_the_folder(tmp_path: Path) -> None:
    runs: list[Any] = [
        ("clbench/Toy-v0", "sft", 0),
        ("clbench/Toy-v0", "sft", 1),
        ("clbench/Toy-v1", "sft", 0),
        ("clbench/Toy-v0", "sft", 0, 1),
        ("clbench/Toy-v0", "theirs:SFT", 0),
        ("clbench/Toy-v0", "theirs/SFT", 0),
        ("clbench/Toy-v0", "theirs:SFT+strength=2", 0),
        ("theirs/Toy-v0", "sft", 0),
    ]
    paths = {record_path(tmp_path, *run) for run in runs}
    assert len(paths) == len(runs)
    assert all(path.parent.parent.parent == tmp_path for path in paths)


def test_the_order_in_which_settings_were_changed_does_not_matter() -> None:
    changes = {"strength": 2.0, "kappa": 0.5}
    backwards = dict(reversed(changes.items()))
    assert label_of("finch", changes) == label_of("finch", backwards) == "finch+kappa=0.5+strength=2.0"


@pytest.mark.parametrize(
    ("scenario", "label"),
    [
        ("../Toy-v0", "sft"),
        ("clbench/Toy-v0", ".."),
        ("clbench/Toy-v0", "sft+x=../../.."),
        ("/Toy-v0", "sft"),
    ],
)
def test_no_name_leads_out_of_the_folder(scenario: str, label: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be the"):
        record_path(tmp_path, scenario, label, 0)


@pytest.mark.parametrize("place", ["Toy-v0", "Toy-v0/sft", "Toy-v0/sft/seed-0"])
def test_no_link_leads_out_of_the_folder(place: str, tmp_path: Path) -> None:
    """Policies and logs of the run are in the folder seed-0."""
    records = tmp_path / "records"
    (records / place).parent.mkdir(parents=True)
    (records / place).symlink_to(tmp_path)
    with pytest.raises(ValueError, match="a symbolic link leads out of"):
        record_path(records, "clbench/Toy-v0", "sft", 0)
    (tmp_path / "link").symlink_to(records)  # the folder itself may be one
    assert record_path(tmp_path / "link", "theirs/Toy-v0", "sft", 0).parents[2] == tmp_path / "link"
