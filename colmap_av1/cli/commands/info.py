"""The subcommand `info`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import add_command, add_quiet, add_video
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import info_rows
from colmap_av1.cli.terminal import print_summary, progress_bars
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
    add_options(command, ReadOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, ReadOptions)
    with progress_bars(namespace.quiet) as report:
        result = inspect(namespace.video, options, lambda done: report("motion", done, None))
    print_summary(info_rows(result))
