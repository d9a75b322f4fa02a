"""What a policy sees and does, for a scenario's card: shapes, and what the numbers of a state mean.

The words come from the code: the second paragraph in the docstring of the world's class and of its
camera's, and the module `state` of the world's package with the docstrings of its slices.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
from dataclasses import dataclass

from clbench.base.entry_points import resolve
from clbench.learning.pretraining import policy_config
from clbench.spec.scenario import Scenario

GUIDES = {
    "dm_control": "suites.md#dm_control",
    "fetch": "suites.md#fetch",
    "fetch_pixels": "pixels.md",
    "libero": "libero.md",
    "metaworld": "metaworld.md",
    "metaworld_cw": "metaworld.md",
    "point_maze": "suites.md#pointmaze",
}
"""Pages of docs/guide about the worlds, by suite."""


@dataclass(frozen=True)
class Spaces:
    """What a policy sees and does."""

    state_size: int
    """Numbers of a state, as a policy gets it."""
    image_size: int
    """Width and height of a picture in pixels; 0 without pictures."""
    action_size: int
    """Numbers of an action."""
    words: tuple[str, ...]
    """Paragraphs about actions, rewards and the layout of the state."""
    parts: tuple[tuple[str, str], ...]
    """Places in the state and what they hold; empty if the code does not say."""
    guide: str | None
    """Page of docs/guide about the world; None if it is a stranger's."""


def spaces_of(scenario: Scenario) -> Spaces:
    """Return what a policy sees and does in a scenario."""
    config, first = policy_config(scenario), scenario.tasks[0]
    world = resolve(first.world)
    # for a MuJoCo world, the class of many lanes has the words
    described = getattr(world, "vector_world", world)
    words = [_second_paragraph(described)]
    parts: tuple[tuple[str, str], ...] = ()
    if first.camera is not None:  # a policy sees what the camera passes on, and not the state of the world
        words.append(_second_paragraph(resolve(first.camera)))
    elif (name := _state_module(described.__module__)) is not None:
        text, parts = _layout(name, config.state_size)
        words.append(text)
    return Spaces(
        state_size=config.state_size,
        image_size=config.image_size,
        action_size=config.action_size,
        words=tuple(filter(None, words)),
        parts=parts,
        guide=GUIDES.get(first.suite),
    )


def _second_paragraph(cls: type) -> str:
    """Return the second paragraph of a docstring in one line, empty if it has no text there."""
    second = "".join((inspect.getdoc(cls) or "").split("\n\n")[1:2])
    return "" if second.startswith("Args:") else " ".join(second.split())


def _state_module(world: str) -> str | None:
    """Return the name of the module `state` beside the world's module, None if there is none."""
    package = world.rpartition(".")[0]
    name = f"{package}.state"
    return name if package and importlib.util.find_spec(name) is not None else None


def _layout(name: str, size: int) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Return the first two paragraphs about a state of `size` numbers, and its documented slices in order.

    Both are empty if a slice goes beyond the state.
    """
    module = importlib.import_module(name)
    tree = ast.parse(inspect.getsource(module))
    first, *rest = (ast.get_docstring(tree) or "").split("\n\n")
    text = " ".join(" ".join([first, *rest[:1]]).split())
    found: list[tuple[range, str]] = []
    for one, after in zip(tree.body, tree.body[1:], strict=False):
        match one, after:
            case ast.Assign(targets=[ast.Name(id=constant)]), ast.Expr(
                value=ast.Constant(value=str(meaning))
            ):
                place = getattr(module, constant)
                if isinstance(place, slice):  # whose ends may be open or counted from the end
                    if (place.stop or 0) > size:  # the module is about the states of another world
                        return "", ()
                    found.append((range(size)[place], " ".join(meaning.split())))
    return text, tuple(
        (f"{place[0]} to {place[-1]}", meaning)
        for place, meaning in sorted(found, key=lambda pair: pair[0].start)
        if place
    )
