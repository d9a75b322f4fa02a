import dataclasses
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from helpers import build_method

from clbench.base.errors import InputError, WrongTypeError
from clbench.data.demonstrations import Demonstrations
from clbench.learning.method import Metadata, Method
from clbench.learning.prior import Prior, Source, UndeclaredAccessError
from clbench.learning.registry import (
    describe_method,
    load_method,
    method_names,
    method_packages,
)


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A third-party module named `stranger`."""
    module = types.ModuleType("stranger")
    monkeypatch.setitem(sys.modules, "stranger", module)

    @dataclasses.dataclass
    class Acme(Method):
        strength: float = 0.5
        rounds: int = 3
        gentle: bool = False
        rate = 0.25  # without an annotation it is no field

    class Plain(Method):
        pass

    module.Acme, module.Plain, module.Number = Acme, Plain, 3  # type: ignore[attr-defined]
    return module


def test_the_built_in_methods_are_found_like_submitted_methods() -> None:
    assert {"experience_replay", "from_scratch", "frozen", "joint", "sft"} <= set(method_names())


@pytest.mark.parametrize("name", method_names())
def test_an_installed_method_loads_and_is_built_from_its_defaults(name: str) -> None:
    method = build_method(name, {})
    assert isinstance(method, Method)
    assert type(method).__doc__
    assert all(field.default is not dataclasses.MISSING for field in dataclasses.fields(method))


def test_a_method_can_be_named_by_module_and_class(module: types.ModuleType) -> None:
    assert load_method("stranger:Acme") is module.Acme


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("stf", LookupError, r"No method is called 'stf'. Did you mean 'sft'\?"),
        ("stranger:Acmee", LookupError, r"module 'stranger' has no 'Acmee'. Did you mean 'Acme'\?"),
        ("no_such_module:Acme", LookupError, "No module 'no_such_module' can be imported"),
        ("stranger:Number", TypeError, "'stranger:Number' is not a subclass of clbench.Method"),
        ("stranger:Plain", TypeError, "'stranger:Plain' is not a dataclass"),
        ("flow-base", LookupError, "It is a policy: give it as `--policy flow-base`"),
        (
            "clbench.policy.transformer:TransformerPolicy",
            TypeError,
            "is not a subclass of clbench.Method. It is a policy: give it as `--policy clbench.policy",
        ),
    ],
)
@pytest.mark.usefixtures("module")
def test_an_object_that_is_no_method_is_refused_by_name(
    spec: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        load_method(spec)


@pytest.mark.parametrize("given", [None, 5, Method])
def test_a_name_is_asked_for_where_something_else_is_given(given: Any) -> None:
    with pytest.raises(WrongTypeError, match="The name of a method or 'module:Class' is needed, not "):
        load_method(given)


@pytest.mark.usefixtures("module")
def test_changes_from_the_command_line_take_the_types_of_the_fields() -> None:
    method = build_method("stranger:Acme", {"strength": "0.25", "rounds": "7", "gentle": "true"})
    assert dataclasses.asdict(method) == {
        "step_factor": 1.0,
        "strength": 0.25,
        "rounds": 7,
        "gentle": True,
    }


@dataclasses.dataclass
class Chooses(Method):
    """A method with a choice and a list."""

    mode: Literal["slow", "fast"] = "slow"
    layers: list[int] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Scales(Method):
    """A method with a number that may be whole, and a choice that may be left out."""

    scale: int | float = 1
    mode: Literal["slow", "fast"] | None = "slow"


@dataclasses.dataclass
class Counts(Chooses):
    """A method with a counter, which nobody sets."""

    count: int = dataclasses.field(default=0, init=False)


def test_a_field_that_nobody_sets_is_no_hyper_parameter(stranger: Callable[[type[Method]], str]) -> None:
    with pytest.raises(LookupError, match=r"no hyper-parameter 'count'.* It has: step_factor, mode, layers"):
        build_method(stranger(Counts), {"count": "3"})


def test_a_choice_and_a_list_are_read_from_the_command_line(stranger: Callable[[type[Method]], str]) -> None:
    method = build_method(stranger(Chooses), {"mode": "fast", "layers": "[1, 2]"})
    assert dataclasses.asdict(method) == {"step_factor": 1.0, "mode": "fast", "layers": [1, 2]}


@pytest.mark.parametrize(
    ("name", "given", "held"),
    [
        ("scale", "2", 2),
        ("scale", "2.5", 2.5),
        ("scale", np.int64(2), 2),
        ("scale", np.float64(2), 2.0),
        ("mode", None, None),
        ("mode", "None", None),
    ],
)
def test_a_value_of_a_union_keeps_its_own_type(
    name: str, given: Any, held: Any, stranger: Callable[[type[Method]], str]
) -> None:
    found = getattr(build_method(stranger(Scales), {name: given}), name)
    assert (type(found), found) == (type(held), held)


@pytest.mark.parametrize(("name", "value"), [("mode", "quick"), ("mode", 3)])
def test_a_choice_that_is_none_names_the_choices(
    name: str, value: Any, stranger: Callable[[type[Method]], str]
) -> None:
    with pytest.raises(InputError, match=f"{name} must be 'slow' or 'fast', not {value!r}"):
        build_method(stranger(Chooses), {name: value})


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ('[1, "two"]', "layers: item 2 must be a whole number, not 'two'"),
        ([0.5], "layers: item 1 must be a whole number, not 0.5"),
        (5, r"layers must be list\[int\], not 5"),
        ("5", r"layers must be list\[int\], not '5'"),
        ("1,2", r"layers must be list\[int\], not '1,2': a list is JSON, such as \[1, 2\]"),
    ],
)
def test_a_list_with_an_item_of_another_type_is_refused_by_name(
    value: Any, message: str, stranger: Callable[[type[Method]], str]
) -> None:
    with pytest.raises(InputError, match=message):
        build_method(stranger(Chooses), {"layers": value})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"strenght": "1"}, LookupError, r"has no hyper-parameter 'strenght'. Did you mean 'strength'\?"),
        ({"rate": "1"}, LookupError, "The class sets it without an annotation: write `rate: float = 0.25`"),
        ({"rounds": "many"}, ValueError, "rounds must be a whole number, not 'many'"),
        ({"rounds": 2.5}, ValueError, "rounds must be a whole number, not 2.5"),
        ({"rounds": True}, ValueError, "rounds must be a whole number, not True"),
        ({"strength": None}, ValueError, "strength must be a number, not None"),
        ({"step_factor": 0.0}, ValueError, "step_factor must be a number above 0, not 0.0"),
        ({"step_factor": "inf"}, ValueError, "step_factor must be a number above 0, not inf"),
        ({"gentle": "perhaps"}, ValueError, "gentle must be true or false, not 'perhaps'"),
    ],
)
@pytest.mark.usefixtures("module")
def test_a_wrong_change_is_refused_by_name(
    changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        build_method("stranger:Acme", changes)


def test_a_type_that_only_a_type_checker_knows_is_named(write_module: Callable[[str, str], None]) -> None:
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\nfrom clbench import Method\n"
        "@dataclass\nclass Mine(Method):\n    scale: Factor = 1.0\n"
    )
    write_module("typed_module", text)
    with pytest.raises(InputError, match=r"typed_module:Mine: .*'Factor' is not defined\)\. It must have"):
        build_method("typed_module:Mine", {})


@pytest.mark.parametrize("name", ["demonstrations", "questions"])
def test_a_method_cannot_use_prior_data_that_it_does_not_declare(name: str) -> None:
    with pytest.raises(UndeclaredAccessError, match=f"uses prior {name} that it does not declare"):
        getattr(Prior({}), name)


def test_declared_prior_data_is_counted_in_bytes() -> None:
    data = Demonstrations(*(torch.zeros(4, 2) for _ in range(7)))
    prior = Prior({"demonstrations": Source(data, torch.Generator(), 8)})
    assert prior.bytes == 6 * 4 * 2 * 4
    prior.close()
    with pytest.raises(UndeclaredAccessError, match="after the hooks that received it"):
        prior.demonstrations.sample(1)


@pytest.mark.parametrize(
    "values",
    [
        {},
        {
            "authors": "Ada Lovelace, Élie Cartan",
            "licence": "Apache-2.0 WITH LLVM-exception",
            "version": "1.0rc1",
        },
        {"link": "https://arxiv.org/abs/2605.08879"},
        {"link": "http://example.org:8080/a/b?c=d&e=%20#f"},
    ],
)
def test_metadata_may_be_missing_or_valid(values: dict[str, str]) -> None:
    assert {name: value for name, value in vars(Metadata(**values)).items() if value} == values


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("authors", ""),
        ("authors", " "),
        ("authors", "A" * 201),
        ("authors", "Ada\nLovelace"),
        ("authors", "Ada\u202eLovelace"),
        ("authors", 3),
        ("link", "javascript:alert(1)"),
        ("link", "ftp://example.org"),
        ("link", "https://"),
        ("link", "https://user@example.org"),
        ("link", "https://example.org/a b"),
        ("link", 'https://example.org/"onclick'),
        ("link", "https://example.org/" + "a" * 400),
        ("licence", "MIT; drop"),
        ("licence", ""),
        ("version", "1 0"),
        ("version", "v" * 51),
    ],
)
def test_invalid_metadata_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"{name} in the metadata must be "):
        Metadata(**{name: value})  # type: ignore[arg-type]


def test_a_method_is_described_with_the_hash_of_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert describe_method(load_method("consft"))["link"] == "https://arxiv.org/abs/2605.08879"
    text = "import dataclasses, clbench\n@dataclasses.dataclass\nclass Mine(clbench.Method): ...\n"
    monkeypatch.syspath_prepend(tmp_path)
    hashes = []
    for ending in ("", "CHANGED = True\n"):
        (tmp_path / "described.py").write_text(text + ending)
        found = describe_method(load_method("described:Mine"))
        assert {**found, "source": ""} == {**vars(Metadata()), "source": ""}
        hashes.append(found["source"])
    del sys.modules["described"]
    assert len(set(hashes)) == 2


def test_the_source_of_a_method_covers_the_methods_that_it_derives_from(
    write_module: Callable[[str, str], None],
) -> None:
    write_module(
        "derived",
        "import dataclasses\nfrom clbench.methods.lora import LoRA\n"
        "@dataclasses.dataclass\nclass Mine(LoRA):\n    '''Mine.'''\n",
    )
    assert method_packages(load_method("derived:Mine")) == ["clbench.methods", "derived"]


MIXED = """
import dataclasses
import clbench

