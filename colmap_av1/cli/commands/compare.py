"""The subcommand `compare`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    ANY_VIDEO,
    add_command,
    add_images,
    add_output,
    add_quiet,
    add_video,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import compare_rows
from colmap_av1.cli.terminal import print_warning, progress_bars
from colmap_av1.errors import EvaluationError
from colmap_av1.options import CompareOptions


def add_compare(commands: Any) -> None:
    """Add `compare`."""
    command = add_command(
        commands,
        "compare",
        _run,
        "compare with SIFT and others on a video, with a report",
        "--video PATH --output PATH [--reference PATH]",
        full_help=True,
    )
    add_video(command, ANY_VIDEO)
    add_output(command, "folder for the report; that of an earlier run is resumed")
    add_images(command, "folder of existing images, or for new ones [within the output]")
    command.add_argument(
        "--reference",
        metavar="PATH",
        help="ground truth: a COLMAP model, or a file with lines of 'name tx ty tz qx qy qz qw', "
        "camera to world [the model of sift-exhaustive]",
    )
    add_options(command, CompareOptions)
    add_quiet(command)


# A model was made, but a trainer failed on one.
_FAILED_TRAINING = 3


def _run(namespace: argparse.Namespace) -> int:
    from colmap_av1.compare import compare  # noqa: PLC0415 - slow to import

    options = given(namespace, CompareOptions)
    with progress_bars(namespace.quiet) as report:
        result = compare(
            namespace.video,
            namespace.output,
            image_path=namespace.image_path,
            reference=namespace.reference,
            options=options,
            progress=report,
        )
    for column in result.columns:
        if column.error:
            print_warning(f"{column.name}: {column.error}")
        if column.training_error:
            print_warning(f"{column.name}: nothing is trained: {column.training_error}")
    print_result(namespace, compare_rows(result), result.warnings)
    if all(column.model is None for column in result.columns):
        raise EvaluationError(f"{result.output}: no front-end gave a model: see report.html there")
    return _FAILED_TRAINING if any(column.training_error for column in result.columns) else 0
