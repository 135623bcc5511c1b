"""The subcommand `encode`."""

from __future__ import annotations

import argparse
from typing import Any

from colmap_av1.cli.commands.shared import (
    add_command,
    add_output,
    add_overwrite,
    add_quiet,
    add_video,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.terminal import progress_bars
from colmap_av1.options import EncodeOptions
from colmap_av1.video.encode import encode


def add_encode(commands: Any) -> None:
    """Add `encode`."""
    command = add_command(
        commands,
        "encode",
        _run,
        "convert a video to an AV1 stream that is good for matching",
        "--video PATH --output PATH",
    )
    add_video(command, "a video that ffmpeg decodes")
    add_output(command, "the stream: .mp4, .mkv, .webm or .ivf")
    add_overwrite(command)
    command.add_argument(
        "--strict",
        action="store_true",
        help="fail on a damaged video instead of using the frames before the damage",
    )
    add_options(command, EncodeOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    options = given(namespace, EncodeOptions)
    with progress_bars(namespace.quiet) as report:
        result = encode(
            namespace.video,
            namespace.output,
            overwrite=namespace.overwrite,
            strict=namespace.strict,
            options=options,
            progress=report,
        )
    rows = [("frames", str(result.num_frames)), ("encoder", result.encoder)]
    print_result(namespace, [*rows, ("output", str(result.output))])
