"""The subcommand `info`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import add_command, add_quiet, add_video
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import info_rows, read_out_rows
from colmap_av1.cli.terminal import print_summary, progress_bars
from colmap_av1.matching.shutter.of_video import estimate_video_read_out
from colmap_av1.motion.info import inspect
from colmap_av1.options import ReadOptions


def add_info(commands: Any) -> None:
    """Add `info`."""
    command = add_command(
        commands,
        "info",
        _run,
        "report a stream's structure and whether it is good for matching",
        "--video PATH",
    )
    add_video(command)
    command.add_argument(
        "--rolling_shutter",
        choices=("none", "estimate"),
        default="none",
        help="estimate: also the time in which the shutter reads the rows of a picture, from the "
        "tracks, which takes as long as to match them",
    )
    add_options(command, ReadOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, ReadOptions)
    read_out = None
    with progress_bars(namespace.quiet) as report:
        result = inspect(namespace.video, options, lambda done: report("motion", done, None))
        if namespace.rolling_shutter == "estimate":
            read_out = estimate_video_read_out(namespace.video, options, report)
    print_summary([*info_rows(result), *read_out_rows(read_out)])
