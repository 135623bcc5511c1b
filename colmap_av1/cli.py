"""The command line: parses words and calls one function per subcommand."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.metadata
import inspect
import re
import signal
import sys
import threading
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBars
from rich.table import Table

from colmap_av1.check import CheckReport, check
from colmap_av1.compare import compare
from colmap_av1.encode import encode
from colmap_av1.errors import ColmapAv1Error, OptionError
from colmap_av1.export import export_hloc
from colmap_av1.info import StreamReport
from colmap_av1.info import inspect as inspect_stream
from colmap_av1.match import MatchReport, match
from colmap_av1.motion_file import export_motion
from colmap_av1.options import (
    CameraOptions,
    CompareOptions,
    DensifyOptions,
    DensityOptions,
    EncodeOptions,
    ExportOptions,
    ImageOptions,
    LearnedOptions,
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
from colmap_av1.progress import Progress, no_progress
from colmap_av1.reconstruct import densify, reconstruct
from colmap_av1.view import (
    serve_model,
    view_database,
    view_model,
    view_video,
    write_picture,
)

_PROGRAM = "colmap-av1"
_INTERRUPTED = 130
_FAILED_CHECK = 1
_BAD_INPUT = 2
# Rarer reference distances are summed up.
_LEAST_LISTED_SHARE = 0.005

_Options = TypeVar("_Options")
_Rows = list[tuple[str, str]]

# Prefix of the namespace entries that are fields of options.
_OPTION = "option."

# Options under other names than their fields', and COLMAP's prefixes, which are accepted.
_SPELLINGS = {"seed": ("--random_seed",)}
_PREFIXES: dict[type, str] = {CameraOptions: "ImageReader", VerifyOptions: "TwoViewGeometry"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after the program's name; None: those of this process.

    Returns:
        Exit status: 0, 1 where a check fails, 2 for bad input, 130 when interrupted.

    Raises:
        SystemExit: the process is told to end.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _make_parser()
    with _warnings_as_lines(), _ending_in_order():
        try:
            # argparse exits by itself, with status 2 and one line, on words it does not know.
            namespace = parser.parse_args([_underscored(word) for word in words])
            status: int | None = namespace.run(namespace)
        except ColmapAv1Error as error:
            print(f"{_PROGRAM}: error: {error}", file=sys.stderr)
            return _BAD_INPUT
        except KeyboardInterrupt:
            print(f"{_PROGRAM}: interrupted", file=sys.stderr)
            return _INTERRUPTED
    return status or 0


@contextmanager
def _ending_in_order() -> Iterator[None]:
    """Let the signals that end a process unwind it, so that nothing half-written is left."""

    def end(number: int, _: types.FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    names = ("SIGTERM", "SIGHUP")  # some systems have no SIGHUP
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    # What is ignored, as nohup asks for, stays ignored.
    before = {number: signal.getsignal(number) for number in numbers}
    before = {number: old for number, old in before.items() if old == signal.SIG_DFL}
    for number in before:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(_BAD_INPUT, f"{_PROGRAM}: error: {message} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(f"{_PROGRAM} {importlib.metadata.version(_PROGRAM)}")
        parser.exit()


def _make_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog=_PROGRAM,
        description="Dense COLMAP matches read from the motion vectors of an AV1 video.",
        epilog="'-' and '_' are alike in option names.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    command = _add_command(commands, "match", _run_match, "fill a COLMAP database from a video")
    command.add_argument(
        "--database",
        "--database_path",
        required=True,
        metavar="PATH",
        help="COLMAP database; made where it is missing, else its images are used",
    )
    _add_video(command, "a video; one that is not AV1 is converted first")
    command.add_argument(
        "--image_path",
        metavar="PATH",
        help="folder to write the images to; existing ones of the right size are kept",
    )
    _add_options(
        command,
        {
            ImageOptions: "images",
            MatchOptions: "database and stream",
            CameraOptions: "camera",
            TrackOptions: "tracks",
            RefineOptions: "refinement",
            DensityOptions: "density",
            PairOptions: "pairs",
            VerifyOptions: "two-view geometry",
            ReadOptions: "bitstream",
            EncodeOptions: "encoding of a video that is not AV1",
        },
    )
    _add_quiet(command)

    command = _add_command(
        commands, "reconstruct", _run_reconstruct, "make a dense model for 3D Gaussian splatting"
    )
    _add_video(command, "a video; one that is not AV1 is converted first")
    command.add_argument(
        "--output",
        "--output_path",
        required=True,
        metavar="PATH",
        help="folder for images/ and sparse/0/; that of an earlier run is gone on with",
    )
    stages = {
        MapperOptions: "poses",
        TriangulateOptions: "points",
        ImageOptions: "images",
        MatchOptions: "stream",
        CameraOptions: "camera",
        TrackOptions: "tracks",
        RefineOptions: "refinement",
        PairOptions: "pairs",
        VerifyOptions: "two-view geometry",
        ReadOptions: "bitstream",
        EncodeOptions: "encoding of a video that is not AV1",
    }
    _add_options(command, stages, without=("on_existing",))
    _add_quiet(command)

    command = _add_command(
        commands, "densify", _run_densify, "put dense points on the poses of a model that is there"
    )
    command.add_argument(
        "--model", "--model_path", required=True, metavar="PATH", help="folder of a COLMAP model"
    )
    _add_video(command, "the video its images come from")
    command.add_argument(
        "--output", "--output_path", required=True, metavar="PATH", help="new folder for the model"
    )
    command.add_argument(
        "--image_path", metavar="PATH", help="folder of its images, where names leave doubt"
    )
    for kind in (MapperOptions, CameraOptions, PairOptions):
        del stages[kind]
    _add_options(command, stages, without=("on_existing",))
    _add_quiet(command)

    command = _add_command(
        commands, "compare", _run_compare, "compare with SIFT and others on a video, with a report"
    )
    _add_video(command, "a video; one that is not AV1 is converted first")
    command.add_argument(
        "--output",
        "--output_path",
        required=True,
        metavar="PATH",
        help="folder for the report; that of an earlier run is gone on with",
    )
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
    _add_options(
        command,
        {
            CompareOptions: "comparison",
            LearnedOptions: "learned features",
            TriangulateOptions: "points of all tracks",
            ImageOptions: "images",
            MatchOptions: "stream",
            CameraOptions: "camera",
            TrackOptions: "tracks",
            RefineOptions: "refinement",
            PairOptions: "pairs",
            VerifyOptions: "two-view geometry",
            ReadOptions: "bitstream",
            EncodeOptions: "encoding of a video that is not AV1",
        },
        without=("on_existing", "refine", "single_camera"),
    )
    _add_quiet(command)

    command = _add_command(commands, "encode", _run_encode, "convert a video to a good AV1 stream")
    _add_video(command, "a video that ffmpeg decodes")
    command.add_argument(
        "--output",
        "--output_path",
        required=True,
        metavar="PATH",
        help="the stream: .mp4, .mkv, .webm or .ivf",
    )
    command.add_argument("--overwrite", action="store_true", help="replace an output that exists")
    command.add_argument(
        "--strict",
        action="store_true",
        help="fail on a damaged video instead of using the frames before the damage",
    )
    _add_options(command, {EncodeOptions: "encoding"})
    _add_quiet(command)

    command = _add_command(
        commands, "info", _run_info, "tell what a stream is made of and whether it is any good"
    )
    _add_video(command)
    _add_options(command, {ReadOptions: "bitstream"})
    _add_quiet(command)

    command = _add_command(
        commands, "check", _run_check, "tell what COLMAP's mappers will make of a database"
    )
    _add_database(command)
    command.add_argument(
        "--strict",
        action="store_true",
        help="exit with status 1 where something stops the mappers",
    )

    command = _add_command(commands, "motion", _run_motion, "write the motion of every frame")
    _add_video(command)
    command.add_argument(
        "--output", "--output_path", required=True, metavar="PATH", help="a .npz or .h5 file"
    )
    _add_options(command, {ReadOptions: "bitstream"})
    _add_quiet(command)

    command = _add_command(
        commands, "export", _run_export, "write a database's features and matches for hloc"
    )
    _add_database(command)
    command.add_argument(
        "--output", "--output_path", required=True, metavar="PATH", help="folder for the files"
    )
    _add_options(command, {ExportOptions: "files"})
    _add_quiet(command)

    command = _add_command(commands, "view", _run_view, "draw motion, tracks, matches or a model")
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
    _add_options(
        command,
        {ViewOptions: "drawing", TrackOptions: "tracks", ReadOptions: "bitstream"},
    )
    _add_quiet(command)
    return parser


def _add_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int | None], summary: str
) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.", allow_abbrev=False
    )
    command.set_defaults(run=run)
    return command


def _add_database(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--database", "--database_path", required=True, metavar="PATH", help="a COLMAP database"
    )


def _add_video(command: argparse.ArgumentParser, what: str = "an AV1 video") -> None:
    command.add_argument("--video", "--video_path", required=True, metavar="PATH", help=what)


def _add_quiet(command: argparse.ArgumentParser) -> None:
    command.add_argument("--quiet", action="store_true", help="no progress and no summary")


def _underscored(word: str) -> str:
    """The word with '_' for '-' in an option's name; its value stays as it is."""
    if not word.startswith("--") or word == "--":
        return word
    name, equals, value = word[2:].partition("=")
    return f"--{name.replace('-', '_')}{equals}{value}"


