"""Measure tracks and the models mapped from them, beside SIFT's, on sequences with known poses.

python examples/benchmarks/tracks.py --cache benchmark_tracks

Each sequence is encoded once as AV1 and its frames are written as images; every front-end gets
these. What is measured stays in the cache: a run that was stopped goes on where it was, and only
what has changed is measured again. The rendered clip is always there, the sequences lie in
../shared.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray
from rich.console import Console

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    DensifyOptions,
    MapOptions,
    MatchOptions,
    RefineOptions,
    Tracks,
)
from colmap_av1.evaluate import (
    FRONTENDS,
    SPANS,
    Footage,
    FrontendRun,
    MapperRun,
    ModelFigures,
    PoseErrors,
    TrackStatistics,
    database_tracks,
    densify_model,
    epipolar_errors,
    exact_errors,
    measure_mapper,
    model_figures,
    model_poses,
    pose_errors,
    prepare_footage,
    read_sequence,
    run_frontend,
    track_statistics,
)
from colmap_av1.model.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in

EXAMPLES = Path(__file__).resolve().parents[1]
SEQUENCES = EXAMPLES.parents[1] / "shared" / "sequences"
REFERENCE = "sift-exhaustive"
# Given the pictures the video was made of, not those decoded from it.
FROM_SOURCE = {
    "sift-sequential-source": "sift-sequential",
    "sift-exhaustive-source": "sift-exhaustive",
}
# Where few and sure tracks give the poses, all are triangulated on them.
ALL_TRACKS = {
    "av1-sparse": DensifyOptions(),
    "av1-refined-sparse": DensifyOptions(match=MatchOptions(refine=RefineOptions(refine="lk"))),
}
ENCODING = (
    "-c:v libaom-av1 -usage realtime -cpu-used 6 -lag-in-frames 0 -row-mt 1 -crf 20 -b:v 0 -g 9999 "
    "-pix_fmt yuv420p -an"
)

Poses = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A sequence and how it is used; `image_step` as `every` in ImageOptions."""

    name: str
    image_step: int = 1
    forward_motion: bool = False


CASES = (
    Case("scene"),
    Case("street", forward_motion=True),
    Case("shelfbox"),
    Case("kitchen", image_step=2),
    Case("log_building"),
    Case("ditch"),
)


@dataclass(frozen=True)
class Material:
    """What a case is measured on.

    `transfer` is the rendered clip's exact truth; `source` are ffmpeg's words for the pictures the
    video was made of, where these are not rendered.
    """

    video: Path
    num_frames: int
    camera: Any | None
    poses: Poses | None
    transfer: Callable[..., Any] | None = None
    source: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Truth:
    """What is measured against: of the epipolar error and of the poses; and what that is."""

    geometry: tuple[Poses, Any] | None
    poses: Poses | None
    about: str


@dataclass(frozen=True)
class Row:
    """Figures of one front-end; what could not be measured is None."""

    frontend: str
    run: FrontendRun
    statistics: TrackStatistics
    epipolar: dict[int, float] | None
    exact: dict[int, tuple[float, float]] | None
    mapper: MapperRun | None
    model: ModelFigures | None
    pose_errors: PoseErrors | None
    poses_are_true: bool
    dense: tuple[MapperRun, ModelFigures] | None


def main() -> int:
    """Measure every front-end on every sequence and print the tables."""
    names = [case.name for case in CASES]
    parser = argparse.ArgumentParser(
        description="Measure tracks and the models mapped from them, beside SIFT's.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--cache", type=Path, help="folder that keeps all results; without, a temporary one"
    )
    parser.add_argument(
        "--sequences",
        nargs="+",
        choices=names,
        default=names,
        metavar="NAME",
        help=f"of {', '.join(names)}",
    )
    parser.add_argument(
        "--frontends",
        nargs="+",
        choices=[*FRONTENDS, *FROM_SOURCE],
        default=[name for name in FRONTENDS if not name.endswith("-dense")],
        metavar="NAME",
        help=f"of {', '.join([*FRONTENDS, *FROM_SOURCE])}",
    )
    parser.add_argument(
        "--camera_model",
        help="COLMAP's camera model where the intrinsics are unknown; without, SIMPLE_RADIAL, "
        "and RADIAL where match tells the focal length",
    )
    parser.add_argument("--no_mapping", action="store_true", help="measure only the tracks")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    failed = False
    with ExitStack() as stack:
        cache = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in CASES:
            if case.name not in arguments.sequences:
                continue
            if case.name != "scene" and not (SEQUENCES / case.name).is_dir():
                console.print(f"{case.name}: not measured, {SEQUENCES / case.name} is absent")
                continue
            try:
                rows, about = measure_case(case, cache / case.name, arguments, console)
            except ColmapAv1Error as error:
                console.print(f"error: {case.name}: {error}", markup=False)
                failed = True
                continue
            print(f"### {case.name}\n\n{about}\n")
            print(tracks_table(rows))
            if not arguments.no_mapping:
                print(models_table(rows))
            sys.stdout.flush()
            failed |= len(rows) < len(arguments.frontends)
    return 1 if failed else 0


