"""The registry of methods: finds a method by its installed name or by module:Class."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from clbench.base.cache import hash_of
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.base.source import class_hash, has_source, package_of, source_hash
from clbench.base.text import did_you_mean
from clbench.learning.hooks import misdeclared, misfits, uncalled_functions
from clbench.learning.method import Method
from clbench.policy.policy import Policy
from clbench.spec.identifiers import built_in_methods, installed_methods, unknown_method


def method_names() -> list[str]:
    """Return the names of the installed methods, sorted; nothing is imported."""
    return sorted(installed_methods())


def load_method(spec: str) -> type[Method]:
    """Return the method class that `spec` names: an installed name, or "module:Class".

    Raises:
        UnknownNameError: No such method is installed or can be imported; the message names the nearest one.
        InputError: The module of the method raises an error while it is imported.
        WrongTypeError: The object of this name is not a method, has a hook that is misspelt or that the loop
            cannot call, or has a declaration, such as `uses`, of another type.
    """
    if not isinstance(spec, str):
        raise WrongTypeError(f"The name of a method or 'module:Class' is needed, not {spec!r}.")
    if ":" in spec:
        cls = resolve(spec)
    elif spec in (installed := built_in_methods()) or spec in (installed := installed_methods()):
        cls = resolve(installed[spec].value)
    else:
        raise unknown_method(spec)
    if not (isinstance(cls, type) and issubclass(cls, Method)):
        is_policy = isinstance(cls, type) and issubclass(cls, Policy)
        hint = f" It is a policy: give it as `--policy {spec}`." if is_policy else ""
        raise WrongTypeError(f"{spec!r} is not a subclass of clbench.Method.{hint}")
    if "__dataclass_fields__" not in vars(cls):  # only the fields of Method
        raise WrongTypeError(f"{spec!r} is not a dataclass: decorate it with @dataclasses.dataclass.")
    for name, hint in uncalled_functions(cls).items():
        # a misspelt hook would run as plain fine-tuning, and nobody would know
        raise WrongTypeError(f"{spec!r}: nothing calls {name}().{hint} Names of helpers begin with _.")
    for hook, (given, taken) in misfits(cls).items():
        raise WrongTypeError(f"{spec!r}: {hook}() must take {given}, not {taken}.")
    for name, words in misdeclared(cls).items():
        raise WrongTypeError(f"{spec!r}: {name} must be {words}, not {getattr(cls, name)!r}.")
    return cls


def describe_method(cls: type[Method]) -> dict[str, Any]:
    """Return a method's metadata, and as `source` the hash of its package or of its module.

    For a class that was typed at a prompt, `source` is the hash of the class and of what it derives from.
    """
    source = source_hash(*method_packages(cls))
    own = (base for base in cls.__mro__ if base not in Method.__mro__)
    typed = [class_hash(base) for base in own if not has_source(base.__module__)]
    if typed:
        source = hash_of([source, *typed])
    return {**dataclasses.asdict(cls.metadata), "source": source}


def method_packages(cls: type[Method]) -> list[str]:
    """Return the packages, or modules, of a method and of the methods that it derives from."""
    bases = (base for base in cls.__mro__ if issubclass(base, Method) and base is not Method)
    return sorted({package_of(base.__module__) for base in bases})


def read_changes(spec: str, cls: type[Method], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return changed hyper-parameters as the method holds them.

    Args:
        spec: Name of the method, for error messages.
        cls: Class of the method.
        changes: Values by name of the hyper-parameter. A text, which the command line gives, becomes the type
            of the field.

    Raises:
        UnknownNameError: The method has no such hyper-parameter; the message names the nearest one.
        InputError: A value cannot be read as the type of its field, or the method refuses it; or the type of
            a field cannot be read.
    """
    try:
        hints = get_type_hints(cls)
    except (NameError, AttributeError, SyntaxError, TypeError) as error:
        raise InputError(
            f"{spec}: the type of a field cannot be read ({error}). It must have a meaning in the module "
            "itself: a name that is imported under `if TYPE_CHECKING` has none."
        ) from error
    fields = [field.name for field in dataclasses.fields(cls) if field.init]
    values = {}
    for name, value in changes.items():
        if name not in fields:
            raise UnknownNameError(_no_field(spec, cls, name, fields))
        told = f"{spec}: {name}"
        values[name] = (
            _read(told, value, hints[name]) if isinstance(value, str) else _held(told, value, hints[name])
        )
    held = new_method(spec, cls, values)
    return {name: getattr(held, name) for name in values}


