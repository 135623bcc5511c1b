"""Comparison of front-ends on one video: point clouds, poses and costs, in a report."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.check.model_figures import model_figures
from colmap_av1.errors import ColmapAv1Error, ImageError, ModelError, OptionError
from colmap_av1.evaluate.frontends.footage import Conversion, Footage, choose_footage, convert
from colmap_av1.evaluate.frontends.frontend import Frontend, run_frontend
from colmap_av1.evaluate.frontends.imported import imported_frontend
from colmap_av1.evaluate.frontends.mapping import densify_model, measure_mapper
from colmap_av1.evaluate.frontends.registry import make_frontends
from colmap_av1.evaluate.metrics.clouds import cloud_distances
from colmap_av1.evaluate.metrics.poses import fit_similarity, image_poses, pose_errors, read_poses
from colmap_av1.evaluate.programs import check_packages
from colmap_av1.evaluate.report.results import (
    ALL_TRACKS,
    BASELINES,
    Cloud,
    Column,
    CompareReport,
)
from colmap_av1.evaluate.training.trainers import check_trainer, train, write_split
from colmap_av1.geometry.alignment import transform_poses
from colmap_av1.geometry.colmap_model import point_colours, point_positions, read_model
from colmap_av1.geometry.observable import has_observable_depth
from colmap_av1.options import CompareOptions, DensifyOptions, MapOptions
from colmap_av1.tracks.video_tracks import with_stream_kept
from colmap_av1.util.arrays import Floats
from colmap_av1.util.files import check_apart
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.stages import open_stages, writing_stages
from colmap_av1.video.facts import read_video
from colmap_av1.video.metadata.spherical import check_is_plane

# If only poses are given, the cloud of the first baseline is the reference cloud whose ATE is at
# most this share of the path's extent.
_LARGEST_ATE = 0.02
_OWN = "av1"
# Folder in the output for the results of the front-ends.
_FRONTENDS = "frontends"


@dataclass(frozen=True)
class _Reference:
    """The poses and the cloud that models are compared with.

    Attributes:
        poses: float64 [num_images, 3, 4], NaN where unknown; None if all are unknown.
        points: float64 [n, 3] in the same coordinates; None without a cloud.
        pose_source: path or front-end that the poses come from.
        cloud_source: path or front-end that the points come from.
        is_truth: whether the poses are a given truth.
    """

    poses: Floats | None = None
    points: Floats | None = None
    pose_source: str = ""
    cloud_source: str = ""
    is_truth: bool = False


def compare(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    image_path: str | os.PathLike[str] | None = None,
    reference: str | os.PathLike[str] | None = None,
    options: CompareOptions = CompareOptions(),
    progress: Progress = no_progress,
) -> CompareReport:
    """Compare this package's matches with those of other front-ends on one video.

    Every front-end gets the same images and fills a database, with the given camera model and
    parameters if there are any. COLMAP's incremental mapper maps each database with the same
    settings, and the models are measured. The default camera model is SIMPLE_RADIAL, or RADIAL if
    this package estimates the focal length from the tracks.

    The folder gets `report.html` and `results.json`, and keeps the results of every stage: another
    run repeats only stages whose results are missing or damaged, or whose inputs have changed. The
    report states the error of a front-end that fails; the others are not affected.

    Args:
        video: a video. A video that is not AV1 is first converted to a stream in the folder, or at
            `options.match.keep_stream`.
        output: the folder; new, empty, or from an earlier run.
        image_path: folder of existing images, or to write images to; None: within the output.
        reference: ground truth: folder of a COLMAP model with images of the same names, or a
            file of poses, see `read_poses`. None: the model of "sift-exhaustive", if it is
            compared.
        options: options of every stage.
        progress: called with a stage's name, the amount of work done, and the total if known.

    Raises:
        VideoError: the video cannot be read.
        BitstreamError: the stream is damaged, and `strict` is set or the damage is before the
            second frame.
        ImageError: images cannot be chosen, or do not match the reference.
        ModelError: the reference is not a readable model, or has poses of fewer than 3 images.
        WriteError: the output cannot be written.
        OptionError: a front-end is unknown, or the folder has other content.
        EvaluationError: a package is missing that the report, a front-end or the trainer needs.

    Examples:
        >>> from colmap_av1 import CompareOptions, ImageOptions, MatchOptions, compare
        >>> match = MatchOptions(images=ImageOptions(every=6))
        >>> options = CompareOptions(match=match, frontends=("av1",), all_tracks=False)
        >>> report = compare("video.mp4", "my_comparison", options=options)
        >>> report.columns[0].name, report.columns[0].model.num_registered
        ('av1', 10)
    """
    output = Path(output)
    write_report = _report_writer()
    # Front-ends run in separate processes: keep the converted stream, so that they share it.
    options = replace(options, match=with_stream_kept(options.match, output))
    frontends = _chosen_frontends(options)
    if options.trainer is not None:
        check_trainer(options.trainer)
    files = [file for frontend in frontends.values() for file in frontend.files]
    check_apart(output, [video, image_path, options.match.images.frame_list, *files])
    _check_reference(output, reference)
    video = read_video(video, options.match.read.operating_point)
    check_is_plane(video.path, video.projection, video.picture_size[0])
    with open_stages(output, "compare"), writing_stages(output):
        conversion = convert(video, output / "conversion", options.match, progress)
        footage = choose_footage(
            video,
            output / "footage",
            options=options.match,
            image_path=Path(image_path) if image_path is not None else None,
            progress=progress,
        )
        given = _read_reference(Path(reference), footage) if reference is not None else None
        settings = MapOptions(
            refine_intrinsics=footage.camera.camera_params is None,
            forward_motion=footage.forward_motion,
        )
        columns: list[Column] = []
        for name, frontend in frontends.items():
            columns += _run_column(
                name,
                frontend,
                footage,
                output / _FRONTENDS / name,
                conversion=conversion,
                settings=settings,
                options=options,
                progress=progress,
            )
        columns = [_trained(column, footage, output, options, progress) for column in columns]
        found = given if given is not None else _Reference()
        found = _with_pseudo_truth(found, columns, footage)
        measured = [_measure(column, found, footage) for column in columns]
        report = CompareReport(
            output=output,
            video=video.path,
            num_frames=footage.num_frames,
            num_images=len(footage.names),
            size=footage.size,
            fixed_intrinsics=not settings.refine_intrinsics,
            forward_motion=footage.forward_motion,
            cloud_reference=found.cloud_source,
            pose_reference=found.pose_source,
            is_truth=found.is_truth,
            columns=tuple(column for column, _ in measured),
            warnings=(
                *footage.warnings,
                *(f"{column.name}: {text}" for column, _ in measured for text in column.warnings),
            ),
        )
        clouds = {column.name: cloud for column, cloud in measured if cloud is not None}
        write_report(report, clouds, footage)
    return report


def _check_reference(output: Path, reference: str | os.PathLike[str] | None) -> None:
    """Refuse a missing reference, or one in the output except for a front-end's model."""
    if reference is None:
        return
    if not Path(reference).exists():
        raise ImageError(f"{reference}: no such file or folder: give the ground truth")
    models = (output / _FRONTENDS).resolve()
    if not Path(reference).resolve().is_relative_to(models):
        check_apart(output, [reference])