def measure_case(
    case: Case, folder: Path, arguments: argparse.Namespace, console: Console
) -> tuple[list[Row], str]:
    """Rows of one sequence, and a line on what they are measured against."""
    mapping = not arguments.no_mapping
    folder.mkdir(parents=True, exist_ok=True)
    material = rendered_clip() if case.name == "scene" else real_sequence(case, folder, console)
    intrinsics = CameraOptions(camera_model=arguments.camera_model)
    if material.camera is not None:
        camera = material.camera
        params = ",".join(map(str, camera.params))
        intrinsics = CameraOptions(camera_model=camera.model.name, camera_params=params)
    footage = prepare_footage(
        material.video,
        folder / "footage",
        num_frames=material.num_frames,
        image_step=case.image_step,
        camera=intrinsics,
    )
    settings = MapOptions(
        refine_intrinsics=material.camera is None, forward_motion=case.forward_motion
    )
    truth = known_truth(material)
    if mapping and truth.geometry is None:
        model = reference_model(footage, folder, settings, console)
        truth = with_reference(truth, model, material.num_frames)
    rows = []
    for name in arguments.frontends:
        console.print(f"{case.name}: {name}", markup=False)
        if name in FROM_SOURCE and material.source is None:
            continue
        try:
            given = (
                footage if name not in FROM_SOURCE else source_footage(footage, material, folder)
            )
            run = run_frontend(FROM_SOURCE.get(name, name), given, folder / name)
            run = replace(run, name=name)
            mapper = dense = None
            if mapping:
                where = folder / f"{name}-model"
                mapper = measure_mapper(run.database, given.image_path, where, settings)
                if mapper.model is not None and name in ALL_TRACKS:
                    where = folder / f"{name}-all-tracks"
                    made = densify_model(mapper.model, footage, where, ALL_TRACKS[name])
                    assert made.model is not None
                    dense = made, model_figures(made.model)
        except ColmapAv1Error as error:
            console.print(f"error: {case.name}: {name}: {error}", markup=False)
            continue
        row = measure_row(run, mapper, footage, material, truth)
        rows.append(replace(row, dense=dense))
    scale = "intrinsics known and kept" if material.camera is not None else "intrinsics unknown"
    about = f"{len(footage.frames)} images of {material.num_frames} frames; {scale}; {truth.about}."
    return rows, about


def load_render_scene() -> Any:
    """The script that rendered the example clip, as a module."""
    spec = importlib.util.spec_from_file_location("render_scene", EXAMPLES / "render_scene.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["render_scene"] = module
    spec.loader.exec_module(module)
    return module


def rendered_clip() -> Material:
    """The example clip with its exact truth."""
    render_scene = load_render_scene()
    scene = render_scene.build_scene()
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=scene.width,
        height=scene.height,
        params=[scene.fx, scene.fy, scene.cx, scene.cy],
    )
    return Material(
        video=EXAMPLES / "scene.mp4",
        num_frames=len(scene.cam_from_world),
        camera=camera,
        poses=scene.cam_from_world,
        transfer=functools.partial(render_scene.transfer, scene),
    )