def _no_field(spec: str, cls: type[Method], name: str, fields: list[str]) -> str:
    """Return the message that a method has no hyper-parameter of this name."""
    value = getattr(cls, name, None)
    if isinstance(value, int | float | str) and not hasattr(Method, name):
        hint = (
            f" The class sets it without an annotation: write `{name}: {type(value).__name__} = {value!r}`."
        )
    else:
        hint = did_you_mean(name, fields)
    return f"{spec} has no hyper-parameter {name!r}.{hint} It has: {', '.join(fields) or 'none'}."


def new_method(spec: str, cls: type[Method], values: Mapping[str, Any]) -> Method:
    """Return a new object of a method.

    Args:
        spec: Name of the method, for error messages.
        cls: Class of the method.
        values: Hyper-parameters that differ from the defaults, as the method holds them.

    Raises:
        InputError: The method refuses a value.
    """
    try:
        method = cls(**values)
    except Exception as error:
        raise InputError(f"{spec} refuses its hyper-parameters: {error}") from error
    if not (isinstance(method.step_factor, int | float) and 0 < method.step_factor < math.inf):
        raise InputError(f"{spec}: step_factor must be a number above 0, not {method.step_factor!r}.")
    return method


def _held(name: str, value: Any, hint: Any) -> Any:
    """Return a value as a field of the type `hint` holds it: 5 becomes 5.0 for a float without an int."""
    kinds = _kinds(hint)
    items = [get_args(kind) for kind in kinds if get_origin(kind) is list]
    if items and isinstance(value, list):
        return [_held(f"{name}: item {place}", one, items[0][0]) for place, one in enumerate(value, 1)]
    if isinstance(value, np.generic):
        value = value.item()
    if type(value) is int and float in kinds and int not in kinds:
        return float(value)
    choices = _choices(kinds)
    if choices:
        fits = value in choices or (value is None and NoneType in kinds)
    else:
        others = [kind for kind in kinds if kind not in WORDS and get_origin(kind) is not list]
        fits = type(value) in kinds or bool(others)  # the method itself refuses a value of another type
    if not fits:
        raise InputError(f"{name} must be {_words(kinds)}, not {value!r}.")
    return value


WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a string", NoneType: "none"}


def _words(kinds: Iterable[Any]) -> str:
    named = [WORDS.get(kind, str(kind)) for kind in kinds if get_origin(kind) is not Literal]
    return " or ".join([*map(repr, _choices(kinds)), *named])


def _choices(kinds: Iterable[Any]) -> list[Any]:
    """Return the values of the `Literal`s among types."""
    return [choice for kind in kinds if get_origin(kind) is Literal for choice in get_args(kind)]


def _kinds(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _read(name: str, text: str, hint: Any) -> Any:
    """Return `text` as a value of the type `hint`.

    `hint` is str, int, float, bool, a `Literal`, a list, whose text is JSON, or a union of these and None.
    """
    kinds = _kinds(hint)
    if text.lower() == "none" and NoneType in kinds:
        return None
    for choice in _choices(kinds):
        if str(choice) == text:
            return choice
    if any(get_origin(kind) is list for kind in kinds):
        found = None
        with contextlib.suppress(ValueError):
            found = json.loads(text)
        if isinstance(found, list):
            return _held(name, found, hint)
    for kind in (bool, int, float, str):
        if kind not in kinds:
            continue
        if kind is bool and text.lower() in ("true", "false"):
            return text.lower() == "true"
        if kind is not bool:
            with contextlib.suppress(ValueError):
                return kind(text)
    form = ": a list is JSON, such as [1, 2]" if any(get_origin(kind) is list for kind in kinds) else ""
    raise InputError(f"{name} must be {_words(kinds)}, not {text!r}{form}.")
