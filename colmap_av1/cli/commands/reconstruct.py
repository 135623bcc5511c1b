"""The subcommand `reconstruct`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    ANY_VIDEO,
    add_command,
    add_gaussians,
    add_output,
    add_overwrite,
    add_quiet,
    add_videos,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import reconstruct_rows
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.options import ReconstructOptions
from colmap_av1.reconstruct import reconstruct


def add_reconstruct(commands: Any) -> None:
    """Add `reconstruct`."""
    command = add_command(
        commands,
        "reconstruct",
        _run,
        "reconstruct a dense model for 3D Gaussian splatting",
        "--video PATH [--video PATH] [--images PATH] --output PATH",
        full_help=True,
    )
    add_videos(command, ANY_VIDEO)
    add_output(command, "folder for images/ and sparse/0/; that of an earlier run is resumed")
    add_gaussians(command)
    add_overwrite(command, "replace a file of --gaussians that exists")
    add_options(command, ReconstructOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, ReconstructOptions)
    with progress_bars(namespace.quiet) as report:
        result = reconstruct(
            namespace.video,
            namespace.output,
            photos=namespace.images,
            gaussians=namespace.gaussians,
            overwrite=namespace.overwrite,
            options=options,
            progress=report,
        )
    print_result(namespace, reconstruct_rows(result), result.warnings)