def real_sequence(case: Case, folder: Path, console: Console) -> Material:
    """A sequence of ../shared, encoded as AV1."""
    sequence = read_sequence(SEQUENCES / case.name)
    source = sequence.source
    words: tuple[str, ...] = ("-i", str(source))
    if source.is_dir():
        first = min(source.iterdir())
        pattern = source / f"%0{len(first.stem)}d{first.suffix}"
        words = ("-framerate", str(sequence.fps), "-i", str(pattern))
    video = folder / "video" / "video.mp4"

    def encode() -> dict[str, Any]:
        console.print(f"{case.name}: encoding", markup=False)
        ffmpeg(*words, *ENCODING.split(), str(video))
        return {"bytes": video.stat().st_size}

    pictures = sorted(source.iterdir()) if source.is_dir() else [source]
    given = (words, ENCODING, [file_digest(p) for p in pictures])
    run_stage_in(video.parent, given, encode, products=[video], made_by=())
    return Material(
        video, sequence.num_frames, sequence.camera, sequence.cam_from_world, source=words
    )


def source_footage(footage: Footage, material: Material, folder: Path) -> Footage:
    """The same footage with the pictures the video was made of."""
    assert material.source is not None
    words = material.source
    images = folder / "source" / "images"

    def make() -> dict[str, Any]:
        images.mkdir()
        ffmpeg(*words, "-start_number", "0", str(images / "frame_%06d.png"))
        return {}

    given = (words, file_digest(footage.video))
    run_stage_in(images.parent, given, make, products=[images], made_by=())
    return replace(footage, image_path=images)


def ffmpeg(*words: str) -> None:
    """Run ffmpeg."""
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *words], check=True)


def known_truth(material: Material) -> Truth:
    """What is truly known of the cameras."""
    if material.poses is None:
        return Truth(None, None, "no poses known")
    if material.camera is None:
        return Truth(None, material.poses, "true poses, no epipolar error")
    return Truth((material.poses, material.camera), material.poses, "true poses")


def with_reference(truth: Truth, model: Any, num_frames: int) -> Truth:
    """The same, with the reference's model for what is not known."""
    poses = model_poses(model, num_frames)
    geometry = (poses, next(iter(model.cameras.values())))
    if truth.poses is None:
        return Truth(geometry, poses, f"errors against {REFERENCE}'s model")
    return Truth(geometry, truth.poses, f"true poses; epipolar error against {REFERENCE}'s model")


def reference_model(footage: Footage, folder: Path, settings: MapOptions, console: Console) -> Any:
    """The model that stands for the truth where that is not known."""
    console.print(f"{folder.name}: {REFERENCE} as the reference", markup=False)
    run = run_frontend(REFERENCE, footage, folder / REFERENCE)
    where = folder / f"{REFERENCE}-model"
    mapper = measure_mapper(run.database, footage.image_path, where, settings)
    if mapper.model is None:
        raise ColmapAv1Error(f"{REFERENCE} makes no model, so there is no reference: see {where}")
    return read_model(mapper.model)


def measure_row(
    run: FrontendRun,
    mapper: MapperRun | None,
    footage: Footage,
    material: Material,
    truth: Truth,
) -> Row:
    """Figures of a filled database and, where it was mapped, of its model."""
    tracks = database_tracks(run.database, material.num_frames)
    epipolar = None
    if truth.geometry is not None:
        epipolar = {s: median(epipolar_errors(tracks, *truth.geometry, s)) for s in SPANS}
    model = figures = errors = None
    if mapper is not None and mapper.model is not None:
        model = read_model(mapper.model)
        figures = model_figures(model)
        if truth.poses is not None:
            errors = pose_errors(model_poses(model, material.num_frames), truth.poses)
    return Row(
        frontend=run.name,
        run=run,
        statistics=track_statistics(tracks, np.array(footage.frames)),
        epipolar=epipolar,
        exact=exact_by_span(tracks, material.transfer),
        mapper=mapper,
        model=figures,
        pose_errors=errors,
        poses_are_true=material.poses is not None,
        dense=None,
    )


def exact_by_span(
    tracks: Tracks, transfer: Callable[..., Any] | None
) -> dict[int, tuple[float, float]] | None:
    """Median and 90th percentile in pixels of the exact error; None without exact truth."""
    if transfer is None:
        return None
    by_span = {}
    for span in SPANS:
        distance = np.linalg.norm(exact_errors(tracks, transfer, span), axis=1)
        by_span[span] = (median(distance), quantile(distance, 0.9))
    return by_span


def median(values: NDArray[np.float64]) -> float:
    """The median; NaN where there is nothing."""
    return quantile(values, 0.5)


def quantile(values: NDArray[np.float64], share: float) -> float:
    """A quantile; NaN where there is nothing."""
    return float(np.quantile(values, share)) if len(values) else float("nan")


