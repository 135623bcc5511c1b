"""The command line: parses arguments and runs a command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NoReturn

from colmap_av1.cli.addresses import videos_at_hand
from colmap_av1.cli.commands import COMMANDS
from colmap_av1.cli.options import underscored
from colmap_av1.cli.parser import BAD_INPUT, Parser
from colmap_av1.cli.report_file import failure_as_json
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
from colmap_av1.util.cpus import BLAS_THREADS
from colmap_av1.util.signals import ending_in_order, handlers_kept, held_back

_ABOUT_NAMES = (
    "'-' and '_' are equivalent in option names. COLMAP's names of these options are accepted as "
    "well, such as --database_path and --ImageReader.camera_model."
)
_EXAMPLES = f"""\
examples:
  {PROGRAM} match --database my.db --video phone.mp4 --image_path my_frames
      matches for COLMAP's mapper; also writes the images
  {PROGRAM} reconstruct --video phone.mp4 --output my_scene
      a dense model with undistorted images, for splat trainers
  {PROGRAM} densify --model my_model/0 --video phone.mp4 --image_path my_frames --output my_dense
      dense points for an existing model of the video
"""
_INTERRUPTED = 130
_BROKEN_PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: arguments after the program's name; None: those of this process.

    Returns:
        Exit status: 0; 1 if a check or a video of a batch fails; 2 for bad input or output that
        cannot be written; 3 if a trainer fails; 130 if interrupted; 141 if the reader of the output
        closes it early.

    Raises:
        SystemExit: a signal ends the process.
    """
    allow_any_file_name()
    try:
        with warnings_as_lines(), ending_in_order():
            words = sys.argv[1:] if arguments is None else arguments
            namespace = _parse([underscored(word) for word in words])
            command = COMMANDS[namespace.command]
            estimates = getattr(namespace, "rolling_shutter", "none") == "estimate"
            _import_libraries(with_pycolmap=command.pycolmap or estimates)
            with failure_as_json(namespace), videos_at_hand(namespace):
                status = command.run(namespace)
    except ColmapAv1Error as error:
        print_error(error)
        return BAD_INPUT
    except StreamError as error:
        if isinstance(error.__cause__, BrokenPipeError):  # the reader, such as `head`, ended
            return _BROKEN_PIPE
        print_error(f"standard output: cannot be written: {_reason(error.__cause__)}")
        return BAD_INPUT
    except OSError as error:
        where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        print_error(f"{where}{_reason(error)}: fix that, or give another path")
        return BAD_INPUT
    except (MemoryError, ImportError) as error:
        # A library that does not fit into memory raises an ImportError.
        if isinstance(error, ImportError) and "failed to map segment" not in str(error):
            raise
        print_error("out of memory: free some, or allow this process more")
        return BAD_INPUT
    except KeyboardInterrupt:
        print_note("interrupted")
        return _INTERRUPTED
    return status or 0


def _reason(error: BaseException | None) -> str:
    return str(getattr(error, "strerror", None) or error)


def _import_libraries(*, with_pycolmap: bool) -> None:
    """Import NumPy, and then pycolmap if it is needed.

    OpenCV prints no messages about damaged files, since errors name these.
    NumPy's matrix products get one thread, because further threads would wait for work in a busy
    loop. pycolmap installs a handler for SIGTERM that prints a C++ stack trace and may hang, so the
    previous handlers are restored.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    given = os.environ.get(BLAS_THREADS)
    with held_back(), handlers_kept():
        os.environ.setdefault(BLAS_THREADS, "1")
        import numpy as np  # noqa: F401

        if given is None:
            del os.environ[BLAS_THREADS]  # child processes are not limited
        if with_pycolmap:
            import pycolmap

            pycolmap.logging.logtostderr = True
            for level in pycolmap.logging.Level.__members__.values():
                pycolmap.logging.set_log_destination(level, "")  # no files in any case


def _parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments; argparse exits with status 2 on errors."""
    name = words[0] if words and words[0] in COMMANDS else None
    parser, commands = make_parser([name] if name else [])
    if name is None:
        return parser.parse_args(words)
    commands[name].refuse_unknown(words[1:])
    namespace, others = parser.parse_known_args(words)
    if others:
        commands[name].error(f"unrecognized arguments: {' '.join(others)}")
    commands[name].refuse_empty(namespace)
    return namespace


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from colmap_av1.util.digests import package_version  # slow to import

        print_text(f"{PROGRAM} {package_version()}\n")
        parser.exit()


def make_parser(names: Collection[str]) -> tuple[Parser, Mapping[str, Parser]]:
    """The program's parser, and those of its commands; only the named ones get arguments."""
    parser = Parser(
        prog=PROGRAM,
        description="COLMAP matches and models from the motion vectors of an AV1 video.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    parsers = parser.add_subparsers(
        title="commands", required=True, metavar="COMMAND", dest="command"
    )
    for name, command in COMMANDS.items():
        added: Parser = parsers.add_parser(
            name,
            help=command.summary,
            description=f"{command.summary[0].upper()}{command.summary[1:]}.",
            usage=f"%(prog)s {command.needed} [options]",
            epilog=_ABOUT_NAMES,
            full_help=command.full_help,
        )
        if name in names:
            command.add_to(added)
    return parser, parsers.choices
