"""The command line: parses words and calls one function per subcommand."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

from colmap_av1.cli.addresses import videos_at_hand
from colmap_av1.cli.commands.batch import add_batch
from colmap_av1.cli.commands.check import add_check
from colmap_av1.cli.commands.compare import add_compare
from colmap_av1.cli.commands.densify import add_densify
from colmap_av1.cli.commands.encode import add_encode
from colmap_av1.cli.commands.export import add_export
from colmap_av1.cli.commands.info import add_info
from colmap_av1.cli.commands.map import add_map
from colmap_av1.cli.commands.match import add_match
from colmap_av1.cli.commands.motion import add_motion
from colmap_av1.cli.commands.reconstruct import add_reconstruct
from colmap_av1.cli.commands.shared import ABOUT_NAMES
from colmap_av1.cli.commands.view import add_view
from colmap_av1.cli.options import underscored
from colmap_av1.cli.parser import BAD_INPUT, Parser
from colmap_av1.cli.terminal import (
    PROGRAM,
    StreamError,
    allow_any_file_name,
    print_error,
    print_note,
    print_text,
    warnings_as_lines,
)
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.util.signals import ending_in_order

_INTERRUPTED = 130
_BROKEN_PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after the program's name; None: those of this process.

    Returns:
        Exit status: 0, 1 where a check or a video of a batch fails, 2 for bad input and output that
        cannot be written, 130 when interrupted, 141 where nobody reads the output to its end.

    Raises:
        SystemExit: a signal ends the process.
    """
    allow_any_file_name()
    try:
        with warnings_as_lines(), ending_in_order():
            words = sys.argv[1:] if arguments is None else arguments
            namespace = _parse([underscored(word) for word in words])
            with videos_at_hand(namespace):
                status: int | None = namespace.run(namespace)
    except ColmapAv1Error as error:
        print_error(error)
        return BAD_INPUT
    except StreamError as error:
        if isinstance(error.__cause__, BrokenPipeError):  # as before `head`, which has read enough
            return _BROKEN_PIPE
        print_error(f"standard output: cannot be written: {_reason(error.__cause__)}")
        return BAD_INPUT
    except OSError as error:
        where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        print_error(f"{where}{_reason(error)}: fix that, or give another path")
        return BAD_INPUT
    except KeyboardInterrupt:
        print_note("interrupted")
        return _INTERRUPTED
    return status or 0


def _reason(error: BaseException | None) -> str:
    return str(getattr(error, "strerror", None) or error)


def _parse(words: Sequence[str]) -> argparse.Namespace:
    """The words as a namespace; argparse exits by itself, with status 2, on what it refuses."""
    parser, commands = _make_parser()
    command = commands.get(words[0]) if words else None
    if command is None:
        return parser.parse_args(words)
    command.refuse_unknown(words[1:])
    namespace, others = parser.parse_known_args(words)
    if others:
        command.error(f"unrecognized arguments: {' '.join(others)}")
    return namespace


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print_text(f"{PROGRAM} {importlib.metadata.version(PROGRAM)}\n")
        parser.exit()


def _make_parser() -> tuple[Parser, Mapping[str, Parser]]:
    """The program's parser, and those of its commands by their names."""
    parser = Parser(
        prog=PROGRAM,
        description="Dense COLMAP matches read from the motion vectors of an AV1 video.",
        epilog=ABOUT_NAMES,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add in (
        *(add_match, add_map, add_reconstruct, add_densify, add_batch, add_compare),
        *(add_encode, add_info, add_check, add_motion, add_export, add_view),
    ):
        add(commands)
    return parser, commands.choices
