"""A stranger's scenario: its registration, and the errors of wrong ones."""

import dataclasses
import multiprocessing
import sys
import types
from collections.abc import Iterator
from typing import Any

import gymnasium
import pytest

from clbench.base.errors import WrongTypeError
from clbench.spec.language import UnknownWordError
from clbench.spec.registry import load_scenario, opened_scenario, register
from clbench.spec.scenario import Scenario
from clbench.testing import TOY

MINE = dataclasses.replace(TOY, id="me/Mine-v0")


@pytest.fixture(autouse=True)
def module() -> Iterator[types.ModuleType]:
    """A stranger's module, and a registry that forgets what a test registers."""
    module = types.ModuleType("strangers_module")
    vars(module).update(MINE=MINE, MORE=(MINE,), task=MINE.target[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, module.__name__, module)
        patch.setattr("gymnasium.envs.registration.registry", dict(gymnasium.registry))
        patch.setattr("gymnasium.registry", gymnasium.envs.registration.registry)
        yield module


def test_one_call_makes_a_scenario_and_its_environments() -> None:
    register("me/Mine-v0", "strangers_module:MINE")
    assert load_scenario("me/Mine-v0") is MINE
    assert gymnasium.make("me/Mine-v0").unwrapped.scenario is MINE  # type: ignore[attr-defined]
    many = gymnasium.make_vec("me/Mine-v0", num_envs=2)
    assert type(many.unwrapped).__name__ == "ScenarioVectorEnv"
    register("me/Mine-v0", "strangers_module:MINE")  # a module may be imported again


def test_nothing_is_imported_before_it_is_used() -> None:
    register("me/Later-v0", "no_such_module:SCENARIO")
    with pytest.raises(
        LookupError, match="No module 'no_such_module' can be imported for 'no_such_module:SCE"
    ):
        load_scenario("me/Later-v0")
    with pytest.raises(LookupError, match="No module 'no_such_module' can be imported"):
        gymnasium.make("me/Later-v0")


@pytest.mark.parametrize(
    ("name", "entry_point", "message"),
    [
        ("Mine-v0", "strangers_module:MINE", "must be of the form namespace/Name-v0"),
        ("me/Mine", "strangers_module:MINE", "must be of the form namespace/Name-v0"),
        ("me/../x-v0", "strangers_module:MINE", "must be of the form namespace/Name-v0"),
        ("c1bench/Mine-v0", "strangers_module:MINE", "would take for a scenario of clbench"),
        ("clbench/fetch-v1", "strangers_module:MINE", "would take for 'clbench/Fetch-v1'"),
        ("clbench/Mine-v0", "strangers_module:MINE", "in the namespace of clbench: choose your own"),
        (
            "clbench/Fetch-v1",
            "clbench.testing:TOY",
            "is already registered, with another entry point than 'clbench.testing:TOY'",
        ),
        (
            "me/Mine-v0",
            "strangers_module",
            "The entry point of a scenario must have the form 'package.module:SCENARIO'",
        ),
        ("me/Mine-v0", "strangers_module.MINE:", "The entry point of a scenario must have the form"),
        ("me/Mine-v0", ":MINE", "The entry point of a scenario must have the form"),
    ],
)
def test_a_wrong_registration_is_refused_by_name(name: str, entry_point: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        register(name, entry_point)


@pytest.mark.parametrize(
    ("entry_point", "message"),
    [
        ("strangers_module:MINNE", "No entry point 'strangers_module:MINNE': .* Did you mean 'MINE'"),
        ("strangers_module:MORE", "'strangers_module:MORE' must be a Scenario, not an object of type tuple"),
    ],
)
def test_a_place_without_a_scenario_is_named_when_it_is_used(entry_point: str, message: str) -> None:
    register("me/Other-v0", entry_point)
    with pytest.raises(LookupError, match=message):
        load_scenario("me/Other-v0")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("lab/Two-v0", "name the module too, as 'module:lab/Two-v0'"),
        ("strangers_module:lab/Two-v0", "'strangers_module' was imported, and does not register it"),
        ("clbench/Fetch-v2", "Did you mean 'clbench/Fetch-v1'"),
        ("Fetch", "Did you mean 'clbench/Fetch-v1'"),
    ],
)
@pytest.mark.usefixtures("module")
def test_an_id_that_nobody_registered_is_refused_with_what_was_probably_meant(
    name: str, message: str
) -> None:
    with pytest.raises(LookupError, match=message):
        load_scenario(name)


