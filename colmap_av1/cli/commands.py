"""The commands: their options, the functions they call, and what they print.

Imports that only one command needs are made when it runs, so that help and short commands start
fast.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import colmap_av1
from colmap_av1.cli import batch, reports
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.parser import Parser
from colmap_av1.cli.report_file import write_report_json
from colmap_av1.cli.terminal import (
    as_shown,
    print_note,
    print_result,
    print_text,
    print_warning,
    progress_bars,
)
from colmap_av1.errors import EvaluationError, ModelError, OptionError
from colmap_av1.options import (
    CompareOptions,
    DensifyOptions,
    EncodeOptions,
    ExportOptions,
    MapOptions,
    MatchOptions,
    PlaceOptions,
    ReadOptions,
    ReconstructOptions,
    TrackOptions,
    ViewOptions,
)
from colmap_av1.options.fields import Options
from colmap_av1.util.files import output_of_model

_FAILED_CHECK = 1
# A trainer failed on a model.
_FAILED_TRAINING = 3


@dataclass(frozen=True)
class Argument:
    """An argument of a command that is not a field of its options.

    Attributes:
        names: its spellings.
        how: further arguments of `add_argument`.
        rare: --help omits it if there is --help-all.
    """

    names: tuple[str, ...]
    how: dict[str, Any]
    rare: bool = False


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        run: runs the command and returns the exit status, None for 0.
        summary: what the command does.
        needed: the options shown in its usage.
        arguments: its arguments, except --quiet.
        options: the dataclasses whose fields are its options.
        full_help: show the help of rare options only with --help-all.
        pycolmap: whether it needs pycolmap.
        add_more: adds further arguments before `arguments`.
    """

    run: Callable[[argparse.Namespace], int | None]
    summary: str
    needed: str
    arguments: Sequence[Argument] = ()
    options: Sequence[type[Options]] = ()
    full_help: bool = False
    pycolmap: bool = True
    add_more: Callable[[Parser], None] | None = None

    def add_to(self, parser: Parser) -> None:
        """Add the arguments to the command's parser."""
        if self.add_more is not None:
            self.add_more(parser)
        for argument in self.arguments:
            action = parser.add_argument(*argument.names, **argument.how)
            if argument.rare:
                parser.rare.append(action)
        add_options(parser, *self.options)
        parser.add_argument("--quiet", action="store_true", help="no progress and no summary")


def _path(name: str, what: str, *, required: bool = True, **how: Any) -> Argument:
    """A path option, also with COLMAP's spelling of its name."""
    how = {"required": required, "metavar": "PATH", "help": what, **how}
    return Argument((f"--{name}", f"--{name}_path"), how)


def _optional_path(name: str, what: str) -> Argument:
    return Argument((f"--{name}",), {"metavar": "PATH", "help": what})


def _flag(name: str, what: str) -> Argument:
    return Argument((f"--{name}",), {"action": "store_true", "help": what})


def _videos(what: str) -> tuple[Argument, ...]:
    """Options for videos and photos."""
    return (
        _path("video", f"{what}; repeat for several videos", action="append"),
        _optional_path("photos", "folder of photos of the same scene to add"),
    )


_ANY_VIDEO = "a video; converted first if it is not AV1"
_VIDEO = _path("video", "an AV1 video")
_DATABASE = _path("database", "a COLMAP database")
_OVERWRITE = _flag("overwrite", "replace an existing output")
_OVERWRITE_MODELS = _flag("overwrite", "replace an existing output that contains only models")
_GAUSSIANS = _optional_path(
    "gaussians", "also write initial Gaussians to this .ply, for trainers that start from them"
)
_REPORT_JSON = Argument(
    ("--report_json",),
    {
        "metavar": "PATH",
        "help": "also write the report, or the reason of a failure, to this file as JSON",
    },
    rare=True,
)