def _add_options(
    command: argparse.ArgumentParser, kinds: dict[type, str], *, without: Sequence[str] = ()
) -> None:
    """Add an option for each field of some options dataclasses, in groups of the given titles.

    The field's comment is the help text. Fields that hold further options are left out; a name
    that several kinds have, such as num_threads, is one option for all of them. What is not
    given on the command line does not appear in the namespace.

    Args:
        command: the subcommand.
        kinds: title of each dataclass's group.
        without: fields that the subcommand has no use for.
    """
    added: set[str] = set(without)
    for kind, title in kinds.items():
        group = command.add_argument_group(title)
        hints = typing.get_type_hints(kind)
        comments = _field_comments(kind)
        for field in dataclasses.fields(kind):
            if dataclasses.is_dataclass(field.default) or field.name in added:
                continue
            added.add(field.name)
            names = [*_SPELLINGS.get(field.name, ()), f"--{field.name}"]
            if kind in _PREFIXES:
                names.append(f"--{_PREFIXES[kind]}.{field.name}")
            parse, metavar = _value_parser(hints[field.name])
            default = _spell(field.default)
            how: dict[str, Any] = {"nargs": "?", "const": True} if hints[field.name] is bool else {}
            group.add_argument(
                *names,
                dest=f"{_OPTION}{field.name}",
                type=parse,
                metavar=metavar,
                default=argparse.SUPPRESS,
                help=f"{comments.get(field.name, '')} [{default}]".strip().replace("%", "%%"),
                **how,
            )