def test_an_id_that_the_scenario_does_not_have_is_named() -> None:
    register("me/Other-v0", "strangers_module:MINE")
    for use in (load_scenario, gymnasium.make, gymnasium.make_vec):
        with pytest.raises(LookupError, match="registered as 'me/Other-v0', but its id is 'me/Mine-v0'"):
            use("me/Other-v0")


def test_another_environment_with_the_same_scenario_does_not_take_its_name() -> None:
    register("me/Mine-v0", "strangers_module:MINE")
    register("me/Alias-v0", "strangers_module:MINE")
    arguments = {"scenario": "strangers_module:MINE"}
    gymnasium.register("me/Wrapped-v0", entry_point="lab.environments:Wrapped", kwargs=arguments)
    assert load_scenario("me/Mine-v0").id == "me/Mine-v0"
    with pytest.raises(LookupError, match="registered as 'me/Alias-v0', but its id is 'me/Mine-v0'"):
        load_scenario("me/Alias-v0")


@pytest.mark.parametrize("part", ["retained", "background"])
@pytest.mark.parametrize("named", [True, False])
def test_instructions_of_other_letters_are_refused_when_the_scenario_is_opened(
    part: str, named: bool, module: types.ModuleType
) -> None:
    strange = (dataclasses.replace(TOY.retained[0], name="odd", instructions=("\u5de6",)),)
    parts: dict[str, Any] = {part: strange}
    scenario = dataclasses.replace(MINE, **parts)
    vars(module).update(STRANGE=scenario)
    with pytest.raises(UnknownWordError, match="cannot be spelled with English letters"):
        opened_scenario("strangers_module:STRANGE" if named else scenario)


