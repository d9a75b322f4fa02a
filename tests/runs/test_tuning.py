"""Tuning: the same number of settings for every method, and a choice on validation episodes."""

import errno
import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from clbench.base.errors import InputError
from clbench.base.lease import Lease
from clbench.learning.registry import load_method, new_method
from clbench.runs import tuning
from clbench.runs.spec import RunSpec
from clbench.runs.tuning import (
    CONTROL_OF,
    Tried,
    Tuned,
    best_of,
    fixed_settings,
    rated_best,
    refinements,
    rungs,
    tuned,
    write_tuned,
)
from clbench.spec.identifiers import built_in_methods

TOY = "clbench.testing:clbench/Toy-v0"


def _tried(final_average: float, learned: float, factor: float = 1.0) -> Tried:
    return Tried({"step_factor": factor}, final_average, learned)


@pytest.mark.parametrize("name", built_in_methods())
def test_every_method_tries_the_same_number_of_different_settings(name: str) -> None:
    cls = load_method(name)
    first = rungs(cls)
    second = refinements(cls, first[2])
    assert [one["step_factor"] for one in first] == [1.0, 0.3, 0.1, 0.03]
    assert (len(first), len(second)) == (4, 2)
    settings = [tuple(sorted(one.items())) for one in [*first, *second]]
    assert len(set(settings)) == 6
    for one in [*first, *second]:
        new_method(name, cls, one)  # the method accepts them


def test_a_method_without_its_own_strength_tries_learning_rates_between_the_rungs() -> None:
    assert refinements(load_method("sft"), {"step_factor": 0.1}) == [
        {"step_factor": 0.055},
        {"step_factor": 0.18},
    ]
    lowest = refinements(load_method("sft"), {"step_factor": 0.03})
    assert [one["step_factor"] for one in lowest] == [0.0165, 0.054]


def test_a_method_with_its_own_strength_tries_two_values_of_it_at_the_best_rung() -> None:
    cls = load_method("l2_sp")
    assert rungs(cls)[1] == {"strength": 0.3, "step_factor": 0.3}
    found = refinements(cls, {"strength": 0.3, "step_factor": 0.1})
    assert found == [{"strength": 0.1, "step_factor": 0.1}, {"strength": 1.0, "step_factor": 0.1}]


