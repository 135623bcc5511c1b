"""The program `colmap-av1`, also `python -m colmap_av1`."""

from __future__ import annotations

import os
import signal
import sys

from colmap_av1.util.signals import ENDING, HEEDED, end_at_once


def main() -> int:
    """Run the command line with this process's arguments, and return its exit status.

    Until a command runs, a signal ends the process at once. Otherwise, Python would print a
    traceback when it is interrupted during the imports.
    """
    for number in ENDING:
        if signal.getsignal(number) in HEEDED:
            signal.signal(number, end_at_once)
    _open_closed_streams()
    from colmap_av1.cli.program import main as run  # noqa: PLC0415 - after the handlers

    return run()


def _open_closed_streams() -> None:
    """Open closed standard streams, so that no file of the user gets their descriptors.

    Libraries would print into such a file. Standard output still cannot be written, and messages
    are discarded.
    """
    for name, how in (("stdin", os.O_RDONLY), ("stdout", os.O_RDONLY), ("stderr", os.O_WRONLY)):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, how)  # the lowest free descriptor
            os.set_inheritable(descriptor, True)
            mode = "r" if name == "stdin" else "w"
            stream = os.fdopen(descriptor, mode, encoding="utf-8", closefd=False)
            setattr(sys, name, stream)


if __name__ == "__main__":
    sys.exit(main())
