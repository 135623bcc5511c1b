"""The command line: parses words and calls one function per subcommand."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from colmap_av1.cli.commands import (
    ABOUT_NAMES,
    add_check,
    add_compare,
    add_densify,
    add_encode,
    add_export,
    add_info,
    add_map,
    add_match,
    add_motion,
    add_reconstruct,
    add_view,
)
from colmap_av1.cli.options import underscored
from colmap_av1.cli.terminal import (
    PROGRAM,
    allow_any_file_name,
    print_error,
    warnings_as_lines,
)
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.util.signals import ending_in_order

_INTERRUPTED = 130
_BROKEN_PIPE = 141
_BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after the program's name; None: those of this process.

    Returns:
        Exit status: 0, 1 where a check fails, 2 for bad input, 130 when interrupted, 141 where
        nobody reads the output to its end.

    Raises:
        SystemExit: the process is told to end.
    """
    allow_any_file_name()
    try:
        with warnings_as_lines(), ending_in_order():
            words = sys.argv[1:] if arguments is None else arguments
            # argparse exits by itself, with status 2 and one line, on words it does not know.
            namespace = _make_parser().parse_args([underscored(word) for word in words])
            status: int | None = namespace.run(namespace)
            sys.stdout.flush()
    except ColmapAv1Error as error:
        print_error(error)
        return _BAD_INPUT
    except BrokenPipeError:  # as before `head`, which has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except OSError as error:
        if error.filename is None:
            raise
        what = f"{os.fsdecode(error.filename)}: {error.strerror}"
        print_error(f"{what}: mend that, or give another path")
        return _BAD_INPUT
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return _INTERRUPTED
    return status or 0


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(_BAD_INPUT, f"{PROGRAM}: error: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(f"{PROGRAM} {importlib.metadata.version(PROGRAM)}")
        parser.exit()


def _make_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog=PROGRAM,
        description="Dense COLMAP matches read from the motion vectors of an AV1 video.",
        epilog=ABOUT_NAMES,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (
        *(add_match, add_map, add_reconstruct, add_densify, add_compare, add_encode),
        *(add_info, add_check, add_motion, add_export, add_view),
    ):
        add(commands)
    return parser
