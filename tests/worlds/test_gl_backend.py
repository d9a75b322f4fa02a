"""The choice of the rendering back end: the user's setting, then EGL, then OSMesa."""

import os

import pytest

from clbench.worlds.gl_backend import RenderingError, choose_back_end, rendering_fault

WORLD = "clbench.testing:ToyWorld"


@pytest.fixture(autouse=True)
def _unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")


def _only(monkeypatch: pytest.MonkeyPatch, *working: str) -> list[str]:
    """Let only some back ends work, and return the list of those that are tried."""
    tried: list[str] = []

    def fault(back_end: str, world: str) -> str | None:
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


def test_where_nothing_draws_the_debian_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _only(monkeypatch)
    with pytest.raises(RenderingError) as raised:
        choose_back_end([WORLD])
    message = str(raised.value)
    assert "egl (ImportError: no egl) or osmesa (ImportError: no osmesa)" in message
    assert "apt-get install libegl1 libgl1-mesa-dri or apt-get install libosmesa6" in message
    assert os.environ["MUJOCO_GL"] == ""


def test_the_choice_of_the_user_is_obeyed(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = _only(monkeypatch, "egl", "osmesa", "glfw")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert choose_back_end([WORLD]) == "glfw"
    monkeypatch.setenv("MUJOCO_GL", "cgl")
    with pytest.raises(RenderingError, match="MUJOCO_GL is set to cgl: unset it, and what works is chosen"):
        choose_back_end([WORLD])
    assert tried == ["glfw", "cgl"]


def test_the_fault_is_the_last_line_of_the_process_that_tried() -> None:
    fault = rendering_fault("egl", "clbench.testing:NoWorld")
    assert fault is not None
    error = "UnknownNameError: No entry point 'clbench.testing:NoWorld': module"
    assert fault.startswith(error)
