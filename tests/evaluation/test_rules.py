"""The code of a rule: a threshold that no episode meets counts, and what is about the code does not."""

import dataclasses
import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.evaluation.definition import definition
from clbench.evaluation.rules import rule_code
from clbench.records.fingerprints import other_parts
from clbench.spec.registry import load_scenario
from clbench.testing import TOY

NEAR = """
from clbench.testing import ToyWorld

NEAR = 0.3

def is_near(distance):
    return distance < NEAR

class World(ToyWorld):
    def step(self, action):
        state, reward, success, truncated, info = super().step(action)
        return state, reward, success and is_near(-reward), truncated, info

class Another:
    size = 3
"""
"""A world with the rule of the toy."""

RULES = """
from dataclasses import dataclass

NEAR, FAR = 0.015, 0.5

@dataclass(frozen=True)
class Rule:
    success: object
    reward: object = lambda state: -abs(state)

def within(limit):
    def success(state):
        return abs(state) < limit
    return success

RULES = {"left": Rule(within(NEAR)), "up": Rule(within(FAR))}
"""

WORLD = """
from .rules import RULES

class World:
    rule = RULES
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], str]:
    """Return a function that writes a module anew, by its full name, and returns the name."""
    monkeypatch.syspath_prepend(tmp_path)

    def module(name: str, source: str) -> str:
        path = tmp_path.joinpath(*name.split(".")).with_suffix(".py")
        path.parent.mkdir(exist_ok=True)
        path.write_text(source, encoding="utf-8")
        for known in [one for one in sys.modules if one.partition(".")[0] == name.partition(".")[0]]:
            monkeypatch.delitem(sys.modules, known)
        importlib.invalidate_caches()
        return name

    return module


@pytest.mark.parametrize(
    ("before", "after", "changed"),
    [
        ("NEAR = 0.3", "NEAR = 0.30001", True),
        ("distance < NEAR", "distance <= NEAR", True),
        ("NEAR = 0.3", "NEAR = 0.3  # metres", False),
        ("    return distance", "    'Return whether it is near.'\n    return distance", False),
        ("size = 3", "size = 4", False),
    ],
)
def test_a_threshold_that_moves_a_little_changes_the_rule_of_its_tasks_alone(
    before: str, after: str, changed: bool, module: Callable[[str, str], str]
) -> None:
    found = []
    for name, source in (("one_world", NEAR), ("other_world", NEAR.replace(before, after))):
        task = dataclasses.replace(TOY.retained[0], world=f"{module(name, source)}:World")
        found.append(definition(dataclasses.replace(TOY, retained=(task, *TOY.retained[1:]))))
    assert other_parts(found[1], found[0]) == ([f"rule {TOY.retained[0].name}"] if changed else [])


PLAIN = "def is_near(distance):\n    return distance < NEAR\n"


@pytest.mark.parametrize(
    "near",
    [
        "def is_near(distance):\n    return all(one < NEAR for one in [distance])\n",
        "def is_near(distance):\n    return [one < NEAR for one in [distance]][0]\n",
        "def is_near(distance):\n    return (lambda one: one < NEAR)(distance)\n",
        f"import functools\n@functools.cache\n{PLAIN}",
        f"import numpy\n@numpy.errstate(all='ignore')\n{PLAIN}",
        "LIMITS = frozenset({NEAR, 0.0})\ndef is_near(distance):\n    return distance < max(LIMITS)\n",
    ],
)
def test_a_value_counts_wherever_a_rule_uses_it(near: str, module: Callable[[str, str], str]) -> None:
    source = NEAR.replace(PLAIN, near)
    assert source.count(near) == 1
    codes = []
    for name, limit in (("one_world", "0.3"), ("same_world", "0.3"), ("other_world", "0.30001")):
        world = module(name, source.replace("NEAR = 0.3", f"NEAR = {limit}"))
        codes.append(rule_code(dataclasses.replace(TOY.retained[0], world=f"{world}:World")))
    assert codes[0] == codes[1] != codes[2]


@pytest.mark.parametrize(
    "member",
    [
        "    @functools.cached_property\n    def limit(self):\n        return NEAR\n",
        "    def within(self, limit):\n        return limit\n"
        "    limit = functools.partialmethod(within, NEAR)\n",
        "    @functools.singledispatchmethod\n    def limit(self, one):\n        return one < NEAR\n",
    ],
)
def test_a_value_counts_in_every_kind_of_member(member: str, module: Callable[[str, str], str]) -> None:
    source = f"import functools\nNEAR = 0.3\nclass World:\n{member}"
    codes = []
    for name, text in (("one_world", source), ("other_world", source.replace("0.3", "0.30001"))):
        codes.append(rule_code(dataclasses.replace(TOY.retained[0], world=f"{module(name, text)}:World")))
    assert codes[0] != codes[1]


@pytest.mark.parametrize(
    ("before", "after", "changed"),
    [
        ("NEAR, FAR = 0.015", "NEAR, FAR = 0.025", True),
        ("-abs(state)", "-2 * abs(state)", True),
        ("FAR = 0.015, 0.5", "FAR = 0.015, 0.6", False),
        ('"up": Rule', '"right": Rule(within(1.0)), "up": Rule', False),
    ],
)
def test_of_the_rules_of_a_suite_the_entry_of_the_task_counts_alone(
    before: str,
    after: str,
    changed: bool,
    module: Callable[[str, str], str],
) -> None:
    codes = []
    for suite, source in (("one_suite", RULES), ("other_suite", RULES.replace(before, after))):
        module(f"{suite}.__init__", "")
        module(f"{suite}.rules", source)
        world = module(f"{suite}.world", WORLD)
        codes.append(rule_code(dataclasses.replace(TOY.retained[0], name="left", world=f"{world}:World")))
    assert (codes[0] != codes[1]) == changed


@pytest.mark.parametrize(("changed", "name"), [("world", "LIMIT"), ("rules", "LIMIT"), ("rules", "size")])
def test_values_of_one_name_in_two_modules_both_count(
    changed: str, name: str, module: Callable[[str, str], str]
) -> None:
    sources = {
        "rules": "LIMIT = 0.5\nclass Near:\n    size = 3\ndef far(x): return Near.size * x < LIMIT\n",
        "world": "from .rules import far\nLIMIT = 0.05\nclass Near:\n    size = 4\n"
        "class World:\n    def step(self, x): return far(x) and Near.size * x < LIMIT\n",
    }
    codes = []
    for package, after in (("one_suite", ""), ("other_suite", "1")):
        texts = sources | {changed: sources[changed].replace(f"{name} = ", f"{name} = {after}")}
        for part in ("__init__", "rules", "world"):
            module(f"{package}.{part}", texts.get(part, ""))
        codes.append(rule_code(dataclasses.replace(TOY.retained[0], world=f"{package}.world:World")))
    assert codes[0].replace("one_suite", "other_suite") != codes[1]


def test_objects_that_name_each_other_end(module: Callable[[str, str], str]) -> None:
    source = (
        NEAR
        + """
class Part:
    __slots__ = ("other",)

class Whole:
    pass

WHOLE, PART = Whole(), Part()
WHOLE.part, PART.other, WHOLE.itself = PART, WHOLE, WHOLE
World.whole = WHOLE
"""
    )
    task = dataclasses.replace(TOY.retained[0], world=f"{module('whole_world', source)}:World")
    assert "def is_near" in rule_code(task)


def test_the_rule_of_a_press_has_its_distance() -> None:
    assert "math.hypot(x, y) < 0.015" in rule_code(load_scenario("clbench/Fetch-v1").task("press"))
