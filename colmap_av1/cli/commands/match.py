"""The subcommand `match`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    ANY_VIDEO,
    add_command,
    add_database,
    add_images,
    add_quiet,
    add_videos,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import match_rows
from colmap_av1.cli.terminal import print_next, progress_bars
from colmap_av1.match import match
from colmap_av1.options import MatchOptions


def add_match(commands: Any) -> None:
    """Add `match`."""
    command = add_command(
        commands,
        "match",
        _run,
        "fill a COLMAP database from a video",
        "--database PATH --video PATH [--video PATH] [--images PATH] [--image_path PATH]",
        full_help=True,
    )
    add_database(command, "COLMAP database; its images are used, or it is created")
    add_videos(command, ANY_VIDEO)
    add_images(command, "folder to write the images to; existing ones of the right size are kept")
    add_options(command, MatchOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, MatchOptions)
    with progress_bars(namespace.quiet) as report:
        result = match(
            namespace.database,
            namespace.video,
            photos=namespace.images,
            image_path=namespace.image_path,
            options=options,
            progress=report,
        )
    print_result(namespace, match_rows(result), result.warnings)
    if not namespace.quiet:
        print_next(result)
