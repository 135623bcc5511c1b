"""The subcommand `view`."""

from __future__ import annotations

import argparse
import threading
from typing import Any

from colmap_av1.cli.commands.shared import (
    OTHERS_TOO,
    add_command,
    add_images,
    add_overwrite,
    add_quiet,
    print_result,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.terminal import print_text, progress_bars
from colmap_av1.errors import OptionError
from colmap_av1.options import ReadOptions, TrackOptions, ViewOptions
from colmap_av1.view.matches import view_database
from colmap_av1.view.model import serve_model, view_model
from colmap_av1.view.pictures import check_picture, write_picture
from colmap_av1.view.video import view_video


def add_view(commands: Any) -> None:
    """Add `view`."""
    command = add_command(
        commands,
        "view",
        _run,
        "draw motion, tracks, matches or a model",
        "(--video PATH | --database PATH | --model PATH) --output PATH",
        full_help=True,
    )
    subject = command.add_mutually_exclusive_group(required=True)
    for name, what in (
        ("video", "draw motion and tracks of an AV1 video"),
        ("database", "draw the matches of two images"),
        ("model", "draw points and camera path of a model"),
    ):
        subject.add_argument(f"--{name}", f"--{name}_path", metavar="PATH", help=what)
    command.add_argument(
        "--output",
        "--output_path",
        metavar="PATH",
        help="an .mp4 file or a folder for PNG files (video), else a .png or .jpg file",
    )
    add_overwrite(command, OTHERS_TOO)
    add_images(command, "folder of the database's images")
    command.add_argument(
        "--pair",
        nargs=2,
        metavar="NAME",
        help="the images to draw [the pair with the most inliers]",
    )
    command.add_argument(
        "--interactive",
        action="store_true",
        help="show the model in the browser (needs the viewer extra)",
    )
    command.add_argument(
        "--port", type=int, default=8080, metavar="N", help="port of the interactive viewer [8080]"
    )
    add_options(command, ViewOptions, TrackOptions, ReadOptions)
    add_quiet(command)


def _run(namespace: argparse.Namespace) -> None:
    drawing, tracks = given(namespace, ViewOptions), given(namespace, TrackOptions)
    read = given(namespace, ReadOptions)
    if namespace.model is not None and namespace.interactive:
        _serve(namespace)
        return
    if namespace.output is None:
        raise OptionError("nowhere to draw: give --output")
    output, overwrite = namespace.output, namespace.overwrite
    if namespace.model is not None:
        check_picture(output, [namespace.model], overwrite=overwrite)
        write_picture(view_model(namespace.model), output, overwrite=overwrite)
        return
    if namespace.database is not None:
        if namespace.image_path is None:
            raise OptionError("nothing to draw the matches on: give --image_path")
        inputs = [namespace.database, namespace.image_path]
        check_picture(output, inputs, overwrite=overwrite)
        picture = view_database(namespace.database, namespace.image_path, namespace.pair)
        write_picture(picture, output, overwrite=overwrite)
        return
    with progress_bars(namespace.quiet) as report:
        count = view_video(
            *(namespace.video, output),
            options=drawing,
            tracks=tracks,
            read=read,
            progress=report,
            overwrite=overwrite,
        )
    print_result(namespace, [("frames", str(count)), ("output", output)])


def _serve(namespace: argparse.Namespace) -> None:
    server = serve_model(namespace.model, port=namespace.port)
    try:
        print_text(f"http://127.0.0.1:{namespace.port} (end with Ctrl-C)\n")
        threading.Event().wait()
    finally:
        server.stop()