def _match(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.match(
            namespace.database,
            namespace.video,
            photos=namespace.photos,
            image_path=namespace.image_path,
            options=given(namespace, MatchOptions),
            progress=progress,
        )
    write_report_json(namespace, result)
    print_result(namespace, reports.match_rows(result), result.warnings)
    if not namespace.quiet:
        _print_next(result)


def _print_next(report: colmap_av1.MatchReport) -> None:
    """Print the commands that map what `match` wrote."""
    with_colmap, with_ours, densify = map(as_shown, report.next_commands)
    if sys.stdout.isatty():
        # Printed without markup, so that they can be copied from any terminal.
        print_text(
            f"Map it with COLMAP:\n  {with_colmap}\nor without it:\n  {with_ours}\n"
            f"Then, to train Gaussian splats:\n  {densify}\n"
        )
    else:
        print_text(f"next\t{with_colmap}\nor\t{with_ours}\nthen, for splats\t{densify}\n")
    if report.image_path is None:
        print_note("IMAGES stands for a folder of the frames")


def _map(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.map_database(
            namespace.database,
            namespace.image_path,
            namespace.output,
            options=given(namespace, MapOptions),
            place=given(namespace, PlaceOptions),
            progress=progress,
            overwrite=namespace.overwrite,
        )
    print_result(namespace, reports.map_rows(result), result.warnings)


def _reconstruct(namespace: argparse.Namespace) -> None:
    page = None
    if namespace.report:
        from colmap_av1.view.page import check_page

        output = Path(namespace.output).resolve()  # "." and ".." have no name
        page = output.parent / f"{output.name}.html"
        check_page(page, overwrite=namespace.overwrite)
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.reconstruct(
            namespace.video,
            namespace.output,
            photos=namespace.photos,
            gaussians=namespace.gaussians,
            overwrite=namespace.overwrite,
            options=given(namespace, ReconstructOptions),
            progress=progress,
        )
    rows = reports.reconstruct_rows(result)
    if page is not None:
        from colmap_av1.view.page import write_model_page

        write_model_page(
            result.output / "sparse" / "0",
            page,
            figures=reports.without_seconds(rows),
            report=result,
            overwrite=namespace.overwrite,
        )
        rows.append(("page", str(page)))
    write_report_json(namespace, result)
    print_result(namespace, rows, result.warnings)


def _densify(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.densify(
            namespace.model,
            namespace.video,
            namespace.output,
            photos=namespace.photos,
            image_path=namespace.image_path,
            gaussians=namespace.gaussians,
            options=given(namespace, DensifyOptions),
            progress=progress,
            overwrite=namespace.overwrite,
        )
    write_report_json(namespace, result)
    print_result(namespace, reports.densify_rows(result), result.warnings)


def _compare(namespace: argparse.Namespace) -> int:
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.compare(
            namespace.video,
            namespace.output,
            image_path=namespace.image_path,
            reference=namespace.reference,
            options=given(namespace, CompareOptions),
            progress=progress,
        )
    for column in result.columns:
        if column.error:
            print_warning(f"{column.name}: {column.error}")
        if column.training_error:
            print_warning(f"{column.name}: training failed: {column.training_error}")
    print_result(namespace, reports.compare_rows(result), result.warnings)
    if all(column.model is None for column in result.columns):
        raise EvaluationError(f"{result.output}: no front-end made a model: see report.html there")
    return _FAILED_TRAINING if any(column.training_error for column in result.columns) else 0


def _encode(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.encode(
            namespace.video,
            namespace.output,
            overwrite=namespace.overwrite,
            strict=namespace.strict,
            options=given(namespace, EncodeOptions),
            progress=progress,
        )
    rows = [("frames", str(result.num_frames)), ("encoder", result.encoder)]
    print_result(namespace, [*rows, ("output", str(result.output))])


def _info(namespace: argparse.Namespace) -> None:
    options = given(namespace, ReadOptions)
    read_out = None
    with progress_bars(namespace.quiet) as progress:
        result = colmap_av1.read_info(namespace.video, options=options, progress=progress)
        if namespace.rolling_shutter == "estimate":
            from colmap_av1.matching.shutter.of_video import estimate_video_read_out

            read_out = estimate_video_read_out(namespace.video, options=options, progress=progress)
    # A text says why it is not observable.
    found = read_out if read_out is None or isinstance(read_out, str) else asdict(read_out)
    write_report_json(namespace, result, read_out=found)
    print_result(namespace, [*reports.info_rows(result), *reports.read_out_rows(read_out)])


def _check(namespace: argparse.Namespace) -> int:
    if namespace.database is None and namespace.model is None:
        raise OptionError("nothing to check: give --database, or --model, or both")
    if namespace.model is None and namespace.image_path is not None:
        raise OptionError("images are compared with a model: give --model, too")
    good = True
    if namespace.database is not None:
        result = colmap_av1.check_database(namespace.database)
        print_result(namespace, reports.check_rows(result))
        good = result.mappable and not result.damaged
    if namespace.model is not None:
        good = _check_model(namespace) and good
    return 0 if good or not namespace.strict else _FAILED_CHECK


def _check_model(namespace: argparse.Namespace) -> bool:
    """Print the diagnosis of a model, and return whether it is consistent."""
    with progress_bars(namespace.quiet) as progress:
        found = colmap_av1.check_model(
            namespace.model,
            image_path=namespace.image_path,
            database=namespace.database,
            progress=progress,
        )
    print_result(namespace, reports.model_rows(found), found.warnings)
    return not found.warnings


def _motion(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        count = colmap_av1.export_motion(
            namespace.video,
            namespace.output,
            options=given(namespace, ReadOptions),
            progress=progress,
            overwrite=namespace.overwrite,
        )
    print_result(namespace, [("coded frames", str(count)), ("output", namespace.output)])


def _export(namespace: argparse.Namespace) -> None:
    with progress_bars(namespace.quiet) as progress:
        num_images, num_pairs = colmap_av1.export_hloc(
            namespace.database,
            namespace.output,
            options=given(namespace, ExportOptions),
            progress=progress,
            overwrite=namespace.overwrite,
        )
    rows = [("images", str(num_images)), ("pairs", str(num_pairs))]
    print_result(namespace, [*rows, ("output", namespace.output)])


def _add_subject(parser: Parser) -> None:
    """Add the options for the subject that `view` draws."""
    subject = parser.add_mutually_exclusive_group(required=True)
    for name, what in (
        ("video", "draw motion and tracks of an AV1 video"),
        ("database", "draw the matches of two images"),
        ("model", "draw points and camera path of a model"),
    ):
        subject.add_argument(f"--{name}", f"--{name}_path", metavar="PATH", help=what)


def _view(namespace: argparse.Namespace) -> None:
    from colmap_av1.view.matches import view_database
    from colmap_av1.view.model import view_model
    from colmap_av1.view.pictures import check_picture, write_picture
    from colmap_av1.view.video import view_video

    if namespace.pair is not None and namespace.database is None:
        raise OptionError("pair names images of a database: give --database, too")
    if namespace.interactive and namespace.model is None:
        raise OptionError("interactive shows a model: give --model, too")
    if namespace.interactive:
        _serve(namespace)
        return
    if namespace.output is None:
        raise OptionError("no output to draw to: give --output")
    output, overwrite = namespace.output, namespace.overwrite
    if namespace.model is not None and Path(output).suffix.lower() == ".html":
        _view_page(namespace)
        return
    if namespace.model is not None:
        check_picture(output, [namespace.model], overwrite=overwrite)
        write_picture(view_model(namespace.model), output, overwrite=overwrite)
        return
    if namespace.database is not None:
        if namespace.image_path is None:
            raise OptionError("no images to draw the matches on: give --image_path")
        inputs = [namespace.database, namespace.image_path]
        check_picture(output, inputs, overwrite=overwrite)
        picture = view_database(namespace.database, namespace.image_path, namespace.pair)
        write_picture(picture, output, overwrite=overwrite)
        return
    with progress_bars(namespace.quiet) as progress:
        count = view_video(
            namespace.video,
            output,
            options=given(namespace, ViewOptions),
            tracks=given(namespace, TrackOptions),
            read=given(namespace, ReadOptions),
            progress=progress,
            overwrite=overwrite,
        )
    print_result(namespace, [("frames", str(count)), ("output", output)])


def _view_page(namespace: argparse.Namespace) -> None:
    from colmap_av1.reconstruct import read_report
    from colmap_av1.view.page import check_page, write_model_page

    model, report = Path(namespace.model), None
    check_page(namespace.output, [model], overwrite=namespace.overwrite)
    output = output_of_model(model)
    if output is not None and output == model.resolve().parents[1]:  # not of a further model
        try:
            report = read_report(output)
        except ModelError as error:
            print_warning(f"{error}; the page shows only the model")
    if report is not None:
        rows = reports.reconstruct_rows(report)
    else:
        rows = reports.model_rows(colmap_av1.check_model(model))
    write_model_page(
        model,
        namespace.output,
        figures=reports.without_seconds(rows),
        report=report,
        image_path=namespace.image_path,
        overwrite=namespace.overwrite,
    )


def _serve(namespace: argparse.Namespace) -> None:
    from colmap_av1.view.model import serve_model

    server = serve_model(namespace.model, port=namespace.port)
    try:
        print_text(f"http://127.0.0.1:{namespace.port} (end with Ctrl-C)\n")
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


COMMANDS = {
    "match": Command(
        _match,
        "fill a COLMAP database from a video",
        "--database PATH --video PATH [--video PATH] [--photos PATH] [--image_path PATH]",
        (
            _path("database", "COLMAP database; its images are used, or it is created"),
            *_videos(_ANY_VIDEO),
            _optional_path(
                "image_path",
                "folder to write the images to; existing images of the right size are kept",
            ),
            _REPORT_JSON,
        ),
        (MatchOptions,),
        full_help=True,
    ),
    "map": Command(
        _map,
        "map a COLMAP database with one of COLMAP's mappers",
        "--database PATH --image_path PATH --output PATH",
        (
            _DATABASE,
            Argument(
                ("--image_path",),
                {"required": True, "metavar": "PATH", "help": "folder of the database's images"},
            ),
            _path("output", "new folder for the models; model 0 has the most images"),
            _OVERWRITE_MODELS,
        ),
        (MapOptions, PlaceOptions),
    ),
    "reconstruct": Command(
        _reconstruct,
        "reconstruct a dense model for 3D Gaussian splatting",
        "--video PATH [--video PATH] [--photos PATH] --output PATH",
        (
            *_videos(_ANY_VIDEO),
            _path("output", "folder for images/ and sparse/0/; an earlier run there is resumed"),
            _GAUSSIANS,
            _flag(
                "report",
                "also write the page OUTPUT.html, next to the folder, to view the model (needs the "
                "viewer extra)",
            ),
            _flag(
                "overwrite",
                "replace an existing file of --gaussians or --report, or a model of other videos",
            ),
            _REPORT_JSON,
        ),
        (ReconstructOptions,),
        full_help=True,
    ),
    "densify": Command(
        _densify,
        "triangulate dense points on the poses of an existing model",
        "--model PATH --video PATH [--video PATH] [--photos PATH] --output PATH",
        (
            _path("model", "folder of a COLMAP model"),
            *_videos("the video from which its images were taken"),
            _path("output", "new folder for the model"),
            _OVERWRITE_MODELS,
            _optional_path(
                "image_path", "folder of its images, if their names do not determine the frames"
            ),
            _GAUSSIANS,
            _REPORT_JSON,
        ),
        (DensifyOptions,),
        full_help=True,
    ),
    "batch": Command(
        batch.run,
        "run one task on many videos, on this machine or a cluster; 'batch report' makes a page",
        "[report] --inputs PATH ... --output PATH --task TASK",
        full_help=True,
        add_more=batch.add_arguments,
    ),
    "compare": Command(
        _compare,
        "compare with SIFT and other front-ends on a video, and write a report",
        "--video PATH --output PATH [--reference PATH]",
        (
            _path("video", _ANY_VIDEO),
            _path("output", "folder for the report; an earlier run there is resumed"),
            _optional_path(
                "image_path", "folder of existing images, or for new images [within the output]"
            ),
            _optional_path(
                "reference",
                "ground truth: a COLMAP model, or a file with lines of 'name tx ty tz qx qy qz "
                "qw', camera to world [the model of sift-exhaustive]",
            ),
        ),
        (CompareOptions,),
        full_help=True,
    ),
    "encode": Command(
        _encode,
        "convert a video to an AV1 stream that is good for matching",
        "--video PATH --output PATH",
        (
            _path("video", "a video that ffmpeg decodes"),
            _path("output", "the stream: .mp4, .mkv, .webm or .ivf"),
            _OVERWRITE,
            _flag(
                "strict",
                "fail on a damaged video instead of using the frames before the damage",
            ),
        ),
        (EncodeOptions,),
        pycolmap=False,
    ),
    "info": Command(
        _info,
        "report a stream's structure and whether it is good for matching",
        "--video PATH",
        (
            _VIDEO,
            Argument(
                ("--rolling_shutter",),
                {
                    "choices": ("none", "estimate"),
                    "default": "none",
                    "help": "estimate: also estimate the rolling-shutter read-out time from the "
                    "tracks, which takes as long as matching",
                },
            ),
            _REPORT_JSON,
        ),
        (ReadOptions,),
        pycolmap=False,
    ),
    "check": Command(
        _check,
        "report whether COLMAP's mappers can use a database, or whether a model is consistent",
        "{--database PATH | --model PATH}",
        (
            _path("database", "a COLMAP database", required=False),
            _path(
                "model",
                "folder of a COLMAP model; with --image_path, images far apart in time are matched "
                "and compared with its poses; with --database, the matches that it was mapped from",
                required=False,
            ),
            _optional_path("image_path", "folder of the model's images"),
            _flag(
                "strict",
                "exit with status 1 if the mappers cannot use the database, it is damaged, or "
                "there is a warning about the model",
            ),
        ),
    ),
    "motion": Command(
        _motion,
        "write the motion of every frame",
        "--video PATH --output PATH",
        (_VIDEO, _path("output", "a .npz or .h5 file"), _OVERWRITE),
        (ReadOptions,),
        pycolmap=False,
    ),
    "export": Command(
        _export,
        "write a database's features and matches for hloc",
        "--database PATH --output PATH",
        (_DATABASE, _path("output", "folder for the files"), _OVERWRITE),
        (ExportOptions,),
    ),
    "view": Command(
        _view,
        "draw motion, tracks, matches or a model",
        "(--video PATH | --database PATH | --model PATH) --output PATH",
        (
            _path(
                "output",
                "an .mp4 file or a folder for PNG files (video), an .html page (model), else a "
                ".png or .jpg file",
                required=False,
            ),
            _OVERWRITE,
            _optional_path("image_path", "folder of the images of the database or model"),
            Argument(
                ("--pair",),
                {
                    "nargs": 2,
                    "metavar": "NAME",
                    "help": "the images to draw [the pair with the most inliers]",
                },
            ),
            _flag("interactive", "show the model in the browser (needs the viewer extra)"),
            Argument(
                ("--port",),
                {
                    "type": int,
                    "default": 8080,
                    "metavar": "N",
                    "help": "port of the interactive viewer [8080]",
                },
            ),
        ),
        (ViewOptions, TrackOptions, ReadOptions),
        full_help=True,
        add_more=_add_subject,
    ),
}
