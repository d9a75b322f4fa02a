import dataclasses
import sys
import types

import pytest
import torch

from clbench.demonstrations import Demonstrations
from clbench.method import (
    Method,
    Prior,
    Source,
    UndeclaredAccessError,
    build_method,
    load_method,
    method_names,
)


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A module of a stranger, as `stranger`."""
    module = types.ModuleType("stranger")
    monkeypatch.setitem(sys.modules, "stranger", module)

    @dataclasses.dataclass
    class Acme(Method):
        strength: float = 0.5
        rounds: int = 3
        gentle: bool = False

    class Plain(Method):
        pass

    module.Acme, module.Plain, module.Number = Acme, Plain, 3  # type: ignore[attr-defined]
    return module


def test_the_built_in_methods_are_found_as_any_submitted_one() -> None:
    assert {"experience_replay", "from_scratch", "frozen", "joint", "sft"} <= set(method_names())


@pytest.mark.parametrize("name", method_names())
def test_an_installed_method_loads_and_is_built_from_its_defaults(name: str) -> None:
    method = build_method(name, {})
    assert isinstance(method, Method)
    assert type(method).__doc__
    assert all(field.default is not dataclasses.MISSING for field in dataclasses.fields(method))  # type: ignore[arg-type]


def test_a_method_is_found_as_module_and_class(module: types.ModuleType) -> None:
    assert load_method("stranger:Acme") is module.Acme


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("stf", LookupError, r"No method is called 'stf'. Did you mean 'sft'\?"),
        ("stranger:Acmee", LookupError, r"Module 'stranger' has no 'Acmee'. Did you mean 'Acme'\?"),
        ("no_such_module:Acme", LookupError, "No module 'no_such_module' can be imported"),
        ("stranger:Number", TypeError, "'stranger:Number' is not a subclass of clbench.Method"),
        ("stranger:Plain", TypeError, "'stranger:Plain' is not a dataclass"),
    ],
)
@pytest.mark.usefixtures("module")
def test_what_is_no_method_is_refused_by_name(spec: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        load_method(spec)


@pytest.mark.usefixtures("module")
def test_changes_from_the_command_line_take_the_fields_own_types() -> None:
    method = build_method("stranger:Acme", {"strength": "0.25", "rounds": "7", "gentle": "true"})
    assert dataclasses.asdict(method) == {"strength": 0.25, "rounds": 7, "gentle": True}  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"strenght": "1"}, LookupError, r"has no hyper-parameter 'strenght'. Did you mean 'strength'\?"),
        ({"rounds": "many"}, ValueError, "rounds must be int, not 'many'"),
        ({"gentle": "perhaps"}, ValueError, "gentle must be true or false, not 'perhaps'"),
    ],
)
@pytest.mark.usefixtures("module")
def test_a_wrong_change_is_refused_by_name(
    changes: dict[str, str], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        build_method("stranger:Acme", changes)


@pytest.mark.parametrize("name", ["demonstrations", "questions"])
def test_undeclared_prior_data_cannot_be_touched(name: str) -> None:
    with pytest.raises(UndeclaredAccessError, match=f"touches prior {name} that it does not declare"):
        getattr(Prior({}), name)


def test_declared_prior_data_counts_in_bytes() -> None:
    data = Demonstrations(*(torch.zeros(4, 2) for _ in range(5)))
    prior = Prior({"demonstrations": Source(data, torch.Generator(), 8)})
    assert prior.bytes == 5 * 4 * 2 * 4
    prior.close()
    with pytest.raises(UndeclaredAccessError, match="after the seams that it was handed to"):
        prior.demonstrations.sample(1)
