"""The subcommand `motion`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    OTHERS_TOO,
    add_command,
    add_output,
    add_overwrite,
    add_quiet,
    add_video,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.motion.motion_file import export_motion
from colmap_av1.options import ReadOptions


def add_motion(commands: Any) -> None:
    """Add `motion`."""
    command = add_command(
        commands,
        "motion",
        _run,
        "write the motion of every frame",
        "--video PATH --output PATH",
    )
    add_video(command)
    add_output(command, "a .npz or .h5 file")
    add_overwrite(command, OTHERS_TOO)
    add_options(command, ReadOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, ReadOptions)
    with progress_bars(namespace.quiet) as report:
        count = export_motion(
            *(namespace.video, namespace.output, options),
            lambda done: report("motion", done, None),
            overwrite=namespace.overwrite,
        )
    print_result(namespace, [("coded frames", str(count)), ("output", namespace.output)])
