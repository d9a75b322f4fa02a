"""Run specifications: names are looked up once, and later code receives the resolved run."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny import TINY

from clbench.base.errors import ClbenchError, InputError, UnknownNameError
from clbench.records.reader import check_home
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec, check_device

TOY = "clbench.testing:clbench/Toy-v0"


def test_a_run_learns_no_more_targets_than_there_are() -> None:
    with pytest.raises(InputError, match=r"clbench/Toy-v0 has 2 targets, not 99\."):
        RunSpec(TOY, "sft", 0, targets=99).resolve()


@pytest.mark.long
def test_a_run_looks_up_one_scenario_and_one_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = {"_scenario_at": 0, "load_method": 0}

    def counted(name: str, function: Any) -> Any:
        def count(*arguments: Any) -> Any:
            counts[name] += 1
            return function(*arguments)

        return count

    execute(RunSpec(TINY.id, "sft", 0, targets=1), str(tmp_path / "first"))  # fills the cache
    for module in [one for name, one in sys.modules.items() if name.startswith("clbench.")]:
        for name in counts:
            if name in vars(module):
                monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    execute(RunSpec(TINY.id, "sft", 0, targets=1), tmp_path / "second")
    assert counts == {"_scenario_at": 1, "load_method": 1}


def test_a_seed_of_numpy_becomes_one_that_a_record_can_hold() -> None:
    seed: Any = np.int64(3)
    run = RunSpec("clbench/Fetch-v1", "sft", seed)
    assert run == RunSpec("clbench/Fetch-v1", "sft", 3)
    assert type(run.seed) is int


def test_a_resolved_run_has_all_settings_of_its_record() -> None:
    run = RunSpec(TOY, "experience_replay", 3, {"replay": "0.25"}, order=1, targets=1).resolve()
    assert (run.info.scenario, run.info.method, run.info.seed) == ("clbench/Toy-v0", "experience_replay", 3)
    assert (run.info.changes, run.info.order) == ({"replay": 0.25}, 1)
    assert run.scenario_info.target == ["down"]
    assert [task.name for task in run.published.target] == ["right"]
    assert run.label == "experience_replay+replay=0.25"
    assert run.protocol.target == ("down",)


@pytest.mark.parametrize(
    ("default", "shown"),
    [("print", "<built-in function print>"), ("((1, {'a': 2}),)", r"\(\(1, {'a': 2}\),\)")],
)
def test_a_setting_that_a_record_cannot_hold_is_refused_before_the_run(
    default: str, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = ["from dataclasses import dataclass", "from clbench import Method", "@dataclass"]
    lines += ["class WithLoss(Method):", '    """Has a strange field."""', f"    kind: object = {default}"]
    (tmp_path / "strange_field.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "strange_field", raising=False)
    with pytest.raises(InputError, match=rf"^kind of WithLoss is {shown}, which a record"):
        RunSpec(TOY, "strange_field:WithLoss", 0).resolve()


def test_a_field_without_a_default_is_refused_even_if_the_run_sets_it(
    write_module: Callable[[str, str], None],
) -> None:
    lines = ["from dataclasses import dataclass", "from clbench import Method", "@dataclass"]
    lines += ["class Bare(Method):", '    """Has no default."""', "    strength: float"]
    write_module("bare_field", "\n".join(lines))
    with pytest.raises(InputError, match=r"Bare refuses its hyper-parameters: .* argument: 'strength'"):
        RunSpec(TOY, "bare_field:Bare", 0, {"strength": 1.0}).resolve()


@pytest.mark.parametrize("text", ["0.50", "1.", "5e-1"])
def test_a_run_by_name_has_the_path_of_its_record_however_a_value_was_typed(
    text: str, tmp_path: Path
) -> None:
    spec = RunSpec(TOY, "sft", 0, {"step_factor": text})
    place = tmp_path / "Toy-v0" / f"sft+step_factor={float(text)}" / "seed-0.json"
    assert spec.path(tmp_path) == spec.resolve().path(tmp_path) == place


def test_a_run_with_a_tuple_lies_where_readers_expect_its_record(
    write_module: Callable[[str, str], None], tmp_path: Path
) -> None:
    lines = ["from dataclasses import dataclass", "from clbench import Method", "@dataclass"]
    lines += ["class Paired(Method):", '    """Has a pair."""', "    betas: tuple = (0.9, 0.999)"]
    write_module("paired", "\n".join(lines))
    run = RunSpec(TOY, "paired:Paired", 0, {"betas": (0.5, 0.6)}).resolve()
    assert check_home(run.info, run.path(tmp_path), tmp_path).parts[1] == "paired.Paired+betas=[0.5, 0.6]"


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        (RunSpec("clbench/Fetsh-v1", "sft", 0), UnknownNameError, "Did you mean 'clbench/Fetch-v1'"),
        (RunSpec(TOY, "stf", 0), UnknownNameError, "Did you mean 'sft'"),
        (RunSpec(TOY, "lora", 0, {"rang": 4}), UnknownNameError, "Did you mean 'rank'"),
        (RunSpec(TOY, "lora", 0, {"rank": "four"}), InputError, "rank must be a whole number"),
        (RunSpec(TOY, "sft", 0, order=9), InputError, "not 9"),
    ],
)
def test_a_wrong_name_or_value_is_refused_before_any_work(
    spec: RunSpec, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        spec.resolve()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"scenario": 1}, "scenario of a run must be a string, its id, not 1"),
        ({"method": int}, "method of a run must be a string, its name or 'module:Class', not <class 'int'>"),
        ({"seed": 0.5}, "seed must be a whole number, not 0.5"),
        ({"order": -1}, "order must be at least 0, not -1"),
        ({"targets": 0}, "targets must be at least 1, not 0"),
        ({"split": "validaton"}, 'split of a run must be "test" or "validation", not \'validaton\''),
        ({"split": "train"}, "split of a run must be"),
        ({"perturb": 1}, "perturb of a run must be True or False, not 1"),
        ({"device": 0}, "device of a run must be a string, such as 'cpu', not 0"),
        ({"changes": [("rank", 4)]}, r"changes of a run must be values by name, not \[\('rank', 4\)\]"),
    ],
)
def test_an_impossible_run_is_refused_where_it_is_built(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ClbenchError, match=message):
        RunSpec(**{"scenario": TOY, "method": "sft", "seed": 0, **fields})


def test_a_cpu_has_no_number() -> None:  # its runs would count as those of another device
    with pytest.raises(InputError, match=r"The device 'cpu:0' cannot be used: write 'cpu'\."):
        check_device("cpu:0")


@pytest.mark.parametrize(("device", "touched"), [("cuda", False), ("cuda:1", False), ("cuda:7", True)])
def test_a_gpu_that_exists_is_left_to_the_workers(
    monkeypatch: pytest.MonkeyPatch, device: str, touched: bool
) -> None:
    seen = []
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    monkeypatch.setattr("torch.zeros", lambda *_, device: seen.append(device))
    check_device(device)
    assert bool(seen) == touched
