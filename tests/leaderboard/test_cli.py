"""The command `clbench leaderboard`: the same records give the same files."""

import errno
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cyclopts
import pandas
import pytest

import clbench
from clbench.base.entry_points import resolve

load = resolve("clbench:load_board")


@pytest.mark.long
def test_showing_twice_changes_no_byte_and_writes_no_file_again(
    four_methods: Path, shown_with_page: Callable[[], tuple[str, str]]
) -> None:
    (four_methods / "torn.json").write_text("{", encoding="utf-8")
    _, first = shown_with_page()
    files = [four_methods.parent / "site" / name for name in ("LEADERBOARD.md", "leaderboard.csv")]
    stamps = [(path.read_bytes(), path.stat().st_mtime_ns, path.stat().st_ino) for path in files]
    assert shown_with_page()[1] == first
    assert [(path.read_bytes(), path.stat().st_mtime_ns, path.stat().st_ino) for path in files] == stamps
    made = ["LEADERBOARD.md", "board.json", "index.html", "leaderboard.csv", "pareto-dark.svg", "pareto.svg"]
    assert sorted(os.listdir(four_methods.parent)) == ["records", "site"]
    assert sorted(os.listdir(four_methods.parent / "site")) == made


@pytest.mark.long
def test_the_published_rows_stand_beside_ones_own(
    four_methods: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, show = tmp_path / "mine/records", resolve("clbench.leaderboard.cli:show")
    own = mine / "Toy-v0/sft/seed-0.json"
    own.parent.mkdir(parents=True)
    text = (four_methods / "Toy-v0/sft/seed-0.json").read_text(encoding="utf-8") + " "
    own.write_text(text, encoding="utf-8")
    published = sorted(path.relative_to(four_methods) for path in four_methods.rglob("seed-*.json"))
    monkeypatch.setattr("clbench.leaderboard.publishing.PUBLISHED", four_methods)
    show(records=mine, published=True)
    said = capsys.readouterr()
    assert f"{len(published) - 1} published records added to {mine}." in " ".join(said.err.split())
    assert all(name in said.out for name in ("sft", "replay", "from_scratch"))
    assert sorted(path.relative_to(mine) for path in mine.rglob("seed-*.json")) == published
    assert own.read_text(encoding="utf-8") == text
    show(records=mine, published=True)
    assert "0 published records added" in capsys.readouterr().err


@pytest.mark.long
def test_the_files_do_not_depend_on_where_the_records_lie(
    four_methods: Path, shown: Callable[[], tuple[str, str]], tmp_path: Path
) -> None:
    (four_methods / "folder.json").mkdir()
    (four_methods / "torn.json").write_text("{", encoding="utf-8")
    _, here = shown()
    table = (four_methods.parent / "site" / "leaderboard.csv").read_bytes()
    (tmp_path / "elsewhere").mkdir()
    moved = four_methods.rename(tmp_path / "elsewhere" / "records")
    resolve("clbench.leaderboard.cli:show")(records=moved)
    assert (moved.parent / "site" / "LEADERBOARD.md").read_text(encoding="utf-8") == here
    assert (moved.parent / "site" / "leaderboard.csv").read_bytes() == table
    assert str(tmp_path) not in here


@pytest.mark.long
def test_unchanged_records_show_the_same_board_without_being_read(
    four_methods: Path, shown: Callable[[], tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    most = max(path.stat().st_size for path in four_methods.rglob("*.json"))
    monkeypatch.setattr("clbench.base.strict_json.MOST_BYTES", most)  # the limit of a record
    (four_methods / "torn.json").write_text("{", encoding="utf-8")
    frame, plane = load(four_methods), clbench.plot.plane(four_methods).spec
    table, _, written = shown()[0].partition("Written: ")
    assert "board.json" in written
    assert (four_methods.parent / "site" / "board.json").stat().st_size > most

    def fail(_: Path) -> None:
        raise AssertionError("the records were read")

    monkeypatch.setattr("clbench.leaderboard.board.rows.compute_board", fail)
    again, _, unchanged = shown()[0].partition("Unchanged: ")
    assert again == table
    assert "torn.json: cannot be read as JSON" in again
    assert Path("".join(unchanged.split())) == four_methods.parent / "site"
    pandas.testing.assert_frame_equal(load(four_methods), frame)
    assert clbench.plot.plane(four_methods).spec == plane


@pytest.mark.long
@pytest.mark.parametrize(
    "what", ["record", "verification", "table", "pipe", "numbers", "one value", "code", "docstrings"]
)
def test_a_board_is_computed_again_when_something_changed_that_it_was_made_from(
    what: str, four_methods: Path, shown: Callable[[], tuple[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, _ = shown()
    site = four_methods.parent / "site"
    before = {path.name: path.read_bytes() for path in site.iterdir()}
    if what == "record":
        next(four_methods.rglob("replay/seed-1.json")).unlink()
    elif what == "verification":
        next(four_methods.rglob("seed-1.json")).with_suffix(".verified").write_text("{}", encoding="utf-8")
    elif what == "table":
        (site / "LEADERBOARD.md").write_text("forged", encoding="utf-8")
    elif what == "pipe":  # opening it would wait for a writer
        (site / "LEADERBOARD.md").unlink()
        os.mkfifo(site / "LEADERBOARD.md")
    elif what == "numbers":
        (site / "board.json").write_bytes(before["board.json"][:-100])
    elif what == "one value":
        (site / "board.json").write_bytes(before["board.json"].replace(b"self-reported", b"retrained", 1))
    elif what == "code":
        monkeypatch.setattr("clbench.leaderboard.publishing.source_hash", lambda *_: "other")
    else:  # the pages quote those of metrics and methods
        monkeypatch.setattr("ast.get_docstring", lambda _: "other")
    printed, _ = shown()
    assert "Written: " in printed
    assert ("not shown" in printed.lower()) == ("not shown" in first.lower())
    after = {path.name: path.read_bytes() for path in site.iterdir()}
    assert ("retrained" in printed) == ("retrained" in first)
    if what in ("table", "pipe", "numbers", "one value"):
        assert after == before
    else:
        assert after["board.json"] != before["board.json"]
    assert (after["leaderboard.csv"] != before["leaderboard.csv"]) == (what == "record")


def test_a_board_whose_reader_leaves_is_written_whole(
    four_methods: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.leaderboard.views.page.page", lambda *_: "a page")
    monkeypatch.setattr("clbench.leaderboard.views.page.pictures", lambda _: {})
    with open(tmp_path / "out", "w", encoding="utf-8") as file:

        class Closed(io.StringIO):
            """Standard output in `clbench leaderboard | head -1`."""

            def fileno(self) -> int:
                return file.fileno()

            def write(self, text: str) -> int:
                raise BrokenPipeError(errno.EPIPE, "Broken pipe")

        monkeypatch.setattr("sys.stdout", Closed())
        with pytest.raises(SystemExit):
            resolve("clbench.leaderboard.cli:show")(records=four_methods)
    site = four_methods.parent / "site"
    assert sorted(os.listdir(site)) == ["LEADERBOARD.md", "board.json", "index.html", "leaderboard.csv"]
    assert "replay" in (site / "leaderboard.csv").read_text(encoding="utf-8")


@pytest.mark.long
def test_a_picture_of_a_former_board_is_removed_and_no_other_file(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    shown()
    site = four_methods.parent / "site"
    kept = json.loads((site / "board.json").read_text(encoding="utf-8"))
    kept["files"] |= {"frontier-Toy-v0.svg": "hash", "../records": "hash", "gone.svg": "hash"}
    (site / "board.json").write_text(json.dumps(kept), encoding="utf-8")
    for name in ("frontier-Toy-v0.svg", "mine.svg"):
        (site / name).write_text("<svg/>", encoding="utf-8")
    shown()
    assert (site / "mine.svg").exists()
    assert not (site / "frontier-Toy-v0.svg").exists()
    assert four_methods.is_dir()


@pytest.mark.long
def test_what_a_killed_command_left_beside_the_board_is_removed(
    four_methods: Path, shown: Callable[[], tuple[str, str]]
) -> None:
    site = four_methods.parent / "site"
    site.mkdir()
    code = "import sys; from pathlib import Path; from clbench.base.leftovers import unfinished; "
    code += "unfinished(Path(sys.argv[1])).touch()"
    subprocess.run([sys.executable, "-c", code, str(site / "index.html")], check=True)
    assert list(site.glob(".*"))
    shown()
    assert not list(site.glob(".*"))


def test_a_folder_without_rows_lists_why_and_replaces_no_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "torn.json").write_text("{", encoding="utf-8")
    with pytest.raises(SystemExit) as stopped:
        resolve("clbench.leaderboard.cli:show")(records=tmp_path / "records")
    assert stopped.value.code == 2
    shown = capsys.readouterr().err
    assert "torn.json: cannot be read as JSON" in shown
    assert "makes a row, so no board was written" in shown
    assert [path.name for path in tmp_path.iterdir()] == ["records"]
    assert load(tmp_path / "records").empty
    assert "retention_low" in load(tmp_path / "records")


@pytest.mark.long
def test_a_full_disk_leaves_every_file_of_the_board_as_it_was_and_shows_the_table(
    four_methods: Path,
    shown: Callable[[], tuple[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown()
    site = four_methods.parent / "site"
    before = {path.name: path.read_bytes() for path in site.iterdir()}
    next(four_methods.rglob("seed-1.json")).unlink()
    write, written = Path.write_bytes, []

    def fill(path: Path, content: bytes) -> int:
        written.append(path)
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", fill)
    with pytest.raises(SystemExit) as ended:
        shown()
    assert ended.value.code == 2
    out, message = capsys.readouterr()
    assert f"error: {written[1].parent}" in message
    assert "cannot be written: No space left on device." in message
    assert "from_scratch" in out
    assert {path.name: path.read_bytes() for path in site.iterdir()} == before


@pytest.mark.parametrize("exists", [True, False])
def test_without_records_the_command_shows_what_to_run(
    exists: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "records"
    if exists:
        folder.mkdir()
    with pytest.raises(SystemExit) as exit_info:
        resolve("clbench.leaderboard.cli:show")(records=folder)
    assert exit_info.value.code == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert str(folder) in captured.err
    assert "clbench run clbench/Fetch-v1 sft" in captured.err
    assert not (tmp_path / "LEADERBOARD.md").exists()


def test_the_command_takes_the_folder_as_an_option(
    four_methods: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    app = cyclopts.App(result_action="return_value")
    app.command(resolve("clbench.leaderboard.cli:show"), name="leaderboard")
    app(["leaderboard", "--records", str(four_methods)])
    assert "from_scratch" in capsys.readouterr().out