def _report_writer() -> Callable[[CompareReport, Mapping[str, Cloud], Footage], None]:
    check_packages("the report", ("matplotlib",), "evaluate")
    from colmap_av1.evaluate.report.writing import write_report  # noqa: PLC0415 - optional

    return write_report


def _chosen_frontends(options: CompareOptions) -> dict[str, Frontend]:
    known = make_frontends(options.match, options.learned)
    chosen: dict[str, Frontend] = {}
    for word in options.frontends:
        name, equals, files = word.partition("=")
        if equals:
            features, colon, matches = files.rpartition(":")
            if not (colon and features and matches):
                raise OptionError(f"front-end '{word}': give NAME=FEATURES.h5:MATCHES.h5")
            is_taken = name in known or name.startswith(f"{_OWN}-")
            if is_taken or name in {"", ".."} or Path(name).name != name:
                raise OptionError(f"front-end '{word}': name is taken or invalid: give another")
            frontend = imported_frontend(Path(features), Path(matches))
        elif name in known:
            frontend = known[name]
        else:
            raise OptionError(
                f"front-end '{name}': give one of {', '.join(known)}, or "
                "NAME=FEATURES.h5:MATCHES.h5"
            )
        if name in chosen:
            raise OptionError(f"front-end '{name}' is given twice: omit one")
        frontend.check()
        chosen[name] = frontend
    if not chosen:
        raise OptionError(f"no front-end is given: give one of {', '.join(known)}")
    return chosen


