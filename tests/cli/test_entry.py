"""Ctrl-C at any moment of a command: exit code 130 and no traceback."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

STARTED = """
import signal, sys
sys.argv = ["clbench", *sys.argv[1:]]
set_handler = signal.signal
def note(number, handler):
    signal.signal = set_handler
    set_handler(number, handler)
    print("handled", file=sys.stderr, flush=True)
signal.signal = note
"""
"""Begins like the script that pip writes, and reports the first handler: Python itself has started then."""

RUN = "from clbench.cli.entry import main; sys.exit(main())"

STUBBORN = f"""
{STARTED}
import clbench.cli.main, time
class Closed:
    def __del__(self):
        print("waiting", file=sys.stderr, flush=True)
        time.sleep(5)
def command():
    Closed()
    time.sleep(60)
def converted():
    try:
        print("waiting", file=sys.stderr, flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        raise ImportError("numpy.core.multiarray failed to import")
def late():
    import atexit
    atexit.register(lambda: (print("waiting", file=sys.stderr, flush=True), time.sleep(60)))
    print("done")
clbench.cli.main.main = {{}}
{RUN}
"""


def _start(program: str, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # tests that run in the background of a shell ignore Ctrl-C, and so would this process
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _wait_for(process: subprocess.Popen[str], line: str) -> None:
    assert process.stderr is not None
    while (found := process.stderr.readline()) != f"{line}\n":
        assert found, "the process has ended"


def _exit_code(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Return the exit code as a shell reports it, and what the process has printed since."""
    out, err = process.communicate(timeout=600)
    code = process.returncode
    return (128 - code if code < 0 else code), out, err


@pytest.mark.long
@pytest.mark.parametrize(
    "number", [pytest.param(number, marks=[pytest.mark.slow] if number > 1 else []) for number in range(10)]
)
def test_ctrl_c_at_any_moment_ends_the_command(number: int) -> None:
    process = _start(STARTED + RUN, "list")
    _wait_for(process, "handled")
    time.sleep(random.Random(number).uniform(0, 1.5 if number % 2 else 0.4))
    process.send_signal(signal.SIGINT)
    code, _, err = _exit_code(process)
    assert code in (0, 130)
    assert "Traceback" not in err
    assert "Exception ignored" not in err


@pytest.mark.long
@pytest.mark.parametrize("function", ["command", "converted", "late"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_are_neither_dropped_nor_turned_into_another_error(
    number: signal.Signals, function: str
) -> None:
    process = _start(STUBBORN.format(function))
    _wait_for(process, "waiting")
    process.send_signal(number)
    code, out, err = _exit_code(process)
    assert code == 128 + number
    assert ("Stopped. Finished records are kept" in err) == (function != "late")
    assert "Traceback" not in err
    assert out == ("done\n" if function == "late" else "")


@pytest.mark.long
def test_a_process_that_ignores_ctrl_c_still_does_so_as_a_command(tmp_path: Path) -> None:
    ignoring = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
    look = "import sys; sys.argv[0] = 'clbench'; import clbench.cli.entry, clbench.cli.main"
    check = "clbench.cli.main.main = lambda: print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    process = _start(f"{ignoring}; {look}; {check}; clbench.cli.entry.main()")
    assert _exit_code(process)[:2] == (0, "True\n")


@pytest.mark.long
def test_a_program_that_uses_the_package_keeps_its_own_handling() -> None:
    process = _start(
        "import clbench, signal; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    )
    assert _exit_code(process)[:2] == (0, "True\n")


@pytest.mark.long
def test_a_bug_shows_its_traceback() -> None:
    bug = "import clbench.cli.main, clbench.cli.entry\ndef main():\n    {}['key']\n"
    process = _start(f"{bug}clbench.cli.main.main = main\nclbench.cli.entry.main()")
    code, _, err = _exit_code(process)
    assert code == 1
    assert err.rstrip().endswith("KeyError: 'key'")


@pytest.mark.long
@pytest.mark.parametrize(
    ("output", "code", "error"),
    [
        ("/dev/full", 1, "error: the output cannot be written: No space left on device.\n"),
        ("&-", 0, ""),
    ],
)
def test_output_that_goes_nowhere_shows_no_traceback(output: str, code: int, error: str) -> None:
    program = f"import clbench.cli.main as m, sys; m.main = lambda: print('x' * 10**6); {RUN}"
    command = ["sh", "-c", f'exec "$0" -c "$1" >{output}', sys.executable, program]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stderr) == (code, error)


@pytest.mark.long
@pytest.mark.parametrize("number", [1, 2])
def test_the_number_of_a_closed_output_goes_to_no_file_and_children_have_it_too(number: int) -> None:
    taken = f"os.open(os.devnull, os.O_RDONLY) > 2 and os.get_inheritable({number})"
    program = f"import clbench.cli.main as m, os, sys; m.main = lambda: sys.exit(3 if {taken} else 4); {RUN}"
    command = ["sh", "-c", f'exec "$0" -c "$1" {number}>&-', sys.executable, program]
    assert subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode == 3


@pytest.mark.long
def test_a_reader_that_leaves_ends_the_command_without_a_traceback() -> None:
    program = f"import clbench.cli.main as m, sys; m.main = lambda: print('x' * 10**6); {RUN}"
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait() == 1


@pytest.mark.long
def test_no_text_in_the_log_controls_the_terminal() -> None:
    log = "logging.getLogger('clbench').warning('%s', '[red]x\\x1b[2J')"
    program = f"import clbench.cli.main as m, logging; m.app = lambda: {log}; m.main()"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "[red]x\\x1b[2J" in found.stderr
    assert "\x1b" not in found.stderr


@pytest.mark.long
def test_a_terminal_without_a_sign_gets_another_and_no_traceback() -> None:
    program = f"import clbench.cli.main as m, sys; m.main = lambda: print('0.5 \\u00b1 0.1'); {RUN}"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-c", program]
    found = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert found.stdout == "0.5 ? 0.1\n"
