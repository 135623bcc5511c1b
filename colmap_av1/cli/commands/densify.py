"""The subcommand `densify`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    ONLY_MODELS,
    add_command,
    add_gaussians,
    add_images,
    add_output,
    add_overwrite,
    add_quiet,
    add_videos,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import densify_rows
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.densify import densify
from colmap_av1.options import DensifyOptions


def add_densify(commands: Any) -> None:
    """Add `densify`."""
    command = add_command(
        commands,
        "densify",
        _run,
        "triangulate dense points on the poses of an existing model",
        "--model PATH --video PATH [--video PATH] [--images PATH] --output PATH",
        full_help=True,
    )
    command.add_argument(
        "--model", "--model_path", required=True, metavar="PATH", help="folder of a COLMAP model"
    )
    add_videos(command, "the video from which its images were taken")
    add_output(command, "new folder for the model")
    add_overwrite(command, ONLY_MODELS)
    add_images(command, "folder of its images, where their names do not determine the frames")
    add_gaussians(command)
    add_options(command, DensifyOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, DensifyOptions)
    with progress_bars(namespace.quiet) as report:
        result = densify(
            namespace.model,
            namespace.video,
            namespace.output,
            photos=namespace.images,
            image_path=namespace.image_path,
            gaussians=namespace.gaussians,
            options=options,
            progress=report,
            overwrite=namespace.overwrite,
        )
    print_result(namespace, densify_rows(result), result.warnings)