def _run_column(
    name: str,
    frontend: Frontend,
    footage: Footage,
    folder: Path,
    *,
    conversion: Conversion | None,
    settings: MapOptions,
    options: CompareOptions,
    progress: Progress,
) -> list[Column]:
    """The columns of a front-end: the mapped model and, for this package, also all tracks."""
    own = name.startswith(f"{_OWN}-") or name == _OWN
    total = 3 if own and options.all_tracks else 2
    column = Column(name)
    seconds, cpu_seconds = dict[str, float](), dict[str, float]()
    if own and conversion is not None:  # the others need no AV1 stream
        seconds["encoding"] = conversion.seconds
        cpu_seconds["conversion"] = conversion.cpu_seconds
    progress(name, 0, total)
    try:
        run = run_frontend(name, footage, folder / "matches", frontend)
        column = replace(
            column,
            warnings=run.warnings,
            seconds={**run.seconds, **seconds},
            cpu_seconds={**cpu_seconds, "matching": run.cpu_seconds},
            peak_memory=run.peak_memory,
        )
        progress(name, 1, total)
        mapped = measure_mapper(run.database, footage.image_path, folder / "mapped", settings)
        column = replace(
            column,
            seconds={**column.seconds, "mapping": mapped.seconds},
            cpu_seconds={**column.cpu_seconds, "mapping": mapped.cpu_seconds},
            peak_memory=_larger(run.peak_memory, mapped.peak_memory),
            num_models=mapped.num_models,
            model_path=mapped.model,
        )
        progress(name, 2, total)
    except ColmapAv1Error as error:
        return [replace(column, error=str(error))]
    if column.model_path is None:
        return [replace(column, error="no image is registered: the mapper found no initial pair")]
    if not (own and options.all_tracks):
        return [column]
    dense = replace(column, name=f"{name}{ALL_TRACKS}", num_models=1, warnings=())
    try:
        densify = DensifyOptions(match=options.match, triangulate=options.triangulate)
        made = densify_model(column.model_path, footage, folder / "all-tracks", densify)
        dense = replace(
            dense,
            warnings=made.warnings,
            seconds={**column.seconds, "all tracks": made.seconds},
            cpu_seconds={**column.cpu_seconds, "all tracks": made.cpu_seconds},
            peak_memory=_larger(column.peak_memory, made.peak_memory),
            model_path=made.model,
        )
    except ColmapAv1Error as error:
        dense = replace(dense, error=str(error), model_path=None)
    progress(name, 3, total)
    return [column, dense]


