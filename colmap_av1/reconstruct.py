"""From a video to a dense model: poses from few accurate tracks, points from all."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Container, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import cattrs
import numpy as np

from colmap_av1.errors import ColmapAv1Error, ModelError, OptionError, writing
from colmap_av1.geometry.cameras import focal_length_warning
from colmap_av1.geometry.track_points import LEAST_AGREEING
from colmap_av1.geometry.uncertainty import expected_error, uncertainty_warning
from colmap_av1.images.image_set import ImageSet, ShownVideo
from colmap_av1.images.inputs import Inputs, paths_of, read_inputs
from colmap_av1.images.names import names_of_all
from colmap_av1.images.positions import image_positions
from colmap_av1.images.preparing import check_fit
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.options import MatchOptions, ReconstructOptions
from colmap_av1.poses.estimate import estimate_poses
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.placing.placement import Place
from colmap_av1.poses.posed_images import read_poses
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import read_tracks, stage_of_video, track_stage
from colmap_av1.splats.gaussians import check_gaussians_path, write_model_gaussians
from colmap_av1.splats.reconstruct_model import ModelResult
from colmap_av1.splats.reconstruct_models import FurtherModel, further_models, written_model
from colmap_av1.tracks.video_tracks import open_source, with_stream_kept
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.digests import file_digest
from colmap_av1.util.files import (
    REPORT,
    check_apart,
    check_outside,
    read_output_report,
    scratch_folder,
    whole_file,
)
from colmap_av1.util.plain import json_text
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import open_stages
from colmap_av1.util.texts import some_names
from colmap_av1.video.facts import count_shown
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import check_unchanged


@dataclass(frozen=True)
class VideoTimeline:
    """The images of a video in the order of its frames.

    Attributes:
        name: the folder of its images; '' for a single video.
        num_frames: number of shown frames.
        frame_rate: frames per second; None if unknown.
        images: names of its images, in the order of their frames.
        frames: frame number of each image in the video, from 0.
        key_images: names of its key images, whose poses the mapper estimates.
        not_registered: names of its images that are not registered in any model.
    """

    name: str
    num_frames: int
    frame_rate: float | None
    images: tuple[str, ...]
    frames: tuple[int, ...]
    key_images: tuple[str, ...]
    not_registered: tuple[str, ...]


@dataclass(frozen=True)
class ReconstructReport:
    """Result of `reconstruct`.

    Attributes:
        output: the folder with `images/` and `sparse/0/`, which trainers open.
        videos: the videos.
        video_digests: SHA-256 of each video file, in hexadecimal.
        conversion: how the videos were converted, in words; None if all are AV1.
        database: COLMAP database of the key images.
        num_frames: number of shown frames of the videos.
        num_images: number of frames chosen as images, plus photos.
        masked: share of the images' pixels that masks exclude; None without masks.
        dynamic_share: share of the images' pixels on dynamic objects, which get no points; None if
            these were not looked for.
        num_key_images: number of key images. COLMAP's mapper estimates their poses; the others are
            registered by resection.
        num_registered: number of registered images of the first model, in `sparse/0`.
        registered: the same for each video, by name, if there are several.
        other_models: further models of images that are not connected to the first model, in the
            folders `model_1`, ... of the output.
        num_tracks: number of tracks of the videos.
        num_pose_tracks: number of motion tracks by which the mapped images were matched.
        num_points: number of 3D points.
        num_observations: number of observations of all points.
        coverage: share of the images' cells of 16x16 pixels that contain projected points.
        mean_error: mean reprojection error in pixels.
        long_range: median long-range epipolar error in pixels, over pairs of images at least ten
            images apart that see the same place; None if there are no such pairs.
        long_range_largest: 90th percentile of the long-range epipolar error.
        expected_error: expected error of the camera centres as a share of their extent, by the
            covariance of the observations; None if it is not known.
        read_outs: rolling-shutter read-out time of each video in milliseconds, from the first row
            to the last; None if the tracks were not corrected for it.
        place: where the model lies in the world, as in `place.json`.
        focal_lengths: the shortest and the longest focal length of the output's cameras, in pixels.
        undistorted: whether images were undistorted, so that they differ from the pictures.
        mapper: the mapper of COLMAP that estimated the poses.
        forward_motion: whether the camera moves along its optical axis, see `MatchReport`.
        links: SIFT links between images that motion does not connect.
        gaussians: file of initial Gaussians, if requested.
        resumed: stages that an earlier run finished.
        seconds: wall time of each stage of this run.
        cpu_seconds: CPU time of each stage, including all threads and processes.
        warnings: warnings for the user.
        timelines: the images of each video.
    """

    output: Path
    videos: tuple[Path, ...]
    video_digests: tuple[str, ...]
    conversion: str | None
    database: Path
    num_frames: int
    num_images: int
    masked: float | None
    dynamic_share: float | None
    num_key_images: int
    num_registered: int
    registered: dict[str, int]
    other_models: tuple[FurtherModel, ...]
    num_tracks: int
    num_pose_tracks: int
    num_points: int
    num_observations: int
    coverage: float
    mean_error: float
    long_range: float | None
    long_range_largest: float | None
    expected_error: float | None
    read_outs: tuple[float | None, ...]
    place: Place
    focal_lengths: tuple[float, float]
    undistorted: bool
    mapper: str
    forward_motion: bool
    links: LinkReport
    gaussians: Path | None
    resumed: tuple[str, ...]
    seconds: dict[str, float]
    cpu_seconds: dict[str, float]
    warnings: tuple[str, ...]
    timelines: tuple[VideoTimeline, ...]

    @property
    def model(self) -> Path:
        """Folder of the COLMAP model with the most images."""
        return self.output / "sparse" / "0"


@one_blas_thread()
def reconstruct(
    video: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    photos: str | os.PathLike[str] | None = None,
    gaussians: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    options: ReconstructOptions = ReconstructOptions(),
    progress: Progress = no_progress,
) -> ReconstructReport:
    """Make a dense model of videos, in a folder that trainers of Gaussian splats open.

    COLMAP's mapper and bundle adjustment estimate the poses from long, accurate tracks; then all
    tracks are triangulated. The folder gets `images/` and `sparse/0/*.bin`: undistorted pictures
    of the video's size and one PINHOLE camera, or one per image if the video zooms. With
    `undistort` off it gets the original pictures and the estimated camera. It also gets
    `database.db` and `report.json`. An interrupted run resumes after its last finished stage.
    After a change of options, or if files are missing or damaged, the affected stages run again.

    With several videos, the images of each are in a folder of `images/` named after it and have
    their own camera. SIFT links connect the videos and the photos.

    Args:
        video: a video or several. A video that is not AV1 is converted first, to a stream in the
            folder or at `options.match.keep_stream`, which a resumed run uses again.
        output: the folder; new, empty, or from an earlier run.
        photos: folder of photos of the same scene. None: no photos.
        gaussians: file (.ply) for initial Gaussians of the points.
        overwrite: replace an existing file of Gaussians, and the model of other videos.
        options: options of all stages.
        progress: called with a stage's name, the amount of work done, and the total if known.

    Raises:
        VideoError: a video cannot be read, or has no motion to match.
        BitstreamError: a stream is damaged, and `strict` is set or the damage is before the
            second frame.
        LimitError: a frame is larger than `options.match.read.max_frame_size`.
        EncodeError: no AV1 encoder works, or it fails.
        ImageError: images cannot be chosen, or a photo or mask cannot be read.
        ModelError: no poses are found.
        WriteError: the output cannot be written.
        OptionError: an option does not fit the video, the folder has other contents or the model of
            other videos, or the file of Gaussians cannot be made.

    Examples:
        >>> from colmap_av1 import ImageOptions, MatchOptions, ReconstructOptions, reconstruct
        >>> options = ReconstructOptions(match=MatchOptions(images=ImageOptions(every=6)))
        >>> report = reconstruct("video.mp4", "my_scene", options=options)
        >>> report.num_frames, report.num_images, report.num_registered
        (60, 10, 10)
    """
    options = options.with_extension
    output = Path(output)
    check_apart(output, [*paths_of(video), photos, *options.match.files])
    check_outside(output, photos)
    inputs = read_inputs(video, photos, options.match, for_trainers=True)
    # Invalid input is refused before the long work.
    checked = [*(own.path for own in inputs.videos), *options.match.files]
    check_gaussians_path(gaussians, checked, overwrite=overwrite)
    for own, masks in zip(inputs.videos, inputs.masks_of_videos, strict=True):
        check_fit(
            options.match.camera, options.match.images, own.picture_size, own.display.pixel_aspect
        )
        if masks is not None:
            count = count_shown(own)
            names = (
                names_of_all(options.match.images, count) if count <= options.max_images else None
            )
            masks.check([own.picture_size], names, options.match.images)
    context = RunContext.of(options.match.run, progress)
    with open_stages(output, "reconstruct") as stages, ExitStack() as opened:
        if not overwrite:
            _check_no_model_of_others(output, inputs)
        sources = tuple(
            opened.enter_context(
                open_source(
                    own,
                    with_stream_kept(_as_converted(options), stages, label).source,
                    next_to=output,
                    context=context,
                )
            )
            for own, label in zip(inputs.videos, inputs.labels, strict=True)
        )
        scratch = opened.enter_context(scratch_folder(stages / "pictures"))
        sources = tuple(
            replace(own, kept=KeptPictures(scratch / f"{number}.raw"))
            for number, own in enumerate(sources)
        )
        shown = tuple(ShownVideo.as_played(own.pictures, own.kept) for own in sources)
        run = Run(inputs, sources, shown, output, stages, options, context)
        try:
            report = _run_stages(run)
        except ColmapAv1Error:  # A file that changed during the run may be the cause.
            check_unchanged(*run.files)
            raise
        if gaussians is not None:
            with context.clock.measure("gaussians"):
                write_model_gaussians(Path(gaussians), output / "sparse" / "0")
            report = replace(report, gaussians=Path(gaussians))
        _write_report(report)
    return report


def _check_no_model_of_others(output: Path, inputs: Inputs) -> None:
    """Raise `OptionError` if the output is a finished model that has none of these videos.

    Only what is needed is read, as the report may be of another version.
    """
    try:
        earlier = read_output_report(output)
        digests, names = earlier["video_digests"], [Path(path).name for path in earlier["videos"]]
    except FileNotFoundError:
        return
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise OptionError(
            f"{output / REPORT}: cannot be read: give another folder, or --overwrite to replace "
            "the model"
        ) from error
    if not any(file_digest(video.path) in digests for video in inputs.videos):
        raise OptionError(
            f"{output}: has the model of {', '.join(names)}: give another folder, or --overwrite "
            "to replace it"
        )


def _as_converted(options: ReconstructOptions) -> MatchOptions:
    """The options for the conversion of videos."""
    if not options.poses.adjust:
        return options.match
    return replace(options.match, encode=options.match.encode.quick_by_default)


def _run_stages(run: Run) -> ReconstructReport:
    numbers = range(len(run.sources))
    tracked = [track_stage(run, video) for video in numbers]
    videos = [read_tracks(run, video, stage) for video, stage in enumerate(tracked)]
    image_set = run.inputs.image_set(
        [own.chosen for own in videos], [own.tracks.num_frames for own in videos]
    )
    positions = image_positions(image_set, run.inputs.videos, run.inputs.photos)
    run = replace(run, positions=positions)
    estimate = estimate_poses(run, videos, image_set)
    del videos  # These tracks are as large as those in `estimate`.
    placed, written = written_model(run, estimate, image_set, positions)
    further, not_registered = further_models(run, estimate, image_set, positions)
    matches, poses, model = estimate.matches.result, estimate.last.result, written.result
    registered = read_poses(run, estimate.last)
    with run.clock.measure("adjustment"):
        centre_error = expected_error(registered)
    further_warnings = (
        focal_length_warning(registered.cameras.values()),
        uncertainty_warning(centre_error),
    )
    long_range = estimate.long_range.result
    return ReconstructReport(
        output=run.output,
        videos=tuple(source.pictures.path for source in run.sources),
        video_digests=tuple(file_digest(video.path) for video in run.inputs.videos),
        conversion=run.inputs.conversion([source.conversion for source in run.sources]),
        database=run.output / "database.db",
        num_frames=sum(stage.result.num_frames for stage in tracked),
        num_images=len(image_set.sequence),
        masked=image_set.masked,
        dynamic_share=estimate.dynamic.result.share if estimate.dynamic is not None else None,
        num_key_images=len(matches.key_images),
        num_registered=poses.num_registered,
        registered=_registered_by_video(registered.by_name, image_set),
        other_models=further,
        num_tracks=sum(stage.result.num_tracks for stage in tracked),
        num_pose_tracks=matches.num_pose_tracks,
        num_points=model.num_points,
        num_observations=model.num_observations,
        coverage=model.coverage,
        mean_error=model.mean_error,
        long_range=long_range.median,
        long_range_largest=long_range.largest,
        expected_error=centre_error,
        read_outs=tuple(stage.result.read_out for stage in tracked),
        place=placed.result.place,
        focal_lengths=model.focal_lengths,
        undistorted=model.undistorted,
        mapper=estimate.mapped.result.mapper,
        forward_motion=matches.forward_motion,
        links=matches.links,
        gaussians=None,
        resumed=(
            *(stage_of_video(run, video) for video in numbers if tracked[video].resumed),
            *estimate.resumed,
            *(["place"] if placed.resumed else []),
            *(["model"] if written.resumed else []),
        ),
        seconds=run.clock.seconds,
        cpu_seconds=run.clock.cpu_seconds,
        warnings=(
            *run.inputs.warnings,
            *positions.warnings,
            *run.inputs.with_names([stage.result.warnings for stage in tracked]),
            *matches.warnings,
            *placed.result.place_warnings,
            *(warning for warning in further_warnings if warning is not None),
            *_warnings(estimate, model, image_set, further, not_registered),
        ),
        timelines=_timelines(run, image_set, matches.key_images, not_registered),
    )


def _registered_by_video(names: Container[str], image_set: ImageSet) -> dict[str, int]:
    """Number of registered images of each video, by its name; empty for one video.

    Args:
        names: names of the registered images.
        image_set: the images.
    """
    if len(image_set.videos) == 1:
        return {}
    return {
        name: sum(image in names for image in image_set.of_video(video).names)
        for video, name in enumerate(image_set.videos)
    }


def _timelines(
    run: Run, image_set: ImageSet, key_images: Sequence[int], not_registered: Sequence[str]
) -> tuple[VideoTimeline, ...]:
    keys, left = {image_set.images.names[i] for i in key_images}, set(not_registered)
    timelines = []
    for number, video in enumerate(run.inputs.videos):
        own = image_set.of_video(number)
        timelines.append(
            VideoTimeline(
                name=image_set.videos[number],
                num_frames=int(np.diff(image_set.first_frame)[number]),
                frame_rate=video.frame_rate,
                images=tuple(own.names),
                frames=tuple(own.frames.tolist()),
                key_images=tuple(name for name in own.names if name in keys),
                not_registered=tuple(name for name in own.names if name in left),
            )
        )
    return tuple(timelines)


def _warnings(
    estimate: Estimate,
    model: ModelResult,
    image_set: ImageSet,
    further: Sequence[FurtherModel],
    not_registered: Sequence[str],
) -> list[str]:
    """Warnings about the poses and the model."""
    matches, poses = estimate.matches.result, estimate.last.result
    num_images = len(image_set.sequence)
    warnings = []
    if further:
        warnings.append(
            f"no model has all images: 'sparse/0' has {poses.num_registered} of "
            f"{num_images}, {', '.join(map(str, further))}; each folder has its own "
            "'images' and 'sparse/0'"
        )
    if not_registered:
        warnings.append(
            f"{len(not_registered)} of {num_images} images are not registered: "
            f"{some_names(not_registered)}"
        )
    without_images = [
        name
        for video, name in enumerate(image_set.videos)
        if set(image_set.of_video(video).names) <= set(not_registered)
    ]
    if without_images and not further:
        names = ", ".join(f"'{name}'" for name in without_images)
        warnings.append(
            f"the model has no image of {names}: reconstruct videos of another scene separately"
        )
    if matches.depth.warning is not None:
        warnings.append(matches.depth.warning)
    if estimate.long_range.result.warning is not None:
        warnings.append(estimate.long_range.result.warning)
    if estimate.adjustment is not None and estimate.adjustment.result.seams_warning is not None:
        warnings.append(estimate.adjustment.result.seams_warning)
    if model.agreement < LEAST_AGREEING:
        warnings.append(
            f"only {model.agreement:.0%} of the tracks agree with the poses, which may be wrong: "
            "try the other --mapper, or give --camera_params"
        )
    return warnings


def read_report(output: str | os.PathLike[str]) -> ReconstructReport:
    """Read the report of an earlier run from its folder.

    Raises:
        ModelError: the report is missing, damaged or from another version.
    """
    path = Path(output) / REPORT
    try:
        return cattrs.structure(read_output_report(Path(output)), ReconstructReport)
    except (OSError, ValueError, TypeError, KeyError, cattrs.BaseValidationError) as error:
        raise ModelError(
            f"{path}: missing, damaged or from another version: run reconstruct again"
        ) from error


def _write_report(report: ReconstructReport) -> None:
    path = report.output / REPORT
    with writing(path), whole_file(path) as partial:
        partial.write_text(json_text(dataclasses.asdict(report)))
