"""SIGINT and SIGTERM end every command with one line, 130 and 143; earlier results stay."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.levels import sampled
from tests.shared import own_copy

SFM = (sys.executable, "-P", "-c", "from stcal.cli.entry import main_sfm; main_sfm()")
SFM_SAYING_ON = (*SFM[:-1], "from stcal.cli.entry import main_sfm; print('on', flush=True); main_sfm()")
ENDS = [(signal.SIGTERM, "terminated", 143), (signal.SIGINT, "interrupted", 130)]
PROGRESS = ("detect: ", "overlays: ", "map: ", "faces: ", "check: ", "report: ", "working: ")


def ended(process, number) -> tuple[int, list[str]]:
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    return process.returncode, [line for line in err.splitlines() if not line.startswith(PROGRESS)]


@pytest.mark.parametrize(("number", "said", "code"), ENDS)
def test_while_libraries_load_and_where_python_forgets_exceptions(number, said, code):
    """The moment is when the entry module is there and the program's imports go on. Python prints and forgets
    exceptions in a finaliser: the signal is sent again, and what the command waits for ends."""
    begin = (
        "import sys; from stcal.cli import entry; entry._answer(); print('on', flush=True); import time; time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-P", "-c", begin], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"
    assert ended(process, number) == (code, [said])
    begin = (
        "import signal, sys, time, typer, weakref; from stcal.cli import entry, main\n"
        "class A: pass\n"
        "def command():\n"
        "    a = A()\n"
        f"    kept = weakref.ref(a, lambda _: signal.raise_signal({int(number)}))\n"
        "    del a\n"
        "    time.sleep(30)\n"
        "main.app = typer.Typer(); main.app.command()(command); sys.argv[1:] = []; entry.main()"
    )
    done = subprocess.run([sys.executable, "-P", "-c", begin], capture_output=True, text=True, timeout=20, check=False)
    assert (done.returncode, done.stderr.splitlines()) == (code, [said])


def test_signals_after_the_answer_change_no_exit_code_and_colmaps_bindings_leave_them_as_they_were():
    """While Python ends itself; the results are in place."""
    for number in (signal.SIGTERM, signal.SIGINT):
        begin = f"import atexit, os; atexit.register(os.kill, os.getpid(), {int(number)}); {SFM[-1]}"
        found = subprocess.run(
            [sys.executable, "-P", "-c", begin, "--version"], capture_output=True, text=True, check=False
        )
        assert (found.returncode, found.stderr) == (0, "")
    begin = (
        "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(7));"
        "import stcal.sfm.mapping.database; print('on', flush=True); signal.pause()"
    )
    process = subprocess.Popen([sys.executable, "-P", "-c", begin], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"
    assert ended(process, signal.SIGTERM) == (7, [])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_thread_that_says_what_a_command_is_at_takes_no_signal(number):
    """While COLMAP's bindings load, they wait in the main thread, and any other that took one would end the process."""
    begin = (
        "import os, signal, time; from stcal.cli.terminal import _Beat\n"
        f"signal.signal({int(number)}, signal.SIG_DFL); _Beat().start(); time.sleep(0.3)\n"
        f"signal.pthread_sigmask(signal.SIG_BLOCK, [{int(number)}]); os.kill(os.getpid(), {int(number)})\n"
        "time.sleep(0.3); print('on', flush=True); os._exit(7)"
    )
    found = subprocess.run(
        [sys.executable, "-P", "-c", begin],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    assert (found.returncode, found.stdout) == (7, "on\n")


@pytest.mark.parametrize(
    ("number", "said", "code", "seconds"),
    sampled([(*end, seconds) for end in ENDS for seconds in (0.5, 2.0, 5.0)], kept=(1, 4)),
)
def test_during_a_run(small_set, small_run, number, said, code, seconds):
    """Earlier results stay, no process of it is left that still writes, and the next run goes through."""
    small = small_set("12", "14", detected=False)
    own_copy(small_run, small.out)
    command = [*SFM, *map(str, small.arguments()), "--workers", "2"]
    before = (small.out / "faces.json").read_bytes()
    for path in (small.out / ".stcal/cache").glob("*.npz"):
        path.unlink()
    process = subprocess.Popen([*SFM_SAYING_ON, *command[len(SFM) :]], stdout=-1, stderr=-1, text=True)
    assert process.stdout.readline() == "on\n"  # until then a signal ends Python itself, with 1 and its own words
    time.sleep(seconds)
    code_found, lines = ended(process, number)
    if code_found != 0:  # a fast machine may be through
        assert code_found == code
        assert len(lines) == 1
        assert lines[0].startswith(said)
    assert (small.out / "faces.json").read_bytes() == before
    subprocess.run(command, check=True, capture_output=True)
    assert not (small.out / ".stcal/unfinished").exists()
    assert (small.out / "faces.json").read_bytes() == before
