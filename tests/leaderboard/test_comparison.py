"""`clbench.compare`: runs that are missing, and the rows of the methods that were asked for."""

from pathlib import Path

import pytest
from tiny import TINY

import clbench
from clbench.base.errors import InputError, UnknownNameError
from clbench.records.reader import read_record
from clbench.records.writer import write_record
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.scoring.metrics import measure
from clbench.scoring.scores import Scores

TOY = "clbench.testing:clbench/Toy-v0"


@pytest.mark.slow  # 5 to 10 s: runs in processes
def test_methods_are_compared_over_the_seeds_that_were_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clbench.run(TOY, "frozen", seeds=2, records=tmp_path)
    clbench.run(TOY, "joint", seeds=1, records=tmp_path)
    capsys.readouterr()
    table = clbench.compare(TOY, ["frozen"], seeds=1, records=tmp_path).set_index("method")
    assert "1 of 2 runs already has a record." in capsys.readouterr().err
    assert sorted(table.index) == ["frozen", "sft"]  # sft by itself; joint was not asked for
    assert list(table["seeds"]) == [1, 1]
    assert table.loc["frozen", "retention"] > table.loc["sft", "retention"]


@pytest.mark.long
def test_methods_are_compared_over_seeds_from_the_first_one_that_was_asked_for(tmp_path: Path) -> None:
    for method in ("sft", "frozen"):
        for seed in (2, 3):
            execute(RunSpec(TINY.id, method, seed), tmp_path)
    table = clbench.compare(TINY.id, "frozen", seeds=1, first_seed=3, records=tmp_path).set_index("method")
    seed_3 = read_record(RunSpec(TINY.id, "sft", 3).path(tmp_path))
    assert list(table["seeds"]) == [1, 1]
    assert table.loc["sft", "retention"] == measure("retention", Scores.from_record(seed_3))


@pytest.mark.long
def test_a_method_whose_record_makes_no_row_is_named_with_the_reason(tmp_path: Path) -> None:
    sft, frozen = (RunSpec(TINY.id, method, seed=0) for method in ("sft", "frozen"))
    execute(sft, tmp_path)
    record = execute(frozen, tmp_path)
    record.fingerprint["rollouts"] = dict.fromkeys(record.fingerprint["rollouts"], "0" * 16)
    write_record(record, frozen.path(tmp_path))
    with pytest.raises(InputError, match=r"No row for sft\. .*sft/seed-0\.json: its simulator does not"):
        clbench.compare(TINY.id, ["frozen"], seeds=1, records=tmp_path)


@pytest.mark.long
def test_a_seed_that_a_row_would_lack_is_named_with_the_reason(tmp_path: Path) -> None:
    for method, seed in (("sft", 0), ("sft", 1), ("frozen", 0)):
        execute(RunSpec(TINY.id, method, seed), tmp_path)
    frozen = RunSpec(TINY.id, "frozen", seed=1)
    record = execute(frozen, tmp_path)
    record.fingerprint["rollouts"] = dict.fromkeys(record.fingerprint["rollouts"], "0" * 16)
    write_record(record, frozen.path(tmp_path))
    with pytest.raises(InputError, match=r"Fewer than 2 seeds for frozen\. .*frozen/seed-1\.json: "):
        clbench.compare(TINY.id, ["frozen"], seeds=2, records=tmp_path)


def test_seeds_for_tuning_are_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="The last seed must be below 100, not 101: the others are for tun"):
        clbench.compare(TOY, "frozen", seeds=4, first_seed=98, records=tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_unknown_method_is_named_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="first_seed must be below 100, not 100: the others are for tuning"):
        clbench.compare(TOY, "frozen", first_seed=100, records=tmp_path)
    with pytest.raises(UnknownNameError, match="Did you mean 'frozen'"):
        clbench.compare(TOY, "frosen", records=tmp_path)
    with pytest.raises(UnknownNameError, match="Did you mean 'my_method:Mine'"):
        clbench.compare(TOY, "my_method.Mine", records=tmp_path)
    assert not list(tmp_path.iterdir())
