from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from colmap_av1.util.signals import ending_in_order, held_back, let_through

# Shells start background processes with interrupts ignored, and nohup with hang-ups ignored. Child
# processes inherit this.
SETTING = (
    "import os, signal, sys\n"
    "for number in {numbers}: signal.signal(number, signal.{action})\n"
    "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
)
DEFAULT_SIGNALS = SETTING.format(numbers="(signal.SIGINT, signal.SIGHUP)", action="SIG_DFL")
IGNORED_SIGNALS = SETTING.format(numbers="(signal.SIGINT, signal.SIGTERM)", action="SIG_IGN")
# The script that pip installs.
SCRIPT = (
    "import sys\nfrom colmap_av1.__main__ import main\n"
    "if __name__ == '__main__':\n    sys.exit(main())"
)

pytestmark = pytest.mark.skipif(
    sys.platform == "win32", reason="signals end processes differently there"
)


def end_while_importing(words: list[str], number: int, folder: Path, after: str) -> tuple[int, str]:
    """Exit status and output of a program that gets a signal while it imports modules."""
    command = [sys.executable, "-c", words[0], "-X", "importtime", *words[1:]]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.endswith(f" {after}\n"):
                break
        process.send_signal(number)
        rest = process.stderr.read().splitlines()
    output = [line for line in rest if not line.startswith("import time:")]
    return process.returncode, "\n".join(output)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("start", ["module", "script"])
def test_signal_during_imports_ends_the_program(tmp_path: Path, start: str, number: int) -> None:
    (tmp_path / "colmap-av1").write_text(SCRIPT)
    program = ["-m", "colmap_av1"] if start == "module" else [str(tmp_path / "colmap-av1")]
    words = [DEFAULT_SIGNALS, *program, "--version"]
    after = "colmap_av1.cli.parser"
    assert end_while_importing(words, number, tmp_path, after) == (128 + number, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_handlers_of_pycolmap_are_replaced(tmp_path: Path, number: int) -> None:
    words = [DEFAULT_SIGNALS, "-m", "colmap_av1", "check", "--database", "none"]
    status, output = end_while_importing(words, number, tmp_path, "pycolmap")
    assert status == 128 + number
    assert "Traceback" not in output
    assert "@ " not in output  # a C++ stack trace


def test_ignored_signal_stays_ignored_after_importing_pycolmap(tmp_path: Path) -> None:
    words = [IGNORED_SIGNALS, "-m", "colmap_av1", "check", "--database", "none"]
    status, output = end_while_importing(words, signal.SIGTERM, tmp_path, "pycolmap")
    assert status == 2
    assert output.startswith("colmap-av1: error: none: ")


MEASURING = """
import sys, time
from pathlib import Path
from colmap_av1.evaluate.frontends.measure import run_measured
try:
    run_measured(time.sleep, 60, log=Path("log.txt"))
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lists children in /proc")
def test_interrupt_of_a_process_group_while_a_child_starts(tmp_path: Path) -> None:
    words = [sys.executable, "-c", DEFAULT_SIGNALS, "-c", MEASURING]
    with subprocess.Popen(
        words, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        deadline = time.monotonic() + 60
        # The first child tracks shared memory and ignores interrupts.
        while len(children.read_text().split()) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.005)
        time.sleep(0.1)  # signals are blocked during the fork
        child = Path("/proc") / children.read_text().split()[1]
        lines = dict(line.split(":\t") for line in (child / "status").read_text().splitlines())
        os.killpg(process.pid, signal.SIGINT)
        assert int(lines["SigBlk"], 16) >> (signal.SIGINT - 1) & 1
        assert process.communicate(timeout=60)[1] == ""
    assert process.returncode == 130


def test_ignored_signal_during_imports_stays_ignored(tmp_path: Path) -> None:
    words = [IGNORED_SIGNALS, "-m", "colmap_av1", "info", "--video", "none.mp4"]
    status, output = end_while_importing(words, signal.SIGINT, tmp_path, "numpy.version")
    assert status == 2
    assert "none.mp4" in output


def test_signal_handlers_are_restored() -> None:
    before = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    with pytest.raises(SystemExit) as end, ending_in_order():
        signal.raise_signal(signal.SIGTERM)
    assert end.value.code == 143
    assert {n: signal.getsignal(n) for n in before} == before


def test_signal_handlers_are_not_changed_in_other_threads() -> None:
    def run() -> None:
        with ending_in_order():
            within.append(signal.getsignal(signal.SIGTERM))

    within: list[object] = []
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert within == [signal.getsignal(signal.SIGTERM)]


def test_signal_that_another_thread_receives_is_held_back() -> None:
    """A process that starts during an interrupt would not be known, and left running."""
    steps = []

    def receive() -> None:
        let_through()
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        steps.append("received")

    def body() -> None:
        with held_back():
            thread = threading.Thread(target=receive)
            thread.start()
            thread.join()
            steps.append("done")

    # Interrupts are ignored if a shell runs the tests in the background.
    with ending_in_order(), pytest.raises(SystemExit):
        body()
    assert steps == ["received", "done"]
