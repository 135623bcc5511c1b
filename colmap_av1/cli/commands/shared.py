"""What several subcommands have in common."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from colmap_av1.cli.parser import Parser
from colmap_av1.cli.reports import Rows
from colmap_av1.cli.terminal import print_summary, print_warning

ABOUT_NAMES = (
    "'-' and '_' are alike in option names. COLMAP's spellings are accepted, such as "
    "--ImageReader.camera_model."
)
OTHERS_TOO = "replace files that exist, not only earlier output of this command"
ONLY_MODELS = "replace an output that exists and holds nothing but models"
ANY_VIDEO = "a video; one that is not AV1 is converted first"


def add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    summary: str,
    needed: str,
    *,
    full_help: bool = False,
) -> Parser:
    """Add a subcommand.

    Args:
        commands: the program's subcommands.
        name: its name.
        run: does what it is for.
        summary: what that is.
        needed: the options that its usage names.
        full_help: leave the help of rare options to --help-all.
    """
    command: Parser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        usage=f"%(prog)s {needed} [options]",
        epilog=ABOUT_NAMES,
        full_help=full_help,
    )
    command.set_defaults(run=run)
    return command


def add_database(command: Parser, what: str = "a COLMAP database") -> None:
    """Add --database."""
    command.add_argument("--database", "--database_path", required=True, metavar="PATH", help=what)


def add_video(command: Parser, what: str = "an AV1 video") -> None:
    """Add --video."""
    command.add_argument("--video", "--video_path", required=True, metavar="PATH", help=what)


def add_videos(command: Parser, what: str) -> None:
    """Add --video, which may be given several times, and --images."""
    command.add_argument(
        *("--video", "--video_path"),
        required=True,
        action="append",
        metavar="PATH",
        help=f"{what}; several videos: give it for each",
    )
    command.add_argument(
        "--images", metavar="PATH", help="folder of photos of the same scene, which are added"
    )


def add_images(command: Parser, what: str) -> None:
    """Add --image_path."""
    command.add_argument("--image_path", metavar="PATH", help=what)


def add_output(command: Parser, what: str) -> None:
    """Add --output."""
    command.add_argument("--output", "--output_path", required=True, metavar="PATH", help=what)


def add_overwrite(command: Parser, what: str = "replace an output that exists") -> None:
    """Add --overwrite."""
    command.add_argument("--overwrite", action="store_true", help=what)


def add_gaussians(command: Parser) -> None:
    """Add --gaussians."""
    command.add_argument(
        "--gaussians",
        metavar="PATH",
        help="also write initial Gaussians to this .ply, for trainers that start from them",
    )


def add_quiet(command: Parser) -> None:
    """Add --quiet."""
    command.add_argument("--quiet", action="store_true", help="no progress and no summary")


def print_result(namespace: argparse.Namespace, rows: Rows, warnings: Sequence[str] = ()) -> None:
    """Print the warnings, and a summary unless it is not wanted."""
    for warning in warnings:
        print_warning(warning)
    if not namespace.quiet:
        print_summary(rows)
