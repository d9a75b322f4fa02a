"""The choice of the rendering back end: the user's setting, then EGL, then OSMesa."""

import os
import sys

import pytest

from clbench.testing import ToyWorld
from clbench.worlds.gl_backend import RenderingError, choose_back_end, draw_without_display, rendering_fault

WORLD = "clbench.testing:ToyWorld"


@pytest.fixture(autouse=True)
def _unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")


def _only(monkeypatch: pytest.MonkeyPatch, *working: str) -> list[str]:
    """Let only some back ends work, and return the list of those that are tried."""
    tried: list[str] = []

    def fault(back_end: str, world: str | None = None) -> str | None:
        tried.append(back_end)
        return None if back_end in working else f"ImportError: no {back_end}"

    monkeypatch.setattr("clbench.worlds.gl_backend.rendering_fault", fault)
    return tried


def test_egl_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = _only(monkeypatch, "egl", "osmesa")
    assert choose_back_end([WORLD, WORLD]) == "egl" == os.environ["MUJOCO_GL"]
    assert tried == ["egl"]


def test_osmesa_comes_second(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = _only(monkeypatch, "osmesa")
    assert choose_back_end([WORLD]) == "osmesa" == os.environ["MUJOCO_GL"]
    assert tried == ["egl", "osmesa"]


def test_each_back_end_is_tried_on_all_worlds_even_if_they_come_from_a_generator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = _only(monkeypatch)
    with pytest.raises(RenderingError):
        choose_back_end(world for world in (WORLD, "clbench.testing:Other"))
    assert tried == ["egl", "egl", "osmesa", "osmesa", "egl", "osmesa"]  # at last, without a world


class Blind(ToyWorld):
    """It returns no picture."""

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__()
        self.render_mode = render_mode

    def render(self) -> None:
        return None


def test_a_world_without_pictures_is_named() -> None:
    world = f"{__name__}:Blind"
    assert rendering_fault("egl", world) == f"{world}: render() returns NoneType, not a picture (H, W, 3)"


def test_where_nothing_draws_the_debian_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _only(monkeypatch)
    with pytest.raises(RenderingError) as raised:
        choose_back_end([WORLD])
    message = str(raised.value)
    assert "egl (ImportError: no egl) or osmesa (ImportError: no osmesa)" in message
    assert "apt-get install libegl1 libgl1-mesa-dri or apt-get install libosmesa6" in message
    assert os.environ["MUJOCO_GL"] == ""


def test_a_world_that_fails_where_a_back_end_works_is_to_blame(monkeypatch: pytest.MonkeyPatch) -> None:
    def fault(back_end: str, world: str | None = None) -> str | None:
        return "NotImplementedError" if world or back_end == "egl" else None

    monkeypatch.setattr("clbench.worlds.gl_backend.rendering_fault", fault)
    with pytest.raises(RenderingError) as raised:
        choose_back_end([WORLD])
    assert str(raised.value) == f"osmesa works on this machine, but cannot draw {WORLD}: NotImplementedError"


def test_the_choice_of_the_user_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = _only(monkeypatch, "egl", "osmesa", "glfw")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert choose_back_end([WORLD]) == "glfw"
    monkeypatch.setenv("MUJOCO_GL", "cgl")
    with pytest.raises(
        RenderingError, match="MUJOCO_GL is set to cgl: unset it, and clbench chooses what works"
    ):
        choose_back_end([WORLD])
    assert tried == ["glfw", "cgl", "cgl"]


def test_the_fault_is_the_last_line_of_the_process_that_tried() -> None:
    fault = rendering_fault("egl", "clbench.testing:NoWorld")
    assert fault is not None
    error = "UnknownNameError: No entry point 'clbench.testing:NoWorld': module"
    assert fault.startswith(error)


@pytest.mark.parametrize(
    ("variables", "working", "expected"),
    [
        ({}, ("egl", "osmesa"), "egl"),
        ({}, ("osmesa",), "osmesa"),
        ({}, (), ""),
        ({"DISPLAY": ":0"}, ("egl",), ""),
        ({"WAYLAND_DISPLAY": "wayland-0"}, ("egl",), ""),
        ({"MUJOCO_GL": "glfw"}, ("egl",), "glfw"),
    ],
)
def test_a_back_end_is_chosen_where_there_is_neither_a_display_nor_a_choice(
    variables: dict[str, str], working: tuple[str, ...], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    _only(monkeypatch, *working)
    # the tests of this process may have drawn with another back end, which cannot be changed
    monkeypatch.delitem(sys.modules, "mujoco.rendering.classic.gl_context", raising=False)
    draw_without_display.cache_clear()
    draw_without_display()
    draw_without_display.cache_clear()
    assert os.environ["MUJOCO_GL"] == expected