def tracks_table(rows: Sequence[Row]) -> str:
    """Markdown table of the tracks."""
    spans = " / ".join(map(str, SPANS))
    header = ["tracks", "tracks", *(f"of {c}" for c in length_classes(rows)), "keypoints an image"]
    header += ["covered (least)", f"epipolar px at {spans} frames"]
    exact = any(row.exact for row in rows)
    if exact:
        header += [f"exact px at {spans} frames: median", "90 %"]
    body = []
    for row in rows:
        s = row.statistics
        cells = [row.frontend, f"{s.num_tracks:,}"]
        cells += [f"{n:,}" for n in s.tracks_by_length.values()]
        cells.append(f"{s.observations_per_image[0]:,.0f}")
        cells.append(f"{s.coverage[0]:.0%} ({s.coverage[1]:.0%})")
        cells.append(by_span(row.epipolar))
        if exact and row.exact:
            cells.append(by_span({span: e[0] for span, e in row.exact.items()}))
            cells.append(by_span({span: e[1] for span, e in row.exact.items()}))
        body.append(cells)
    return markdown(header, body)


def models_table(rows: Sequence[Row]) -> str:
    """Markdown table of the models and of what they take, beside the reference's."""
    header = ["models", "images", "ATE (share of extent)", "rotation", "error px mean / median"]
    header += ["points", "all tracks: points", "their error px"]
    header += ["front-end CPU s (wall)", "memory", "mapper CPU s (wall)", "all tracks CPU s (wall)"]
    reference = next((row for row in rows if row.frontend == REFERENCE), None)
    base_points = reference.model.num_points if reference and reference.model else None
    base_cpu = reference.run.cpu_seconds if reference else None
    body = []
    for row in rows:
        memory = row.run.peak_memory
        cost = [
            f"{took(row.run.cpu_seconds, row.run.seconds)}{share(row.run.cpu_seconds, base_cpu)}",
            f"{memory / 2**20:.0f} MB" if memory is not None else "-",
            took(row.mapper.cpu_seconds, row.mapper.seconds) if row.mapper else "-",
        ]
        if row.model is None:
            body.append([row.frontend, "no model", *["-"] * 6, *cost, "-"])
            continue
        model, errors, dense = row.model, row.pose_errors, row.dense
        cells = [row.frontend, f"{model.num_registered} of {row.statistics.num_images}"]
        if errors is None or (row is reference and not row.poses_are_true):
            cells += ["-", "-"]
        else:
            cells.append(f"{errors.ate:.4f} ({errors.ate / errors.extent:.2%})")
            cells.append(f"{errors.rotation:.3f}°")
        cells.append(f"{model.mean_error:.3f} / {model.median_error:.3f}")
        cells.append(f"{model.num_points:,}{times(model.num_points, base_points)}")
        if dense is None:
            body.append([*cells, "-", "-", *cost, "-"])
            continue
        made, figures = dense
        cells.append(f"{figures.num_points:,}{times(figures.num_points, base_points)}")
        cells.append(f"{figures.mean_error:.3f} / {figures.median_error:.3f}")
        cost.append(took(made.cpu_seconds, made.seconds))
        body.append([*cells, *cost])
    return markdown(header, body)


def took(cpu_seconds: float, seconds: float | dict[str, float]) -> str:
    """CPU time and, behind it, wall time."""
    wall = sum(seconds.values()) if isinstance(seconds, dict) else seconds
    return f"{cpu_seconds:.1f} ({wall:.1f})"


def share(value: float, base: float | None) -> str:
    """What part of the reference's this is."""
    return f", {value / base:.1%}" if base else ""


def times(value: int, base: int | None) -> str:
    """How many times the reference's this is."""
    return f", {value / base:.1f}x" if base else ""


def length_classes(rows: Sequence[Row]) -> list[str]:
    """Names of the classes of track length."""
    lows = list(rows[0].statistics.tracks_by_length) if rows else []
    tops = [str(high - 1) for high in lows[1:]]
    return [f"{low}-{top}" for low, top in zip(lows, tops, strict=False)] + [f"{lows[-1]}+"] * bool(
        lows
    )


def by_span(values: dict[int, float] | None) -> str:
    """Pixels by span in one cell."""
    if values is None:
        return "-"
    return " / ".join("-" if np.isnan(v) else f"{v:.2f}" for v in values.values())


def markdown(header: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all but the first column to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    sys.exit(main())
