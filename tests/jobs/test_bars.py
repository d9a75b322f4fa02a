import io
import itertools

from rich.console import Console

from clbench.jobs.bars import LINE_SECONDS, Bars


def test_without_a_terminal_a_line_is_printed_now_and_then() -> None:
    now = 0.0
    file = io.StringIO()
    bars = Bars(100, Console(file=file, width=100), clock=lambda: now)
    with bars:
        bars.start("pretraining [seed 0]", 100)
        for _ in range(50):
            now += LINE_SECONDS / 10
            bars.advance("pretraining [seed 0]", 1)
        bars.finish("pretraining [seed 0]", "done")
    lines = file.getvalue().splitlines()
    # 50 steps of 3 s: a line every 30 s; after half of the work in 150 s another 150 s are left
    assert len(lines) == 6
    assert lines[4] == " 50%, about 2:30 left: pretraining [seed 0]"
    assert lines[5] == "pretraining [seed 0]: done"


def test_what_takes_no_time_does_not_shorten_the_time_left() -> None:
    now = 0.0
    file = io.StringIO()
    with Bars(200, Console(file=file, width=100), clock=lambda: now) as bars:
        bars.start("demonstrations", 60)
        bars.finish("demonstrations", "from the cache")
        bars.skip("sft seed 0", 40, "done")
        bars.start("sft seed 1", 100)
        now += LINE_SECONDS
        bars.advance("sft seed 1", 10)
    # a tenth of the rest in 30 s; with the others it would be half of all, and 30 s left
    assert file.getvalue().splitlines()[-1] == " 10%, about 4:30 left: sft seed 1"


def test_of_a_piece_that_ends_at_once_only_the_part_that_was_left_does_not_count() -> None:
    now = 0.0
    file = io.StringIO()
    with Bars(100, Console(file=file, width=100), clock=lambda: now) as bars:
        bars.start("sft seed 0", 60)
        bars.advance("sft seed 0", 20)
        bars.finish("sft seed 0", "done")
        bars.start("sft seed 1", 40)
        now += LINE_SECONDS
        bars.advance("sft seed 1", 10)
    # 20 and 10 of the 60 that count
    assert file.getvalue().splitlines()[-1] == " 50%, about 0:30 left: sft seed 1"


def test_no_time_left_is_shown_before_any_work_is_done() -> None:
    now = 0.0
    file = io.StringIO()
    with Bars(100, Console(file=file, width=100), clock=lambda: now) as bars:
        bars.start("a", 100)
        now += 2 * LINE_SECONDS
        bars.advance("a", 0)
    assert file.getvalue() == "  0%: a\n"


def test_the_time_left_is_told_from_one_per_cent_on_and_has_hours() -> None:
    now = 0.0
    file = io.StringIO()
    with Bars(1000, Console(file=file, width=100), clock=lambda: now) as bars:
        bars.start("a", 1000)
        for amount in (9, 1, 1000):  # more than the length, which is an estimate
            now += 2 * LINE_SECONDS
            bars.advance("a", amount)
    assert file.getvalue() == "  1%: a\n  1%, about 3:18:00 left: a\n100%, about 0:00 left: a\n"


def test_a_terminal_shows_bars_with_the_time_left() -> None:
    file = io.StringIO()
    with Bars(100, Console(file=file, width=100, force_terminal=True)) as bars:
        bars.start("sft [seed 0]", 100)
        bars.advance("sft [seed 0]", 40)
    text = file.getvalue()
    assert "sft [seed 0]" in text
    assert "40%" in text
    assert "left" in text


def test_a_bar_of_work_that_was_done_before_is_full() -> None:
    file = io.StringIO()
    with Bars(100, Console(file=file, width=100, force_terminal=True)) as bars:
        bars.skip("sft seed 0", 60, "done")
        bars.skip("sft seed 1", 40, "done")
    assert "100%" in file.getvalue()


def test_one_bar_counts_all_work_and_each_piece_its_own() -> None:
    file = io.StringIO()
    with Bars(200, Console(file=file, width=100, force_terminal=True)) as bars:
        bars.start("sft seed 0", 50)
        bars.advance("sft seed 0", 10)
        bars.advance("sft seed 0", 20)
        assert bars.share("sft seed 0") == 0.6
    text = file.getvalue()
    assert "15%" in text
    assert "60%" in text


def test_a_bar_and_a_line_say_where_a_run_is() -> None:
    terminal, lines = io.StringIO(), io.StringIO()
    for file, is_terminal in ((terminal, True), (lines, False)):
        clock = itertools.count(step=2 * LINE_SECONDS)
        console = Console(file=file, width=140, force_terminal=is_terminal)
        with Bars(100, console, lambda clock=clock: next(clock)) as bars:  # type: ignore[misc]
            bars.start("sft [seed 0]", 100)
            bars.place("sft [seed 0]", "stage 2 (push) 17/20 after 32 steps")
            bars.advance("sft [seed 0]", 50)
    for text in (terminal.getvalue(), lines.getvalue()):
        assert "sft [seed 0], stage 2 (push) 17/20 after 32 steps" in text


def test_work_that_only_waits_is_shown_without_a_terminal() -> None:
    now = 0.0
    file = io.StringIO()
    with Bars(100, Console(file=file, width=140), clock=lambda: now) as bars:
        bars.start("sft seed 0", 100)
        bars.place("sft seed 0", "waiting for process 12 on node7")
        for _ in range(30):
            now += LINE_SECONDS / 10
            bars.tick()
        bars.place("sft seed 0", "")
        now += LINE_SECONDS
        bars.tick()
    lines = file.getvalue().splitlines()
    assert lines == [*["  0%: sft seed 0, waiting for process 12 on node7"] * 3, "  0%: sft seed 0"]


def test_no_text_controls_the_terminal() -> None:
    file = io.StringIO()
    with Bars(1, Console(file=file, width=100, force_terminal=True)) as bars:
        bars.start("[red]x\x1b[2Jy", 1)
        bars.finish("[red]x\x1b[2Jy", "failed: \x1b]0;title\x07[bold]\nsecond line")
    assert "\x1b[2J" not in file.getvalue()
    assert "\x1b]0" not in file.getvalue()
    assert "[red]x\\x1b[2Jy: failed: \\x1b]0;title\\x07[bold]" in file.getvalue()
    assert "second line" in file.getvalue()