def _given(namespace: argparse.Namespace, kind: type[_Options], **more: Any) -> _Options:
    """The options of a kind, with those given on the command line in place of defaults."""
    names = typing.get_type_hints(kind)
    given = {
        k.removeprefix(_OPTION): v for k, v in vars(namespace).items() if k.startswith(_OPTION)
    }
    return kind(**{k: v for k, v in given.items() if k in names}, **more)


def _field_comments(kind: type) -> dict[str, str]:
    """The comment above each field of a class; none where its source is not installed."""
    try:
        lines = inspect.getsource(kind).splitlines()
    except OSError:
        return {}
    comments: dict[str, str] = {}
    comment: list[str] = []
    for line in map(str.strip, lines):
        if line.startswith("#"):
            comment.append(line.lstrip("# "))
            continue
        field = re.match(r"(\w+):", line)
        if field and comment:
            comments[field[1]] = " ".join(comment).replace("None", "none")
        comment = []
    return comments


def _value_parser(hint: Any) -> tuple[Callable[[str], Any], str]:
    """Parser and placeholder for the values of a field's type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        (inner,) = (a for a in arguments if a is not type(None))
        parse, metavar = _value_parser(inner)
        return (lambda word: None if word.lower() == "none" else parse(word)), metavar
    if origin is tuple:
        parse, metavar = _value_parser(arguments[0])
        return (lambda words: tuple(parse(word) for word in words.split(","))), f"{metavar},..."
    if origin is typing.Literal:
        return str, "|".join(arguments)
    if hint is bool:
        return _parse_bool, "0|1"
    return {int: (int, "N"), float: (float, "X"), str: (str, "TEXT")}[hint]


def _parse_bool(word: str) -> bool:
    values = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
    if word.lower() not in values:
        raise argparse.ArgumentTypeError(f"'{word}' is neither 0 nor 1")
    return values[word.lower()]


def _spell(value: Any) -> str:
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return "none" if value is None else str(value)


def _match_options(namespace: argparse.Namespace) -> MatchOptions:
    return _given(
        namespace,
        MatchOptions,
        images=_given(namespace, ImageOptions),
        encode=_given(namespace, EncodeOptions),
        read=_given(namespace, ReadOptions),
        tracks=_given(namespace, TrackOptions),
        refine=_given(namespace, RefineOptions),
        density=_given(namespace, DensityOptions),
        pairs=_given(namespace, PairOptions),
        verify=_given(namespace, VerifyOptions),
        camera=_given(namespace, CameraOptions),
    )


def _run_match(namespace: argparse.Namespace) -> None:
    options = _match_options(namespace)
    with _progress(namespace.quiet) as report:
        result = match(
            namespace.database,
            namespace.video,
            image_path=namespace.image_path,
            options=options,
            progress=report,
        )
    for warning in result.warnings:
        _print_warning(warning)
    if not namespace.quiet:
        _print_summary(_match_rows(result))
        _print_next(result)


def _run_reconstruct(namespace: argparse.Namespace) -> None:
    options = ReconstructOptions(
        match=_match_options(namespace),
        mapping=_given(namespace, MapperOptions),
        triangulate=_given(namespace, TriangulateOptions),
    )
    with _progress(namespace.quiet) as report:
        result = reconstruct(namespace.video, namespace.output, options=options, progress=report)
    for warning in result.warnings:
        _print_warning(warning)
    if not namespace.quiet:
        rows = [
            ("output", str(result.output)),
            ("images", f"{result.num_registered} of {result.num_images} with a pose"),
            ("tracks", f"{result.num_tracks}, {result.num_pose_tracks} for the poses"),
            ("mapper", result.mapper),
            ("points", f"{result.num_points}, {result.num_observations} observations"),
            ("reprojection error", f"{result.mean_error:.3f} px"),
            ("focal length", f"{result.focal_length:.2f} px"),
        ]
        if result.resumed:
            rows.append(("finished before", ", ".join(result.resumed)))
        _print_summary([*rows, *_seconds_rows(result.seconds)])


def _run_densify(namespace: argparse.Namespace) -> None:
    options = DensifyOptions(
        match=_match_options(namespace), triangulate=_given(namespace, TriangulateOptions)
    )
    with _progress(namespace.quiet) as report:
        result = densify(
            namespace.model,
            namespace.video,
            namespace.output,
            image_path=namespace.image_path,
            options=options,
            progress=report,
        )
    for warning in result.warnings:
        _print_warning(warning)
    if not namespace.quiet:
        rows = [
            ("output", str(result.output)),
            ("images", str(result.num_images)),
            ("tracks", f"{result.num_tracks}, {result.agreeing:.1%} agree with the poses"),
            ("points", f"{result.num_points}, the model had {result.num_model_points}"),
            ("reprojection error", f"{result.mean_error:.3f} px"),
        ]
        _print_summary([*rows, *_seconds_rows(result.seconds)])


def _run_compare(namespace: argparse.Namespace) -> None:
    options = _given(
        namespace,
        CompareOptions,
        match=_match_options(namespace),
        learned=_given(namespace, LearnedOptions),
        triangulate=_given(namespace, TriangulateOptions),
    )
    with _progress(namespace.quiet) as report:
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
            _print_warning(f"{column.name}: {column.error}")
    for warning in result.warnings:
        _print_warning(warning)
    if not namespace.quiet:
        rows = []
        for column in result.columns:
            told = "no model"
            if column.model is not None:
                told = (
                    f"{column.model.num_registered} of {result.num_images} images, "
                    f"{column.model.num_points} points, {column.model.mean_error:.3f} px, "
                    f"{sum(column.cpu_seconds.values()):.1f} s of CPU time"
                )
            rows.append((column.name, told))
        _print_summary([*rows, ("report", str(result.output / "report.html"))])


def _seconds_rows(seconds: dict[str, float]) -> _Rows:
    rows = [(f"seconds, {stage}", f"{s:.2f}") for stage, s in seconds.items()]
    return [*rows, ("seconds, total", f"{sum(seconds.values()):.2f}")]


def _run_encode(namespace: argparse.Namespace) -> None:
    with _progress(namespace.quiet) as report:
        result = encode(
            namespace.video,
            namespace.output,
            overwrite=namespace.overwrite,
            strict=namespace.strict,
            options=_given(namespace, EncodeOptions),
            progress=report,
        )
    if not namespace.quiet:
        rows = [("frames", str(result.num_frames)), ("encoder", result.encoder)]
        _print_summary([*rows, ("output", str(result.output))])


def _run_info(namespace: argparse.Namespace) -> None:
    with _progress(namespace.quiet) as report:
        result = inspect_stream(
            namespace.video,
            _given(namespace, ReadOptions),
            lambda done: report("motion", done, None),
        )
    _print_summary(_info_rows(result))


def _run_check(namespace: argparse.Namespace) -> int:
    result = check(namespace.database)
    _print_summary(_check_rows(result))
    return _FAILED_CHECK if namespace.strict and not result.mappable else 0


def _run_motion(namespace: argparse.Namespace) -> None:
    with _progress(namespace.quiet) as report:
        count = export_motion(
            namespace.video,
            namespace.output,
            _given(namespace, ReadOptions),
            lambda done: report("motion", done, None),
        )
    if not namespace.quiet:
        _print_summary([("coded frames", str(count)), ("output", namespace.output)])


def _run_export(namespace: argparse.Namespace) -> None:
    with _progress(namespace.quiet) as report:
        num_images, num_pairs = export_hloc(
            namespace.database, namespace.output, _given(namespace, ExportOptions), report
        )
    if not namespace.quiet:
        _print_summary(
            [
                ("images", str(num_images)),
                ("pairs", str(num_pairs)),
                ("output", namespace.output),
            ]
        )


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
    with _progress(namespace.quiet) as report:
        count = view_video(
            namespace.video,
            namespace.output,
            options=_given(namespace, ViewOptions),
            tracks=_given(namespace, TrackOptions),
            read=_given(namespace, ReadOptions),
            progress=report,
        )
    if not namespace.quiet:
        _print_summary([("frames", str(count)), ("output", namespace.output)])


def _serve(namespace: argparse.Namespace) -> None:
    server = serve_model(namespace.model, port=namespace.port)
    try:
        print(f"http://127.0.0.1:{namespace.port} (end with Ctrl-C)", flush=True)
        threading.Event().wait()
    finally:
        server.stop()


def _match_rows(report: MatchReport) -> _Rows:
    lengths = {f"{q:.0%}": length for q, length in report.track_lengths.items()}
    images = max(report.num_images, 1)
    inlier_share = report.num_inliers / max(report.num_matches, 1)
    rows = [
        ("database", str(report.database)),
        ("stream", str(report.stream)),
        ("frames", f"{report.num_frames} shown, {report.num_coded_frames} coded"),
        ("images", f"{report.num_images}, {report.num_written_images} written"),
        ("tracks", str(report.num_tracks)),
        ("track lengths", ", ".join(f"{q} {length}" for q, length in lengths.items())),
        (
            "keypoints",
            f"{report.num_observations}, {report.num_observations / images:.0f} an image",
        ),
        ("pairs", f"{report.num_pairs}, {report.num_verified_pairs} verified"),
        ("matches", str(report.num_matches)),
        ("inliers", f"{report.num_inliers}, {inlier_share:.1%} of the matches"),
        ("configurations", ", ".join(f"{k} {n}" for k, n in report.configs.items())),
    ]
    if report.forward_motion:
        rows.append(("motion", "forward: the mapper needs the options below, and known intrinsics"))
    return [*rows, *_seconds_rows(report.seconds)]


def _info_rows(report: StreamReport) -> _Rows:
    rate = f"{report.frame_rate:.2f} per second" if report.frame_rate else "unknown"
    distances = sorted(report.reference_distances.items(), key=lambda item: -item[1])
    listed = [item for item in distances if item[1] >= _LEAST_LISTED_SHARE]
    references = [f"{distance:+d} {share:.1%}" for distance, share in listed]
    if len(listed) < len(distances):
        rest = sum(share for _, share in distances[len(listed) :])
        references.append(f"others {rest:.1%}")
    if report.hidden_reference_share > 0:
        references.append(f"hidden {report.hidden_reference_share:.1%}")
    frames = (
        f"{report.num_shown} shown, {report.num_coded} coded, {report.num_hidden} never shown, "
        f"{report.num_key_frames} intra"
    )
    if report.num_cut:
        frames += f", {report.num_cut} hidden by an edit list"
    display = report.display
    cropped = any(display.crop)
    return [
        ("video", str(report.path)),
        ("container", report.container),
        ("codec", "av1"),
        ("size", f"{report.width}x{report.height}"),
        ("rotation", f"{display.rotation}{', upside down' if display.is_mirrored else ''}"),
        *([("cropped", "{} left, {} top, {} right, {} bottom".format(*display.crop))] * cropped),
        *([("pixel aspect", f"{display.pixel_aspect:.3f}")] * (display.pixel_aspect != 1)),
        ("frame rate", rate),
        ("frames", frames),
        ("references", ", ".join(references) or "none"),
        ("inter units", f"{report.inter_share:.1%}"),
        ("median motion", f"{report.median_motion:.2f} px per frame"),
        ("bytes per frame", f"{report.bytes_per_frame:.0f}"),
        ("bits per pixel", f"{report.bits_per_pixel:.3f}"),
        ("for matching", "; ".join(report.reasons) or "good"),
    ]


def _check_rows(report: CheckReport) -> _Rows:
    sizes = [f"{w}x{h} {n}" for (w, h), n in report.image_sizes.items()]
    shapes = [f"{n} with {c} columns" for c, n in report.keypoint_columns.items()]
    share = report.num_matched_keypoints / max(report.num_keypoints, 1)
    rows = [
        ("database", str(report.database)),
        ("layout", f"COLMAP {report.layout} (version {report.user_version})"),
        ("opened by", f"COLMAP {report.readers}"),
        ("images", f"{report.num_images}, {report.num_connected_images} connected"),
        ("sizes", ", ".join(sizes) or "none"),
        ("cameras", f"{report.num_cameras}, {report.num_priors} with a known focal length"),
        ("keypoints", f"{report.num_keypoints}, {share:.1%} matched"),
        ("keypoint rows", ", ".join(shapes) or "none"),
        ("descriptors", f"of {report.num_described_images} images"),
        (
            "pairs",
            f"{report.num_pairs} with inliers, {report.num_used_pairs} used, "
            f"{report.num_empty_pairs} empty",
        ),
        ("inliers", str(report.num_inliers)),
        ("configurations", ", ".join(f"{k} {n}" for k, n in report.configs.items()) or "none"),
    ]
    if report.parallax is not None:
        wide = report.parallax
        how = "" if wide.focal_known else " for a guessed focal length"
        angle = "unknown" if wide.angle is None else f"{wide.angle:.1f} degrees{how}"
        pair = f"widest pair {wide.displacement:.0f} px ({' - '.join(wide.names)})"
        rows.append(("parallax", f"{angle}, {pair}"))
    rows += [(finding.severity, finding.text) for finding in report.findings]
    rows.append(("for mapping", "good" if report.mappable else "not ready"))
    return rows


def _print_summary(rows: _Rows) -> None:
    """A table on a terminal; elsewhere one line each, name and value parted by a tab."""
    if not sys.stdout.isatty():
        for name, value in rows:
            print(f"{name}\t{value}")
        return
    table = Table(show_header=False)
    for name, value in rows:
        table.add_row(name, value)
    Console().print(table)


def _print_next(report: MatchReport) -> None:
    with_colmap, with_pycolmap = report.next_commands
    if sys.stdout.isatty():
        # Printed bare, so that they can be copied from any terminal.
        print(f"Map it with COLMAP:\n  {with_colmap}\nor with pycolmap:\n  {with_pycolmap}")
    else:
        print(f"next\t{with_colmap}\nor\t{with_pycolmap}")
    if report.image_path is None:
        print(f"{_PROGRAM}: IMAGES stands for a folder of the frames", file=sys.stderr)


def _print_warning(message: object) -> None:
    print(f"{_PROGRAM}: warning: {message}", file=sys.stderr)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: _print_warning(message)
        yield


@contextmanager
def _progress(quiet: bool) -> Iterator[Progress]:
    """Progress bars on standard error where it is a terminal, one for each stage."""
    if quiet or not sys.stderr.isatty():
        yield no_progress
        return
    columns = (
        TextColumn("{task.description:12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with ProgressBars(*columns, console=Console(stderr=True)) as progress:
        tasks: dict[str, Any] = {}

        def report(stage: str, done: int, total: int | None) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, rate="")
            speed = progress.tasks[tasks[stage]].speed
            rate = f"{speed:.1f}/s" if speed else ""
            progress.update(tasks[stage], completed=done, rate=rate)

        yield report
