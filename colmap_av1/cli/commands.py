"""One subcommand each: its options, the function it calls, what it prints."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable, Sequence
from typing import Any

from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.reports import (
    Rows,
    check_rows,
    compare_rows,
    densify_rows,
    info_rows,
    map_rows,
    match_rows,
    reconstruct_rows,
)
from colmap_av1.cli.terminal import (
    print_next,
    print_summary,
    print_warning,
    progress_bars,
)
from colmap_av1.database.check import check
from colmap_av1.database.hloc import export_hloc
from colmap_av1.densify import densify
from colmap_av1.errors import EvaluationError, OptionError
from colmap_av1.map import map_database
from colmap_av1.match import match
from colmap_av1.motion.info import inspect as inspect_stream
from colmap_av1.motion.motion_file import export_motion
from colmap_av1.options import (
    CameraOptions,
    CompareOptions,
    DensifyOptions,
    DensityOptions,
    EncodeOptions,
    ExportOptions,
    ImageOptions,
    LearnedOptions,
    MapOptions,
    MapperOptions,
    MatchOptions,
    PairOptions,
    ReadOptions,
    ReconstructOptions,
    RefineOptions,
    TrackOptions,
    TriangulateOptions,
    VerifyOptions,
    ViewOptions,
)
from colmap_av1.reconstruct import reconstruct
from colmap_av1.video.encode import encode
from colmap_av1.view.matches import view_database
from colmap_av1.view.model import serve_model, view_model
from colmap_av1.view.pictures import write_picture
from colmap_av1.view.video import view_video

ABOUT_NAMES = (
    "'-' and '_' are alike in option names. COLMAP's spellings are accepted, such as "
    "--ImageReader.camera_model."
)
_ANY_VIDEO = "a video; one that is not AV1 is converted first"
# The stages of `match`, as their options are titled.
_STAGES: dict[type, str] = {
    ImageOptions: "images",
    MatchOptions: "stream",
    CameraOptions: "camera",
    TrackOptions: "tracks",
    RefineOptions: "refinement",
    DensityOptions: "density",
    PairOptions: "pairs",
    VerifyOptions: "two-view geometry",
    ReadOptions: "bitstream",
    EncodeOptions: "encoding of a video that is not AV1",
}
_FAILED_CHECK = 1


def _add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    summary: str,
    needed: str,
) -> argparse.ArgumentParser:
    """Add a subcommand; `needed` are the options that its usage names."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        usage=f"%(prog)s {needed} [options]",
        epilog=ABOUT_NAMES,
        allow_abbrev=False,
    )
    command.set_defaults(run=run)
    return command


def _stages_but(*left_out: type) -> dict[type, str]:
    return {kind: title for kind, title in _STAGES.items() if kind not in left_out}


def _add_database(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--database", "--database_path", required=True, metavar="PATH", help="a COLMAP database"
    )


def _add_video(command: argparse.ArgumentParser, what: str = "an AV1 video") -> None:
    command.add_argument("--video", "--video_path", required=True, metavar="PATH", help=what)


