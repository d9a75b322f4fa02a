"""The public contract of a method, checked on the toy in seconds; `docs/guide/contract.md` describes it.

    def test_my_method() -> None:
        check_method(MyMethod)

or, for a test of each clause,

    @pytest.mark.parametrize("check", method_checks(MyMethod), ids=str)
    def test_my_method(check: Check) -> None:
        check()
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import reprlib
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, get_type_hints

from clbench.base.errors import InputError
from clbench.base.seeding import seeded
from clbench.learning.hooks import (
    DECLARATIONS,
    misdeclared,
    misfits,
    own_classes,
    uncalled_functions,
)
from clbench.learning.method import Method
from clbench.learning.prior import Access, Uses
from clbench.learning.registry import read_changes
from clbench.policy.policy import ABILITIES
from clbench.runs.spec import is_setting
from clbench.runs.tuning import values_of_strength
from clbench.spec.policies import DEFAULT_POLICY
from clbench.testing.clauses import (
    Check,
    ContractError,
    check_copy,
    check_ends,
    check_step_factor,
    check_steps_at_end,
)
from clbench.testing.global_state import BY_IMPORTS, GENERATORS, same, watched
from clbench.testing.toy_run import ToyRun, frozen_return, mean_return

TARGETS, STEPS = 2, 2
"""Number of targets, and of optimiser steps on each, in runs whose learning does not matter."""

STEPS_TO_CRITERION = 4
"""Number of steps of a stage with a criterion: it is checked before the first, after two, and after all."""

LEARNING_STEPS = 60
"""Number of optimiser steps within which a method must learn the toy's first target. FINCH with a discrete
policy needs more than 40."""

LEAST_GAIN = 1.0
"""Least rise of the mean return in these steps. Plain fine-tuning gains 16, from -17.6 to -1.3; the built-in
method that moves least, `finch`, gains 2.1."""

SLOWER = 0.3
"""Factor of the learning rate in a run that must leave other weights. Tuning tries it for every method."""

PRIOR = [one.name for one in dataclasses.fields(Uses) if one.name != "reference"]
"""Kinds of prior data, by the fields of `Uses`."""


def check_method(cls: type[Method], *, policy: str = DEFAULT_POLICY, **settings: Any) -> None:
    """Check on the toy that a method keeps the public contract.

    Args:
        cls: Class of the method.
        policy: Name of the policy that it fine-tunes: "flow", "discrete_diffusion", or "module:Class" for one
            of your own.
        settings: Hyper-parameters that differ from its defaults, for example to shorten a long preparation.

    Raises:
        ContractError: The method breaks a clause; the message shows the expected and the actual behaviour,
            and the place to look at.
    """
    for check in method_checks(cls, policy=policy, **settings):
        check()


def method_checks(cls: type[Method], *, policy: str = DEFAULT_POLICY, **settings: Any) -> list[Check]:
    """Return a check for each clause of the contract, for `pytest.mark.parametrize(..., ids=str)`.

    The checks share their runs: together they take no longer than `check_method`.

    Args:
        cls: Class of the method.
        policy: As for `check_method`.
        settings: As for `check_method`.
    """
    subject = Subject(cls, settings, policy)
    return [Check(clause, subject) for clause in CLAUSES]


class Subject:
    """A method with its runs, which several clauses share.

    Args:
        cls: Class of the method.
        settings: Hyper-parameters that differ from its defaults.
        policy: Name of the policy.
    """

    def __init__(self, cls: type[Method], settings: Mapping[str, Any], policy: str) -> None:
        self.cls, self.settings, self.policy = cls, settings, policy

    def build(self, **changes: Any) -> Method:
        """Return a new object of the method, with changes of its settings.

        Raises:
            ContractError: The class refuses its defaults, or the settings.
        """
        try:
            return self.cls(**{**self.settings, **changes})
        except Exception as error:
            found = f"{type(error).__name__}: {error}"
            raise _misbuilt(
                "the defaults, and the settings of the check, to make an object", found
            ) from error

    @cached_property
    def first(self) -> ToyRun:
        """A run with a new object of the method for each stage, as in every run."""
        return ToyRun(self.build, TARGETS, STEPS, policy=self.policy)

    @cached_property
    def second(self) -> ToyRun:
        """The same run again; modules that the method imports on first use are now loaded."""
        _ = self.first
        return ToyRun(self.build, TARGETS, STEPS, policy=self.policy)

    @cached_property
    def kept(self) -> ToyRun:
        """The same run with one object of the method for all stages."""
        return ToyRun(self.build, TARGETS, STEPS, resumed=False, policy=self.policy)

    @cached_property
    def to_criterion(self) -> ToyRun:
        """A run whose stages end early, as in most scenarios."""
        return ToyRun(self.build, TARGETS, STEPS_TO_CRITERION, policy=self.policy, to_criterion=True)

    @cached_property
    def longer(self) -> ToyRun:
        """A run with another seed, long enough to learn the first target."""
        return ToyRun(self.build, 1, LEARNING_STEPS, seed=1, policy=self.policy)

    @cached_property
    def slower(self) -> ToyRun:
        """The first stage of `first` with a smaller `step_factor`."""
        factor = SLOWER * self.build().step_factor
        return ToyRun(lambda: self.build(step_factor=factor), 1, STEPS, policy=self.policy)


# ---- the clauses -------------------------------------------------------------------------------------------


def declaration(subject: Subject) -> None:
    """The class is a documented dataclass whose hooks match those of the loop."""
    cls = subject.cls
    if not (isinstance(cls, type) and issubclass(cls, Method)):
        raise _breach(declaration, "a subclass of clbench.Method", repr(cls), "the class")
    if "__dataclass_fields__" not in vars(cls):
        found = f"{cls.__name__} is not decorated"
        raise _breach(declaration, "a dataclass: @dataclasses.dataclass above the class", found, "the class")
    if not cls.__doc__ or cls.__doc__.startswith(f"{cls.__name__}("):  # the default of dataclass
        expected = "a class docstring whose first line describes the method"
        raise _breach(declaration, expected, "none", "the class")
    _check_declared(cls)
    _check_annotated(cls)
    _check_tunes(cls)
    _check_names(cls)
    _check_signatures(cls)


def _check_declared(cls: type[Method]) -> None:
    """Check the declarations of the class besides its hyper-parameters."""
    fields = {field.name for field in dataclasses.fields(cls)}
    wrong = misdeclared(cls)
    for name in DECLARATIONS:
        if name in wrong:
            raise _breach(declaration, f"{name} to be {wrong[name]}", repr(getattr(cls, name)), name)
        if name in fields:
            expected = f"`{name} = ...` without an annotation, which would make it a hyper-parameter"
            raise _breach(declaration, expected, f"{name} is a field of the dataclass", name)
    unknown = sorted(set(cls.needs) - set(ABILITIES))
    if unknown:
        raise _breach(declaration, f"needs among {', '.join(ABILITIES)}", ", ".join(unknown), "needs")


def _check_tunes(cls: type[Method]) -> None:
    """Check that tuning can try the values that `tunes` names."""
    tried = values_of_strength(cls)
    if tried is None:
        expected = "tunes to be the name of a field and two values of it, (name, (a, b))"
        raise _breach(declaration, expected, repr(cls.tunes), "tunes")
    for settings in tried:
        try:
            read_changes(cls.__name__, cls, settings)
        except InputError as error:
            raise _breach(declaration, "values in tunes that the class takes", str(error), "tunes") from error


def _check_annotated(cls: type[Method]) -> None:
    """Check that every plain value of the class is a hyper-parameter or is marked as a constant."""
    try:
        hints = get_type_hints(cls)
    except NameError as error:
        raise _breach(declaration, "annotations of names that exist", str(error), "the fields") from error
    constants = hints.keys() - {field.name for field in dataclasses.fields(cls)}
    for base in own_classes(cls):
        for name, value in vars(base).items():
            if name in inspect.get_annotations(base) or name in constants or name.startswith("_"):
                continue
            if name in hints or (isinstance(value, bool | int | float | str | tuple) and not name.isupper()):
                expected = (
                    f"hyper-parameters with an annotation, `{name}: {type(value).__name__} = {value!r}`, and "
                    f"constants that begin with _ or are a ClassVar: no run could change {name}"
                )
                raise _breach(declaration, expected, f"`{name} = {value!r}`", name)


def _check_names(cls: type[Method]) -> None:
    """Check that no hook is misspelt: something calls each public function."""
    for name, hint in uncalled_functions(cls).items():
        expected = f"hooks that the loop calls.{hint} Names of helpers begin with _"
        raise _breach(declaration, expected, f"{name}() is never called", f"{name}()")


def _check_signatures(cls: type[Method]) -> None:
    """Check that the loop can call every hook."""
    for hook, (given, taken) in misfits(cls).items():
        found = f"{hook}{taken}" if taken.startswith("(") else taken
        raise _breach(declaration, f"{hook}{given}", found, f"{hook}()")


def constructor(subject: Subject) -> None:
    """The constructor stores its hyper-parameters unchanged, and does nothing else."""
    changes: list[str] = []
    with seeded("constructor"), watched(changes, generators=True):
        _check_fields(subject.cls)
        _check_stored(subject.cls)
    if changes:
        raise _misbuilt("a constructor that only stores values", "; ".join(changes))


def _check_fields(cls: type[Method]) -> None:
    """Check that the fields are hyper-parameters, and that an object has no other attributes."""
    fields = dataclasses.fields(cls)
    for field in fields:
        if not field.init:
            expected = "every field to be a hyper-parameter; the hooks set learned values"
            raise _misbuilt(expected, f"{field.name} has init=False")
        if field.default is field.default_factory is dataclasses.MISSING:
            raise _misbuilt("a default for every hyper-parameter", f"{field.name} has none")
    try:
        method = cls()
    except Exception as error:
        words = f"{type(error).__name__}: {error}"
        raise _misbuilt("the defaults to make an object", words) from error
    more = sorted(vars(method).keys() - {field.name for field in fields})
    if more:
        expected = "only hyper-parameters to be stored; the hooks set learned values"
        raise _misbuilt(expected, f"it sets {', '.join(more)}")
    for field in fields:
        value = getattr(method, field.name)
        if not _is_plain(value):
            expected = "numbers, Booleans, strings, None, or lists of them as hyper-parameters"
            raise _misbuilt(expected, f"{field.name} is a {type(value).__name__}, {reprlib.repr(value)}")
    if method != cls():
        expected = "equal objects from equal arguments, as in any dataclass"
        raise _misbuilt(expected, "two objects with the defaults differ")


def _check_stored(cls: type[Method]) -> None:
    """Check that objects keep their values: the defaults, and other values unless they are refused."""
    expected = "hyper-parameters to be kept unchanged, or refused with a ValueError"
    method = cls()
    for field in dataclasses.fields(cls):
        name = field.name
        default = getattr(method, name) if field.default is dataclasses.MISSING else field.default
        _check_type(cls, name, default)
        for value in (default, *_others(default)):
            try:
                kept = getattr(cls(**{name: value}), name)
            except ValueError:
                continue
            except Exception as error:
                words = f"{name}={value!r} raises {type(error).__name__}: {error}"
                raise _misbuilt(expected, words) from error
            if kept != value:
                raise _misbuilt(expected, f"{name}={value!r} becomes {kept!r}")


def _others(default: Any) -> tuple[Any, ...]:
    """Return other values of the type of a default: above it, and between it and 0."""
    numbers = (default + 1, type(default)(default / 2)) if type(default) in (int, float) else ()
    return (not default,) if type(default) is bool else numbers


def _check_type(cls: type[Method], name: str, default: Any) -> None:
    """Check that a default is of the annotated type, as a run reads other values."""
    try:
        read = read_changes(cls.__name__, cls, {name: default})[name]
    except InputError as error:
        raise _misbuilt("a default of the annotated type", str(error)) from error
    if isinstance(default, str) and read != default:
        raise _misbuilt("a default of the annotated type", f"{name}={default!r} is a string, not {read!r}")


def _misbuilt(expected: str, found: str) -> ContractError:
    return _breach(constructor, expected, found, "the fields, __init__ and __post_init__")


def sound_hooks(subject: Subject) -> None:
    """Hooks run without an error, and return what the loop can use; a copy of the policy acts alone."""
    _ = subject.first
    check_copy(subject.longer.trainer.policy, subject.longer.samples)


def declared_data(subject: Subject) -> None:
    """The method uses exactly the prior data that `uses` declares: divisions rest on these declarations."""
    for name in PRIOR:
        access: Access = getattr(subject.cls.uses, name)
        if access == "never" or _drawn_as(access, subject.first.hooks_that_draw(name)):
            continue
        hooks = subject.longer.hooks_that_draw(name)  # it may draw at few steps
        if not _drawn_as(access, hooks):
            expected = f"prior {name} to be drawn as `uses` declares, {access!r}"
            alone = "drawn in prepare() alone; declare 'prepare'"
            never = "never drawn; leave them out of `uses`"
            raise _breach(declared_data, expected, f"they are {alone if hooks else never}", "uses")


def _drawn_as(access: Access, hooks: set[str]) -> bool:
    """Return whether `access` is the right declaration for data that `hooks` draw."""
    return bool(hooks if access == "prepare" else hooks - {"prepare"})


def same_numbers(subject: Subject) -> None:
    """Two runs with the same seed are equal, bit for bit."""
    difference = subject.first.difference(subject.second)
    if difference:
        raise _breach(
            same_numbers,
            "two runs with one seed to be equal: draw from the sources, from the global generators, which "
            "are seeded for each hook, or from a generator seeded with stage.seed",
            difference,
            "every hook that draws, measures time, or iterates over a set of objects",
        )


def state(subject: Subject) -> None:
    """The state is complete: an object that loads it continues like the object that returned it."""
    difference = subject.second.difference(subject.kept)
    if difference:
        raise _breach(
            state,
            "state() to return everything that later stages need, and load_state() to restore it: an "
            "interrupted run loses attributes of the class and global variables",
            f"a run with a new object for each stage differs from a run with one object: {difference}",
            "state() and load_state()",
        )


def criterion(subject: Subject) -> None:
    """Checks play the policy that a stage leaves, and hooks run in stages that end early, even at step 0."""
    check_ends(subject.first.merges or subject.longer.merges, subject.cls.whole_stages)
    try:
        _ = subject.to_criterion
    except ContractError as error:
        if error.clause == "criterion":
            raise
        expected = (
            "hooks that run in a stage that ends after any number of steps, also after none; with "
            "`whole_stages` each check calls end_task() on a copy, the first check before the first step"
        )
        look = "end_task() and state(), and the attributes that the hooks of a step set for them"
        raise _breach(criterion, expected, error.found, look) from error
    check_steps_at_end(subject.to_criterion.steps_of_merges)


def global_state(subject: Subject) -> None:
    """Hooks leave nothing behind: they change no setting of the process and write no files."""
    once = [entry for entry in subject.first.changes if not entry[1].startswith((*BY_IMPORTS, *GENERATORS))]
    for hook, change in (*once, *subject.second.changes):
        expected = "the process to stay as it was, and files to be written only in clbench's cache"
        raise _breach(global_state, expected, f"after {hook}() {change}", f"{hook}()")


def seeding(subject: Subject) -> None:
    """The run seeds the random generators: draws differ with another seed."""
    first, other = subject.first.generators, subject.longer.generators
    for hook in [hook for hook in first if hook in other]:
        for name in GENERATORS:
            if same(first[hook][name], other[hook][name]):
                expected = "the global generators to keep the run's seed: draw, but do not seed"
                found = f"after {hook}() {name} is in the same state in runs with two seeds"
                raise _breach(seeding, expected, found, f"{hook}()")


def learning(subject: Subject) -> None:
    """The method learns a target: the policy acts better than the pretrained one. References are exempt."""
    if subject.cls.uses.reference:
        return
    before, after = frozen_return(subject.policy), mean_return(subject.longer.trainer.policy)
    if not after - before >= LEAST_GAIN:
        raise _breach(
            learning,
            f"a mean return of {before + LEAST_GAIN:.1f} or more on the toy's first target after "
            f"{LEARNING_STEPS} steps; only a reference, `uses = Uses(reference=True)`, may learn nothing",
            f"{after:.1f}, with {before:.1f} before",
            "start_task(), loss(), gradients() and learning_rate()",
        )
    check_step_factor(subject.first.weights(1), subject.slower.weights(1), SLOWER)


CLAUSES = (
    declaration,
    constructor,
    sound_hooks,
    declared_data,
    same_numbers,
    global_state,
    state,
    criterion,
    seeding,
    learning,
)
"""The clauses of the contract, in the order of the checks."""


def _breach(clause: Callable[[Subject], None], expected: str, found: str, look: str) -> ContractError:
    return ContractError(clause.__name__.replace("_", " "), expected, found, look)


def _is_plain(value: object) -> bool:
    """Return whether a record can hold the value as it is; an infinite number would become a text."""
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError):
        return False
    return is_setting(value)