def test_a_word_with_accents_that_the_vocabulary_has_without_them_gives_no_warning(
    module: types.ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    accents = dataclasses.replace(MINE.target[0], instructions=("push the bl\u00f3ck",))
    vars(module).update(ACCENTS=dataclasses.replace(MINE, target=(accents,)))
    opened_scenario("strangers_module:ACCENTS")
    assert not caplog.records


def test_a_word_near_to_one_of_the_vocabulary_is_spelled_with_one_warning(
    module: types.ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    strange = dataclasses.replace(MINE.target[0], name="odd", instructions=("go wright", "zyx"))
    vars(module).update(ODD=dataclasses.replace(MINE, target=(strange,)))
    for _ in range(2):
        assert opened_scenario("strangers_module:ODD").text_length == 12
    (warning,) = [entry.getMessage() for entry in caplog.records]
    assert (
        "'wright' is not in the vocabulary, so the policy reads it in pieces. Did you mean 'right'?"
        in warning
    )


@pytest.mark.parametrize("given", [None, 5, ["clbench/Fetch-v1"], MINE])
def test_an_id_is_asked_for_where_something_else_is_given(given: Any) -> None:
    with pytest.raises(
        WrongTypeError, match="The id of a scenario is needed, such as 'clbench/Fetch-v1', not "
    ):
        load_scenario(given)
    with pytest.raises(WrongTypeError, match="The id of a scenario is a string such as 'me/Mine-v0', not "):
        register(given, "strangers_module:MINE")


def test_workers_do_not_repeat_the_warning_of_the_command(
    module: types.ModuleType, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: "the command")
    strange = dataclasses.replace(MINE.target[0], instructions=("go wright to the worker",))
    vars(module).update(QUIET=dataclasses.replace(MINE, target=(strange,)))
    opened_scenario("strangers_module:QUIET")
    assert not caplog.records


def _lambda(state: object) -> object:
    """Return nothing of use: an expert must be named, not given."""
    return state


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"horizon": 0}, ValueError, "horizon of right must be at least 1, not 0"),
        ({"horizon": 2.5}, TypeError, "horizon of right must be a whole number, not 2.5"),
        ({"action_noise": 2}, ValueError, "action_noise of right must be from 0 to 1, not 2"),
        (
            {"expert": _lambda},
            TypeError,
            "expert of right must be a string 'module:name' such as '.*:_lambda'",
        ),
        ({"world": "toy"}, ValueError, "world of right must have the form 'module:name', not 'toy'"),
        ({"instructions": ()}, ValueError, "task right needs at least one instruction"),
        ({"instructions": ("go right", " ")}, ValueError, "no instruction may be empty"),
        ({"instructions": "go right"}, TypeError, "must be a tuple of strings, not one string"),
        ({"instructions": ["go right"]}, TypeError, r"must be a tuple of strings, not \"\['go right'\]\""),
        (
            {"packages": "mujoco"},
            TypeError,
            r"packages of right must be a tuple of strings, .* as \(entry,\)",
        ),
        ({"name": "../right"}, ValueError, "cannot be the name of a task"),
        ({"name": "v2.right"}, ValueError, "cannot be the name of a task: letters, digits, _ and - only"),
        ({"suite": "me/table"}, ValueError, "'me/table' cannot be the suite of a task"),
    ],
)
def test_an_impossible_task_is_refused_where_it_is_built(
    changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        dataclasses.replace(TOY.target[0], **changes)


def test_a_scenario_that_has_nothing_to_ask_about_is_refused_where_it_is_built() -> None:
    with pytest.raises(
        ValueError, match=r"a scenario without retained tasks needs scenes \(.*\), .* scenes=target"
    ):
        dataclasses.replace(TOY, retained=())
    assert dataclasses.replace(TOY, retained=(), scenes=TOY.target).scene_tasks == TOY.target
    with pytest.raises(TypeError, match="questions of clbench/Toy-v0 must be a string 'module:name'"):
        dataclasses.replace(TOY, questions=None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"retained": list(TOY.retained)},
            r"retained of clbench/Toy-v0 must be a tuple of Tasks, not .\[<Task",
        ),
        (
            {"held_out": TOY.held_out[0]},
            r"must be a tuple of Tasks, not one Task; write a tuple with one entry as \(entry,\)",
        ),
        (
            {"budget": {"demonstrations": 3}},
            "budget of clbench/Toy-v0 must be a Budget, not .{'demonstrations': 3}",
        ),
    ],
)
def test_a_scenario_of_other_parts_is_refused_where_it_is_built(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        dataclasses.replace(TOY, **changes)


def test_two_tasks_of_one_name_are_refused_where_the_scenario_is_built() -> None:
    with pytest.raises(ValueError, match="me/Mine-v0: two tasks are called 'left'"):
        Scenario("me/Mine-v0", "", TOY.retained, TOY.target, TOY.retained[:1], TOY.questions)


def test_names_that_differ_in_dashes_alone_are_refused_as_their_demonstrations_would_be_the_same() -> None:
    dashed = dataclasses.replace(TOY.target[0], name="up-left")
    with pytest.raises(ValueError, match="tasks cannot be called 'up-left' and 'up_left': _ counts as -"):
        dataclasses.replace(TOY, target=(dashed,))  # it holds out up_left


@pytest.mark.parametrize("held_out", [TOY.held_out, ()])
def test_a_scenario_without_a_stage_is_refused_where_it_is_built(held_out: Any) -> None:
    with pytest.raises(ValueError, match="clbench/Toy-v0: a scenario needs retained or target tasks"):
        dataclasses.replace(TOY, retained=(), target=(), held_out=held_out, scenes=TOY.retained)


def test_tasks_with_different_observations_are_refused_where_the_scenario_is_built() -> None:
    seen = tuple(dataclasses.replace(task, camera="mine:Camera") for task in TOY.target)
    with pytest.raises(ValueError, match=r"the same camera, not \['mine:Camera', 'none'\]"):
        Scenario("me/Mine-v0", "", TOY.retained, seen, (), TOY.questions)
