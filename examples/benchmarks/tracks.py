"""Measure tracks and their models on sequences with known poses, compared with SIFT.

python examples/benchmarks/tracks.py --cache benchmark_tracks

Each sequence is encoded once as AV1, and its frames are written as images for all front-ends.
Results stay in the cache: an interrupted run resumes, and only changed front-ends are measured
again. The rendered clip is always measured; the other sequences are in ../shared.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import render
from clips import (
    CASES,
    REFERENCE,
    SEQUENCES,
    Case,
    Material,
    Truth,
    ffmpeg,
    footage_of,
    is_there,
    known_truth,
    mapper_options,
    material_of,
    median,
    quantile,
    reference_model,
    with_reference,
)
from results import Value, add_results, read_rows, save
from rich.console import Console
from sequences import FRONTENDS, measure_frontend, model_poses
from track_metrics import (
    TrackStatistics,
    database_tracks,
    epipolar_errors,
    exact_errors,
    track_statistics,
)

from colmap_av1 import (
    CameraOptions,
    ColmapAv1Error,
    DensifyOptions,
    MatchOptions,
    RefineOptions,
    Tracks,
)
from colmap_av1.evaluate import (
    Footage,
    FrontendRun,
    MapperRun,
    ModelFigures,
    PoseErrors,
    densify_model,
    measure_mapper,
    model_figures,
    pose_errors,
)
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in

# Front-ends that get the original pictures, not those decoded from the AV1 video.
FROM_SOURCE = {
    "sift-sequential-source": "sift-sequential",
    "sift-exhaustive-source": "sift-exhaustive",
}
# Front-ends with few, accurate tracks for the poses, on which all tracks are triangulated.
ALL_TRACKS = {
    "av1-sparse": DensifyOptions(),
    "av1-refined-sparse": DensifyOptions(match=MatchOptions(refine=RefineOptions(refine="lk"))),
}


@dataclass(frozen=True)
class Row:
    """Figures of one front-end; None if not measured."""

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
    """Measure every front-end on every sequence, and print the tables."""
    names = [case.name for case in CASES]
    parser = argparse.ArgumentParser(
        description="Measure tracks and their models, compared with SIFT.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--cache", type=Path, help="folder that keeps all results [a temporary one]"
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
        help="COLMAP's camera model for unknown intrinsics [SIMPLE_RADIAL, or RADIAL if match "
        "estimates the focal length]",
    )
    parser.add_argument("--no_mapping", action="store_true", help="measure only the tracks")
    add_results(parser, "tracks")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    failed = False
    with ExitStack() as stack:
        cache = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in CASES:
            if case.name not in arguments.sequences:
                continue
            if not is_there(case.name):
                console.print(f"{case.name}: not measured, {SEQUENCES / case.name} is absent")
                continue
            try:
                rows = measure_case(case, cache / case.name, arguments, console)
            except ColmapAv1Error as error:
                console.print(f"error: {case.name}: {error}", markup=False)
                failed = True
                continue
            save(arguments.results, rows, ("sequence", "frontend"))
            failed |= len(rows) < len(arguments.frontends)
            if rows:
                table = render.tracks(read_rows(arguments.results), case.name)
                print(f"### {case.name}\n\n{table}", flush=True)
    return 1 if failed else 0


def measure_case(
    case: Case, folder: Path, arguments: argparse.Namespace, console: Console
) -> list[dict[str, Value]]:
    """Figures of one sequence, one row for each front-end."""
    mapping = not arguments.no_mapping
    material = material_of(case, folder, console)
    unknown = CameraOptions(camera_model=arguments.camera_model)
    camera = unknown if material.camera is None else material.intrinsics
    footage = footage_of(case, material, folder, camera)
    settings = mapper_options(case, material)
    truth = known_truth(material)
    if mapping and truth.geometry is None:
        model = reference_model(footage, folder, settings, console)
        truth = with_reference(truth, model, material.num_frames)
    rows: list[dict[str, Value]] = []
    for name in arguments.frontends:
        console.print(f"{case.name}: {name}", markup=False)
        if name in FROM_SOURCE and material.source is None:
            continue
        try:
            given = (
                footage if name not in FROM_SOURCE else source_footage(footage, material, folder)
            )
            run = measure_frontend(FROM_SOURCE.get(name, name), given, folder / name)
            mapper = dense = None
            if mapping:
                where = folder / f"{name}-model"
                mapper = measure_mapper(run.database, given.image_path, where, settings)
                if mapper.model is not None and name in ALL_TRACKS:
                    where = folder / f"{name}-all-tracks"
                    made = densify_model(mapper.model, footage, where, ALL_TRACKS[name])
                    assert made.model is not None
                    dense = made, model_figures(read_model(made.model))
        except ColmapAv1Error as error:
            console.print(f"error: {case.name}: {name}: {error}", markup=False)
            continue
        row = replace(measure_row(run, mapper, footage, material, truth), dense=dense)
        about: dict[str, Value] = {
            "sequence": case.name,
            "frontend": name,
            "num_frames": material.num_frames,
            "num_images": len(footage.frames),
            "intrinsics": "unknown" if material.camera is None else "known and kept",
            "measured_against": truth.about,
        }
        rows.append({**about, **track_figures(row), **model_figures_of(row, name)})
    return rows


def source_footage(footage: Footage, material: Material, folder: Path) -> Footage:
    """The same footage with the original pictures."""
    assert material.source is not None
    words = material.source
    images = folder / "source" / "images"

    def make() -> None:
        images.mkdir()
        ffmpeg(*words, "-start_number", "0", str(images / "frame_%06d.png"))

    given = (words, file_digest(footage.video))
    run_stage_in(images.parent, given, None, make, products=[images], made_by=())
    return replace(footage, image_path=images)


def measure_row(
    run: FrontendRun,
    mapper: MapperRun | None,
    footage: Footage,
    material: Material,
    truth: Truth,
) -> Row:
    """Figures of a filled database and, if it was mapped, of its model."""
    tracks = database_tracks(run.database, material.num_frames)
    epipolar = None
    if truth.geometry is not None:
        epipolar = {s: median(epipolar_errors(tracks, *truth.geometry, s)) for s in render.SPANS}
    model = figures = errors = None
    if mapper is not None and mapper.model is not None:
        model = read_model(mapper.model)
        figures = model_figures(model)
        if truth.poses is not None:
            errors = pose_errors(model_poses(model, material.num_frames), truth.poses)
    return Row(
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
    """Median and 90th percentile in pixels of the exact error; None without exact ground truth."""
    if transfer is None:
        return None
    by_span = {}
    for span in render.SPANS:
        distance = np.linalg.norm(exact_errors(tracks, transfer, span), axis=1)
        by_span[span] = (median(distance), quantile(distance, 0.9))
    return by_span


def track_figures(row: Row) -> dict[str, Value]:
    """The figures of tracks, with the column names of `results/tracks.csv`."""
    about = row.statistics
    figures: dict[str, Value] = {"tracks": about.num_tracks}
    for length, count in zip(render.LENGTHS, about.tracks_by_length.values(), strict=True):
        figures[f"tracks_{length}"] = count
    figures["keypoints_per_image"] = about.observations_per_image[0]
    figures["covered"], figures["least_covered"] = about.coverage
    for span, error in (row.epipolar or {}).items():
        figures[f"epipolar_px_{span}"] = error
    for span, (middle, most) in (row.exact or {}).items():
        figures[f"exact_px_{span}"] = middle
        figures[f"exact_px_of_90_{span}"] = most
    return figures


def model_figures_of(row: Row, name: str) -> dict[str, Value]:
    """Figures and cost of the model, with the column names of `results/tracks.csv`."""
    memory = row.run.peak_memory
    figures: dict[str, Value] = {
        "frontend_cpu_s": row.run.cpu_seconds,
        "frontend_s": sum(row.run.seconds.values()),
        "peak_memory_mb": memory / 2**20 if memory is not None else None,
    }
    if row.mapper is not None:
        figures["mapper_cpu_s"], figures["mapper_s"] = row.mapper.cpu_seconds, row.mapper.seconds
        figures["registered"] = row.model.num_registered if row.model is not None else 0
    if row.model is not None:
        figures["points"] = row.model.num_points
        figures["error_px_mean"] = row.model.mean_error
        figures["error_px_median"] = row.model.median_error
    # Omit the errors of the reference against itself.
    if row.pose_errors is not None and (name != REFERENCE or row.poses_are_true):
        figures["ate"] = row.pose_errors.ate
        figures["ate_of_extent"] = row.pose_errors.ate / row.pose_errors.extent
        figures["rotation_deg"] = row.pose_errors.rotation
    if row.dense is not None:
        made, dense = row.dense
        figures["all_tracks_points"] = dense.num_points
        figures["all_tracks_error_px_mean"] = dense.mean_error
        figures["all_tracks_error_px_median"] = dense.median_error
        figures["all_tracks_cpu_s"], figures["all_tracks_s"] = made.cpu_seconds, made.seconds
    return figures


if __name__ == "__main__":
    sys.exit(main())
