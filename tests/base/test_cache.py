import errno
import io
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from clbench.base.cache import CacheError, cached, hash_of_tensors, is_cached
from clbench.base.lease import LeaseLostError, lease_path

INPUTS = {"seed": 0}


def _make(text: str, calls: list[str]) -> object:
    def make(folder: Path) -> None:
        calls.append(text)
        (folder / "value.txt").write_text(text)

    return make


def _value(folder: Path, inputs: dict[str, int], text: str, calls: list[str]) -> str:
    return (cached(folder, inputs, _make(text, calls)) / "value.txt").read_text()  # type: ignore[arg-type]


def test_a_cached_result_is_used_again(tmp_path: Path) -> None:
    calls: list[str] = []
    assert _value(tmp_path / "x", INPUTS, "first", calls) == "first"
    assert _value(tmp_path / "x", INPUTS, "second", calls) == "first"
    assert calls == ["first"]


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda folder: (folder / "value.txt").write_text("firs"), "torn"),
        (lambda folder: (folder / "value.txt").unlink(), "torn"),
        (lambda folder: (folder / "stranger.txt").write_text("?"), "torn"),
        (lambda folder: (folder / "clbench.json").unlink(), "is torn, or was not made by clbench"),
        (lambda folder: (folder / "clbench.json").write_text("{"), "is torn, or was not made by clbench"),
        (lambda folder: (folder / "clbench.json").write_text("[]"), "is torn, or was not made by clbench"),
    ],
)
def test_a_torn_or_foreign_folder_is_logged_and_made_again(
    tmp_path: Path, damage: object, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[str] = []
    folder = tmp_path / "x"
    _value(folder, INPUTS, "first", calls)
    damage(folder)  # type: ignore[operator]
    assert not is_cached(folder, INPUTS)
    with caplog.at_level(logging.WARNING):
        assert _value(folder, INPUTS, "second", calls) == "second"
    assert str(folder) in caplog.text
    assert fault in caplog.text
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize(
    "number", [errno.ESTALE, errno.EACCES, errno.ESHUTDOWN, errno.ENOTCONN, errno.ENOMEM]
)
@pytest.mark.parametrize("name", ["clbench.json", "value.txt", "x"])
def test_a_result_that_cannot_be_read_now_is_kept(
    name: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    _value(tmp_path / "x", INPUTS, "first", calls)
    for module, function in ((os, "open"), (io, "open"), (os, "scandir")):  # files, and the folder x
        monkeypatch.setattr(module, function, _refusing(getattr(module, function), name, number))
    with pytest.raises(CacheError, match=f"x cannot be read now: {os.strerror(number)}"):
        _value(tmp_path / "x", INPUTS, "second", calls)
    with pytest.raises(CacheError, match=f"x cannot be read now: {os.strerror(number)}"):
        is_cached(tmp_path / "x", INPUTS)
    monkeypatch.undo()
    assert _value(tmp_path / "x", INPUTS, "third", calls) == "first"


def _refusing(usual: Callable[..., Any], name: str, number: int) -> Callable[..., Any]:
    """Return a function that opens as on a shared folder that does not answer for what is called `name`."""

    def opened(path: Any, *arguments: Any, **options: Any) -> Any:
        if Path(str(path)).name == name:
            raise OSError(number, os.strerror(number), str(path))
        return usual(path, *arguments, **options)

    return opened


def test_every_file_of_a_result_can_be_read_by_those_who_can_read_its_manifest(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        save_file({"weight": torch.ones(1)}, folder / "policy.safetensors")
        (folder / "own.txt").touch(0o600)

    folder = cached(tmp_path / "x", INPUTS, make)
    assert {path.stat().st_mode for path in folder.iterdir()} == {(folder / "clbench.json").stat().st_mode}


def test_a_result_of_other_inputs_is_made_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    calls: list[str] = []
    _value(tmp_path / "x", INPUTS, "first", calls)
    assert _value(tmp_path / "x", {"seed": 1}, "second", calls) == "second"
    assert "was made from other inputs" in caplog.text


def test_a_maker_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        (folder / "value.txt").write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        cached(tmp_path / "x", INPUTS, make)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error_of_the_cache(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CacheError, match="cannot be written"):
        cached(tmp_path / "file" / "cache" / "result", {}, lambda _: None)


def test_a_file_that_a_maker_lacks_is_not_called_an_error_of_the_cache(tmp_path: Path) -> None:
    asset = tmp_path / "cache-of-another" / "asset.xml"  # its name begins like the cache's
    with pytest.raises(FileNotFoundError, match=r"asset\.xml"):
        cached(tmp_path / "cache" / "result", {}, lambda _: asset.open().close())
    assert not (tmp_path / "cache" / "result").exists()


def test_the_hash_of_tensors_tells_names_shapes_types_and_bits_apart() -> None:
    value = torch.tensor([1.0, -0.0])
    others = [
        {"b": value},
        {"a": value[None]},
        {"a": value.bfloat16()},
        {"a": torch.tensor([1.0, 0.0])},
        {"a": torch.tensor([1.0, 0.0]).bfloat16()},
        {"a": value[1]},
        {"a": value > 0},
    ]
    hashes = [hash_of_tensors(one) for one in ({"a": value}, *others)]
    assert len(set(hashes)) == len(hashes)
    assert hash_of_tensors({"a": torch.tensor([[1.0, 2.0], [-0.0, 3.0]]).T[0]}) == hashes[0]


def test_what_was_made_without_the_lease_is_not_kept(tmp_path: Path) -> None:
    def make(folder: Path) -> None:
        (folder / "value.txt").write_text("mine")
        lease_path(tmp_path / "x").unlink()

    with pytest.raises(LeaseLostError):
        cached(tmp_path / "x", {}, make)
    assert not (tmp_path / "x").exists()