@pytest.mark.parametrize(
    ("tunes", "message"),
    [
        (("strength", 0.1, 10.0), r"tunes of L2SP must be the name of a field and two values of it, \(name"),
        (("strenth", (0.1, 1.0)), "tunes of L2SP must be the name of a field"),
        (("strength", (0.1, -1.0)), "tunes of L2SP: .*strength must be from 0, not -1"),
    ],
)
def test_what_tuning_cannot_try_is_refused_before_any_run(
    tunes: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cls = load_method("l2_sp")
    monkeypatch.setattr(cls, "tunes", tunes)
    with pytest.raises(InputError, match=message):
        rungs(cls)


def test_fixed_hyper_parameters_have_the_same_value_in_all_six_settings() -> None:
    for name in ("consft", "sft"):
        cls = load_method(name)
        first = rungs(cls, {"schedule": 3.25})
        settings = [*first, *refinements(cls, first[2])]
        assert [one["schedule"] for one in settings] == [3.25] * 6
        assert [{**one, "schedule": 0} for one in settings] == [
            {**one, "schedule": 0} for one in [*rungs(cls), *refinements(cls, rungs(cls)[2])]
        ]
        assert fixed_settings(cls, Tuned(settings[5], ())) == {"schedule": 3.25}


@pytest.mark.parametrize("name", ["tau_start", "step_factor"])
def test_hyper_parameters_that_tuning_sets_cannot_be_fixed(name: str) -> None:
    with pytest.raises(InputError, match=f"Tuning ConSFT sets {name}: it cannot be fixed"):
        rungs(load_method("consft"), {name: 1.0})


def test_the_best_final_average_wins_among_settings_that_learn_enough() -> None:
    best, lazy, enough = _tried(0.6, 0.85), _tried(0.7, 0.79), _tried(0.65, 0.8)
    assert best_of([_tried(0.5, 1.0), best, lazy]) is best
    assert best_of([_tried(0.5, 1.0), best, lazy, enough]) is enough


@pytest.fixture
def toy_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return the path of the file from which the settings for the toy are read."""
    path = tmp_path / "tuned" / "Toy-v0.json"
    monkeypatch.setattr(tuning, "tuned_file", lambda _: path)
    tuned.cache_clear()
    yield path
    tuned.cache_clear()


def test_the_first_of_equal_settings_wins() -> None:
    first, second = _tried(0.6, 0.9, 1.0), _tried(0.6, 0.9, 0.3)
    assert best_of([first, second]) is first


def test_where_none_learns_enough_only_those_that_learn_most_are_equals() -> None:
    less, most, equal = _tried(0.7, 0.3, 1.0), _tried(0.5, 0.6, 0.3), _tried(0.4, 0.6, 0.1)
    assert rated_best([less, most, equal]) == [most, equal]


def test_a_setting_that_learns_too_little_is_no_equal_of_the_best() -> None:
    lazy, best, equal = _tried(0.6, 0.79, 1.0), _tried(0.6, 0.9, 0.3), _tried(0.6, 0.8, 0.1)
    assert best_of([lazy, best, equal]) is best
    assert rated_best([lazy, best, equal]) == [best, equal]


def test_if_no_setting_learns_enough_the_one_that_learns_most_wins() -> None:
    most = _tried(0.2, 0.7)
    assert best_of([_tried(0.6, 0.1), most]) is most
    assert best_of([most, _tried(0.6, 0.7)]) is most  # the first on a tie


def test_a_run_takes_the_tuned_settings_unless_it_changes_them(toy_file: Path) -> None:
    settings = {"strength": 2.0, "step_factor": 0.1}
    write_tuned(toy_file, "clbench/Toy-v0", [100, 101], {"l2_sp": Tuned(settings, (_tried(0.6, 0.9),))})
    plain, changed = (RunSpec(TOY, "l2_sp", 0, changes).resolve() for changes in ({}, {"strength": "5"}))
    assert plain.info.settings == settings
    write_tuned(toy_file, "clbench/Toy-v0", [100, 101], {"l2_sp": Tuned({**settings, "strength": 1.0}, ())})
    assert RunSpec(TOY, "l2_sp", 0).resolve().info.settings["strength"] == 1.0
    assert (plain.info.changes, plain.label) == ({}, "l2_sp")
    assert changed.info.settings == {"strength": 5.0, "step_factor": 0.1}
    assert changed.label == "l2_sp+strength=5.0"
    assert RunSpec(TOY, "ewc", 0).resolve().info.settings["step_factor"] == 1.0


def test_settings_tuned_on_another_policy_are_its_own_and_the_other_methods_keep_the_usual_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tuning, "tuned_file", lambda table: tmp_path / f"{table.rpartition('/')[2]}.json")
    tuned.cache_clear()
    usual, other = (Tuned({"step_factor": factor}, (_tried(0.6, 0.9, factor),)) for factor in (0.3, 0.1))
    for table, methods in (("", {"sft": usual, "lwf": usual}), ("+discrete_diffusion", {"sft": other})):
        table = f"clbench/Toy-v0{table}"
        write_tuned(tuning.tuned_file(table), table, [100, 101], methods)
    factors = {
        (method, policy): RunSpec(TOY, method, 0, policy=policy).resolve().info.settings["step_factor"]
        for method in ("sft", "lwf")
        for policy in ("flow", "discrete_diffusion")
    }
    tuned.cache_clear()
    assert [*factors.values()] == [0.3, 0.1, 0.3, 0.3]


def test_a_tuning_run_inherits_nothing_from_an_earlier_choice(toy_file: Path) -> None:
    settings = {"tau_start": 0.03, "schedule": 3.25, "step_factor": 0.1}
    write_tuned(toy_file, "clbench/Toy-v0", [100, 101], {"consft": Tuned(settings, (_tried(0.6, 0.9),))})
    run = RunSpec(TOY, "consft", 100, {"step_factor": 0.3}, split="validation").resolve()
    assert (run.info.settings["schedule"], run.info.settings["tau_start"]) == (1.0, 0.003)


@pytest.mark.parametrize("control", CONTROL_OF)
def test_a_control_has_the_settings_of_its_method_and_differs_in_nothing_else(
    control: str, toy_file: Path
) -> None:
    chosen = Tuned({"loss_scale": 0.02, "step_factor": 0.1}, (_tried(0.6, 0.9),))
    write_tuned(toy_file, "clbench/Toy-v0", [100, 101], {CONTROL_OF[control]: chosen})
    found, method = (RunSpec(TOY, name, 0).resolve().info for name in (control, CONTROL_OF[control]))
    assert found.settings == method.settings
    assert (found.settings["loss_scale"], found.settings["step_factor"]) == (0.02, 0.1)
    assert (found.changes, found.uses) == ({}, method.uses)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            '{"scenario": "me/Other-v0", "seeds": [100], "methods": {}}',
            "of me/Other-v0, not of clbench/Toy-v0",
        ),
        ("{}", "not a settings file of clbench tune"),
        ("[]", "not a settings file of clbench tune"),
        ("task,success", "cannot be read as JSON"),
        (None, "not a settings file"),
    ],
)
def test_settings_are_written_beside_none_but_those_of_the_same_scenario(
    content: str | None, message: str, tmp_path: Path
) -> None:
    path, one = tmp_path / "Toy-v0.json", Tuned({"step_factor": 0.1}, (_tried(0.6, 0.9, 0.1),))
    if content is None:
        path.mkdir()
    else:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        write_tuned(path, "clbench/Toy-v0", [100], {"lwf": one})
    assert path.is_dir() if content is None else path.read_text(encoding="utf-8") == content


def test_a_full_disk_leaves_the_tuned_settings_of_other_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, one = tmp_path / "Toy-v0.json", Tuned({"step_factor": 0.1}, (_tried(0.6, 0.9, 0.1),))
    write_tuned(path, "clbench/Toy-v0", [100], {"sft": one})
    before = path.read_bytes()

    def fill(path: Path, *_: Any, **__: Any) -> int:
        path.touch()
        os.truncate(path, 0)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill)
    with pytest.raises(OSError, match="No space left"):
        write_tuned(path, "clbench/Toy-v0", [100], {"lwf": one})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_tuned_settings_of_other_methods_stay_in_the_file(toy_file: Path) -> None:
    one, other = (Tuned({"step_factor": factor}, (_tried(0.6, 0.9, factor),)) for factor in (0.1, 0.3))
    write_tuned(toy_file, "clbench/Toy-v0", [100], {"sft": one})
    write_tuned(toy_file, "clbench/Toy-v0", [100], {"lwf": other})
    assert tuned("clbench/Toy-v0") == {"lwf": other, "sft": one}


def test_two_commands_that_write_at_once_lose_no_settings(toy_file: Path) -> None:
    one, other = (Tuned({"step_factor": factor}, (_tried(0.6, 0.9, factor),)) for factor in (0.1, 0.3))
    write_tuned(toy_file, "clbench/Toy-v0", [100], {"sft": one})
    ours = json.loads(toy_file.read_text(encoding="utf-8"))
    begun = threading.Event()

    def write_slowly() -> None:
        with Lease(toy_file).held():
            begun.set()
            time.sleep(0.3)
            ours["methods"]["ewc"] = ours["methods"]["sft"]
            toy_file.write_text(json.dumps(ours), encoding="utf-8")

    writer = threading.Thread(target=write_slowly)
    writer.start()
    begun.wait()
    write_tuned(toy_file, "clbench/Toy-v0", [100], {"lwf": other})
    writer.join()
    assert sorted(tuned("clbench/Toy-v0")) == ["ewc", "lwf", "sft"]


def test_settings_of_other_seeds_are_not_written_beside_those_of_other_methods(toy_file: Path) -> None:
    one = Tuned({"step_factor": 0.1}, (_tried(0.6, 0.9, 0.1),))
    write_tuned(toy_file, "clbench/Toy-v0", [100, 101], {"sft": one})
    with pytest.raises(InputError, match=r"its other methods were tuned on seeds \[100, 101\], not \[102\]"):
        write_tuned(toy_file, "clbench/Toy-v0", [102], {"lwf": one})
    write_tuned(toy_file, "clbench/Toy-v0", [102], {"sft": one})  # all methods again


def test_a_whole_number_for_a_fraction_makes_the_same_run(toy_file: Path) -> None:
    runs = [RunSpec(TOY, "l2_sp", 0, {"strength": value}).resolve() for value in (5, 5.0, "5")]
    assert len({run.label for run in runs}) == 1