def _add_output(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument("--output", "--output_path", required=True, metavar="PATH", help=what)


def _add_quiet(command: argparse.ArgumentParser) -> None:
    command.add_argument("--quiet", action="store_true", help="no progress and no summary")


def _match_options(namespace: argparse.Namespace) -> MatchOptions:
    return given(
        namespace,
        MatchOptions,
        images=given(namespace, ImageOptions),
        encode=given(namespace, EncodeOptions),
        read=given(namespace, ReadOptions),
        tracks=given(namespace, TrackOptions),
        refine=given(namespace, RefineOptions),
        density=given(namespace, DensityOptions),
        pairs=given(namespace, PairOptions),
        verify=given(namespace, VerifyOptions),
        camera=given(namespace, CameraOptions),
    )


def _print_result(namespace: argparse.Namespace, rows: Rows, warnings: Sequence[str] = ()) -> None:
    """Print the warnings, and a summary unless it is not wanted."""
    for warning in warnings:
        print_warning(warning)
    if not namespace.quiet:
        print_summary(rows)


def add_match(commands: Any) -> None:
    """Add `match`."""
    command = _add_command(
        commands,
        "match",
        _run_match,
        "fill a COLMAP database from a video",
        "--database PATH --video PATH [--image_path PATH]",
    )
    command.add_argument(
        "--database",
        "--database_path",
        required=True,
        metavar="PATH",
        help="COLMAP database; made where it is missing, else its images are used",
    )
    _add_video(command, _ANY_VIDEO)
    command.add_argument(
        "--image_path",
        metavar="PATH",
        help="folder to write the images to; existing ones of the right size are kept",
    )
    add_options(
        command,
        {**_STAGES, MatchOptions: "database and stream"},
    )
    _add_quiet(command)


def _run_match(namespace: argparse.Namespace) -> None:
    options = _match_options(namespace)
    with progress_bars(namespace.quiet) as report:
        result = match(
            namespace.database,
            namespace.video,
            image_path=namespace.image_path,
            options=options,
            progress=report,
        )
    _print_result(namespace, match_rows(result), result.warnings)
    if not namespace.quiet:
        print_next(result)


def add_map(commands: Any) -> None:
    """Add `map`."""
    command = _add_command(
        commands,
        "map",
        _run_map,
        "make a model of a COLMAP database with one of COLMAP's mappers",
        "--database PATH --image_path PATH --output PATH",
    )
    _add_database(command)
    command.add_argument(
        "--image_path", required=True, metavar="PATH", help="folder of the database's images"
    )
    _add_output(command, "new folder for the models; 0 is the one with the most images")
    command.add_argument(
        "--forward_motion",
        action="store_true",
        help="the camera moves along its axis: start with such a pair, keep the intrinsics",
    )
    add_options(command, {MapOptions: "mapper"}, without=("forward_motion",))
    _add_quiet(command)


def _run_map(namespace: argparse.Namespace) -> None:
    options = given(namespace, MapOptions, forward_motion=namespace.forward_motion)
    with progress_bars(namespace.quiet) as report:
        result = map_database(
            namespace.database,
            namespace.image_path,
            namespace.output,
            options=options,
            progress=report,
        )
    _print_result(namespace, map_rows(result))


def add_reconstruct(commands: Any) -> None:
    """Add `reconstruct`."""
    command = _add_command(
        commands,
        "reconstruct",
        _run_reconstruct,
        "make a dense model for 3D Gaussian splatting",
        "--video PATH --output PATH",
    )
    _add_video(command, _ANY_VIDEO)
    _add_output(command, "folder for images/ and sparse/0/; that of an earlier run is gone on with")
    add_options(
        command,
        {MapperOptions: "poses", TriangulateOptions: "points", **_stages_but(DensityOptions)},
        without=("on_existing", "first_number", "single_camera"),
    )
    _add_quiet(command)


def _run_reconstruct(namespace: argparse.Namespace) -> None:
    options = ReconstructOptions(
        match=_match_options(namespace),
        mapping=given(namespace, MapperOptions),
        triangulate=given(namespace, TriangulateOptions),
    )
    with progress_bars(namespace.quiet) as report:
        result = reconstruct(namespace.video, namespace.output, options=options, progress=report)
    _print_result(namespace, reconstruct_rows(result), result.warnings)


def add_densify(commands: Any) -> None:
    """Add `densify`."""
    command = _add_command(
        commands,
        "densify",
        _run_densify,
        "put dense points on the poses of a model that is there",
        "--model PATH --video PATH --output PATH",
    )
    command.add_argument(
        "--model", "--model_path", required=True, metavar="PATH", help="folder of a COLMAP model"
    )
    _add_video(command, "the video its images come from")
    _add_output(command, "new folder for the model")
    command.add_argument(
        "--image_path", metavar="PATH", help="folder of its images, where names leave doubt"
    )
    of_matches = (CameraOptions, DensityOptions, PairOptions, VerifyOptions)
    of_new_images = ("image_name", "num_images", "fps", "select", "skip_blurred")
    add_options(
        command,
        {TriangulateOptions: "points", **_stages_but(*of_matches)},
        without=("on_existing", *of_new_images),
    )
    _add_quiet(command)


def _run_densify(namespace: argparse.Namespace) -> None:
    options = DensifyOptions(
        match=_match_options(namespace), triangulate=given(namespace, TriangulateOptions)
    )
    with progress_bars(namespace.quiet) as report:
        result = densify(
            namespace.model,
            namespace.video,
            namespace.output,
            image_path=namespace.image_path,
            options=options,
            progress=report,
        )
    _print_result(namespace, densify_rows(result), result.warnings)


def add_compare(commands: Any) -> None:
    """Add `compare`."""
    command = _add_command(
        commands,
        "compare",
        _run_compare,
        "compare with SIFT and others on a video, with a report",
        "--video PATH --output PATH [--reference PATH]",
    )
    _add_video(command, _ANY_VIDEO)
    _add_output(command, "folder for the report; that of an earlier run is gone on with")
    command.add_argument(
        "--image_path",
        metavar="PATH",
        help="folder of images that exist or are to be written [within the output]",
    )
    command.add_argument(
        "--reference",
        metavar="PATH",
        help="given truth: a COLMAP model, or a file with lines of 'name tx ty tz qx qy qz qw', "
        "camera to world [the model of sift-exhaustive]",
    )
    add_options(
        command,
        {
            CompareOptions: "comparison",
            LearnedOptions: "learned features",
            TriangulateOptions: "points of all tracks",
            **_stages_but(DensityOptions),
        },
        without=("on_existing", "refine", "single_camera"),
    )
    _add_quiet(command)


def _run_compare(namespace: argparse.Namespace) -> None:
    from colmap_av1.compare import compare  # noqa: PLC0415 - slow to import

    options = given(
        namespace,
        CompareOptions,
        match=_match_options(namespace),
        learned=given(namespace, LearnedOptions),
        triangulate=given(namespace, TriangulateOptions),
    )
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
    for reason in sorted({column.training_error for column in result.columns} - {""}):
        print_warning(f"nothing is trained: {reason}")
    _print_result(namespace, compare_rows(result), result.warnings)
    if all(column.model is None for column in result.columns):
        raise EvaluationError(
            f"{result.output}: no front-end gave a model: report.md there says why of each"
        )


def add_encode(commands: Any) -> None:
    """Add `encode`."""
    command = _add_command(
        commands,
        "encode",
        _run_encode,
        "convert a video to a good AV1 stream",
        "--video PATH --output PATH",
    )
    _add_video(command, "a video that ffmpeg decodes")
    _add_output(command, "the stream: .mp4, .mkv, .webm or .ivf")
    command.add_argument("--overwrite", action="store_true", help="replace an output that exists")
    command.add_argument(
        "--strict",
        action="store_true",
        help="fail on a damaged video instead of using the frames before the damage",
    )
    add_options(command, {EncodeOptions: "encoding"})
    _add_quiet(command)


def _run_encode(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as report:
        result = encode(
            namespace.video,
            namespace.output,
            overwrite=namespace.overwrite,
            strict=namespace.strict,
            options=given(namespace, EncodeOptions),
            progress=report,
        )
    rows = [("frames", str(result.num_frames)), ("encoder", result.encoder)]
    _print_result(namespace, [*rows, ("output", str(result.output))])


def add_info(commands: Any) -> None:
    """Add `info`."""
    command = _add_command(
        commands,
        "info",
        _run_info,
        "tell what a stream is made of and whether it is any good",
        "--video PATH",
    )
    _add_video(command)
    add_options(command, {ReadOptions: "bitstream"})
    _add_quiet(command)


def _run_info(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as report:
        result = inspect_stream(
            namespace.video,
            given(namespace, ReadOptions),
            lambda done: report("motion", done, None),
        )
    print_summary(info_rows(result))


def add_check(commands: Any) -> None:
    """Add `check`."""
    command = _add_command(
        commands,
        "check",
        _run_check,
        "tell what COLMAP's mappers will make of a database",
        "--database PATH",
    )
    _add_database(command)
    command.add_argument(
        "--strict",
        action="store_true",
        help="exit with status 1 where something stops the mappers",
    )


def _run_check(namespace: argparse.Namespace) -> int:
    result = check(namespace.database)
    print_summary(check_rows(result))
    return _FAILED_CHECK if namespace.strict and not result.mappable else 0


def add_motion(commands: Any) -> None:
    """Add `motion`."""
    command = _add_command(
        commands,
        "motion",
        _run_motion,
        "write the motion of every frame",
        "--video PATH --output PATH",
    )
    _add_video(command)
    _add_output(command, "a .npz or .h5 file")
    add_options(command, {ReadOptions: "bitstream"})
    _add_quiet(command)


def _run_motion(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as report:
        count = export_motion(
            namespace.video,
            namespace.output,
            given(namespace, ReadOptions),
            lambda done: report("motion", done, None),
        )
    _print_result(namespace, [("coded frames", str(count)), ("output", namespace.output)])


def add_export(commands: Any) -> None:
    """Add `export`."""
    command = _add_command(
        commands,
        "export",
        _run_export,
        "write a database's features and matches for hloc",
        "--database PATH --output PATH",
    )
    _add_database(command)
    _add_output(command, "folder for the files")
    add_options(command, {ExportOptions: "files"})
    _add_quiet(command)


def _run_export(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as report:
        num_images, num_pairs = export_hloc(
            namespace.database, namespace.output, given(namespace, ExportOptions), report
        )
    rows = [("images", str(num_images)), ("pairs", str(num_pairs))]
    _print_result(namespace, [*rows, ("output", namespace.output)])


def add_view(commands: Any) -> None:
    """Add `view`."""
    command = _add_command(
        commands,
        "view",
        _run_view,
        "draw motion, tracks, matches or a model",
        "(--video PATH | --database PATH | --model PATH) --output PATH",
    )
    subject = command.add_mutually_exclusive_group(required=True)
    subject.add_argument(
        "--video", "--video_path", metavar="PATH", help="draw motion and tracks of an AV1 video"
    )
    subject.add_argument(
        "--database", "--database_path", metavar="PATH", help="draw the matches of two images"
    )
    subject.add_argument(
        "--model", "--model_path", metavar="PATH", help="draw points and camera path of a model"
    )
    command.add_argument(
        "--output",
        "--output_path",
        metavar="PATH",
        help="an .mp4 file or a folder for PNG files (video), else a .png or .jpg file",
    )
    command.add_argument("--image_path", metavar="PATH", help="folder of the database's images")
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
    add_options(
        command,
        {ViewOptions: "drawing", TrackOptions: "tracks", ReadOptions: "bitstream"},
    )
    _add_quiet(command)


def _run_view(namespace: argparse.Namespace) -> None:
    if namespace.model is not None and namespace.interactive:
        _serve(namespace)
        return
    if namespace.output is None:
        raise OptionError("nowhere to draw: give --output")
    if namespace.model is not None:
        write_picture(view_model(namespace.model), namespace.output)
        return
    if namespace.database is not None:
        if namespace.image_path is None:
            raise OptionError("nothing to draw the matches on: give --image_path")
        picture = view_database(namespace.database, namespace.image_path, namespace.pair)
        write_picture(picture, namespace.output)
        return
    with progress_bars(namespace.quiet) as report:
        count = view_video(
            namespace.video,
            namespace.output,
            options=given(namespace, ViewOptions),
            tracks=given(namespace, TrackOptions),
            read=given(namespace, ReadOptions),
            progress=report,
        )
    _print_result(namespace, [("frames", str(count)), ("output", namespace.output)])


def _serve(namespace: argparse.Namespace) -> None:
    server = serve_model(namespace.model, port=namespace.port)
    try:
        print(f"http://127.0.0.1:{namespace.port} (end with Ctrl-C)", flush=True)
        threading.Event().wait()
    finally:
        server.stop()