def _trained(
    column: Column, footage: Footage, output: Path, options: CompareOptions, progress: Progress
) -> Column:
    """The column with the results of training on its model."""
    if column.model_path is None or not (options.split or options.trainer):
        return column
    folder = output / "splats" / column.name.replace(" ", "")
    stage = f"{column.name}, training"
    try:
        progress(stage, 0, 1)
        split = write_split(column.model_path, footage.image_path, folder / "split")
        if options.trainer is None:
            progress(stage, 1, 1)
            return column
        training = train(
            options.trainer,
            split,
            folder / "training",
            name=column.name,
            iterations=options.iterations,
            milestones=options.milestones,
        )
        progress(stage, 1, 1)
    except ColmapAv1Error as error:
        return replace(column, training_error=str(error))
    return replace(column, training=training)


def _larger(a: int | None, b: int | None) -> int | None:
    return None if a is None or b is None else max(a, b)


def _read_reference(path: Path, footage: Footage) -> _Reference:
    if path.is_dir():
        model = read_model(path)
        poses, points = image_poses(model, footage.names), point_positions(model)
    else:
        poses = read_poses(path, footage.num_frames)[list(footage.frames)]
        points = np.empty((0, 3))
    known = int(np.isfinite(poses).all((1, 2)).sum())
    if known < 3:
        raise ModelError(
            f"{path}: has poses of {known} of the {len(footage.names)} images (first name: "
            f"{footage.names[0]}), needs 3: give the ground truth of this video"
        )
    return _Reference(
        poses,
        points if len(points) else None,
        pose_source=str(path),
        cloud_source=str(path) if len(points) else "",
        is_truth=True,
    )


def _with_pseudo_truth(given: _Reference, columns: list[Column], footage: Footage) -> _Reference:
    """The reference, completed by the model of SIFT.

    If poses are given, a SIFT model provides the cloud only if its poses agree with them.
    """
    if given.points is not None:
        return given
    for name in BASELINES if given.poses is not None else BASELINES[:1]:
        column = next((c for c in columns if c.name == name), None)
        if column is None or column.model_path is None:
            continue
        model = read_model(column.model_path)
        poses, points = image_poses(model, footage.names), point_positions(model)
        if given.poses is None:
            return _Reference(poses, points, name, name)
        similarity, errors = fit_similarity(poses, given.poses), pose_errors(poses, given.poses)
        if similarity is None or errors is None or errors.ate > _LARGEST_ATE * errors.extent:
            continue
        return replace(given, points=similarity * points, cloud_source=name)
    return given


def _measure(
    column: Column, reference: _Reference, footage: Footage
) -> tuple[Column, Cloud | None]:
    """The column with the figures of its model, and its cloud for the pictures."""
    if column.model_path is None:
        return column, None
    model = read_model(column.model_path)
    poses, points = image_poses(model, footage.names), point_positions(model)
    # A track may have several keypoints in the same image.
    lengths = [len({e.image_id for e in p.track.elements}) for p in model.points3D.values()]
    counts = np.bincount(np.array(lengths, dtype=np.int64))
    column = replace(
        column,
        model=model_figures(model),
        track_lengths={i: int(n) for i, n in enumerate(counts) if n},
    )
    similarity = None
    if reference.poses is not None:
        similarity = fit_similarity(poses, reference.poses)
        if similarity is None:
            lost = f"fewer than 3 poses, or poses on a line, in common with {reference.pose_source}"
            column = replace(column, warnings=(*column.warnings, f"errors not measured: {lost}"))
    if similarity is not None:
        points = similarity * points
        if reference.points is not None and reference.cloud_source != column.name:
            column = replace(column, cloud=cloud_distances(points, reference.points))
        assert reference.poses is not None
        if reference.pose_source != column.name:
            column = replace(column, poses=pose_errors(poses, reference.poses))
        poses = transform_poses(similarity, poses)
    cloud = Cloud(
        points=points,
        colours=point_colours(model),
        observable=has_observable_depth(model),
        cam_from_world=poses,
        focal_length=_focal_length(model),
        is_aligned=similarity is not None,
    )
    return column, cloud


def _focal_length(model: pycolmap.Reconstruction) -> float:
    return float(next(iter(model.cameras.values())).mean_focal_length())