class Mixin:
    def scale(self):
        return {factor}

@dataclasses.dataclass
class Mine({bases}):
    def loss(self, policy, batch, progress):
        return self.scale() * policy.action_loss(batch).mean()
"""


@pytest.mark.parametrize("bases", ["Mixin, clbench.Method", "clbench.Method, Mixin"])
def test_the_source_of_a_method_typed_at_a_prompt_covers_all_that_it_derives_from(
    bases: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "__main__", types.ModuleType("__main__"))
    sources = []
    for factor in (1.0, 2.0, 2.0):
        exec(MIXED.format(factor=factor, bases=bases), vars(sys.modules["__main__"]))
        sources.append(describe_method(load_method("__main__:Mine"))["source"])
    assert sources[0] != sources[1] == sources[2]


BEHIND = {
    "a method that it derives from": "base_of_mine",
    "a module that it imports from beside it": "helper_of_mine",
    "a module that its base imports from beside it": "helper_of_base",
}


@pytest.mark.parametrize("changed", BEHIND.values(), ids=BEHIND)
def test_the_source_of_a_method_covers(changed: str, write_module: Callable[[str, str], None]) -> None:
    write_module("helper_of_mine", "")
    write_module("helper_of_base", "")
    write_module(
        "base_of_mine",
        "import dataclasses, helper_of_base\nfrom clbench.methods.lora import LoRA\n"
        "@dataclasses.dataclass\nclass Base(LoRA): 'Base.'\n",
    )
    write_module(
        "derived_with_helpers",
        "import dataclasses, helper_of_mine\nfrom base_of_mine import Base\n"
        "@dataclasses.dataclass\nclass Mine(Base): 'Mine.'\n",
    )
    before = describe_method(load_method("derived_with_helpers:Mine"))["source"]
    path = Path(sys.modules[changed].__file__ or "")
    path.write_text(path.read_text() + "CHANGED = True\n")
    assert describe_method(load_method("derived_with_helpers:Mine"))["source"] != before
    for name in ("derived_with_helpers", *BEHIND.values()):
        del sys.modules[name]
