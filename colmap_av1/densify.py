"""Triangulate the tracks of videos on the poses of an existing model."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np  # noqa: F401 - before pycolmap: else writing PNG files fails later
import pycolmap

from colmap_av1.errors import ModelError, writing
from colmap_av1.geometry.colmap_model import (
    MODEL_FILES,
    ModelImage,
    posed_images,
    read_model,
    write_model,
)
from colmap_av1.geometry.coverage import coverage, coverage_of_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera, views_of
from colmap_av1.geometry.track_points import (
    LEAST_AGREEING,
    Colours,
    TriangulatedTracks,
    chaining_for_points,
    fitting_in_images,
    mean_error,
    triangulate_tracks,
)
from colmap_av1.images.image_set import ImageSet, Pictures, ShownVideo, pictures_of
from colmap_av1.images.inputs import Inputs, paths_of, read_inputs
from colmap_av1.images.of_videos import VideoImages, images_of_videos
from colmap_av1.images.photos import Photo
from colmap_av1.images.track_images import ImageChoice, TrackedImages, track_chosen_images
from colmap_av1.options import DensifyOptions
from colmap_av1.splats.gaussians import check_gaussians_path, initial_gaussians, write_gaussians
from colmap_av1.splats.swept_cloud import Look, swept_cloud
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import open_source
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.files import (
    check_new_folder,
    output_of_model,
    read_output_report,
    scratch_folder,
    whole_folder,
)
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import unchanged


@dataclass(frozen=True)
class DensifyReport:
    """What `densify` made.

    Attributes:
        output: folder of the dense model.
        model: the given model.
        conversion: how the video was converted, in words; None if it is AV1.
        num_images: images of the model.
        masked: share of the images' pixels that masks exclude; None without masks.
        num_tracks: tracks of the video with enough observations.
        agreement: share of these that agree with the poses.
        num_points: 3D points.
        num_model_points: 3D points of the given model.
        coverage: share of the images' cells of 16x16 pixels that visible points project into.
        model_coverage: the same for the points of the given model.
        mean_error: mean reprojection error of the points in pixels.
        gaussians: file of initial Gaussians; None if not requested.
        seconds: wall time of each stage.
        warnings: what the user should know.
    """

    output: Path
    model: Path
    conversion: str | None
    num_images: int
    masked: float | None
    num_tracks: int
    agreement: float
    num_points: int
    num_model_points: int
    coverage: float
    model_coverage: float
    mean_error: float
    gaussians: Path | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@one_blas_thread()
def densify(
    model: str | os.PathLike[str],
    video: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    photos: str | os.PathLike[str] | None = None,
    image_path: str | os.PathLike[str] | None = None,
    gaussians: str | os.PathLike[str] | None = None,
    options: DensifyOptions = DensifyOptions(),
    progress: Progress = no_progress,
    overwrite: bool = False,
) -> DensifyReport:
    """Triangulate the tracks of videos on the poses of an existing model.

    Poses, cameras and image names are unchanged; the points are new. With several videos, the
    folder of an image determines its video, see `match`.

    Args:
        model: folder of a COLMAP model of frames of these videos, from any mapper.
        video: a video or several. A video that is not AV1 is converted first, see `match`.
        output: new or empty folder for the dense model.
        photos: folder of the photos among the model's images, which observe no tracks; None: no
            photos.
        image_path: folder of the model's images, to find the frame of an image by its content if
            names are ambiguous.
        gaussians: .ply file for initial Gaussians of the points.
        options: options of every stage.
        progress: called with a stage's name, the amount of work done, and the total if known.
        overwrite: replace an output that holds only a model, and a file of Gaussians.

    Raises:
        ModelError: the model is not readable, has no poses, or is not of these videos.
        WriteError: the dense model cannot be written.
        VideoError: a video cannot be read, is given twice, or changes during the run.
        BitstreamError: a stream is damaged, and `strict` is set or the damage is before the
            second frame.
        ImageError: the frames of the model's images cannot be determined.
        OptionError: an option does not fit the images, the folder is not empty, or the file for
            Gaussians cannot be made.

    Examples:
        >>> from colmap_av1 import densify
        >>> report = densify("my_model/0", "video.mp4", "my_dense_model")
        >>> report.num_images, report.num_points > 2 * report.num_model_points
        (10, True)
    """
    model, output = Path(model), Path(output)
    folder = Path(image_path) if image_path is not None else None
    context = RunContext.of(options.match.run, progress)
    clock = context.clock
    read = [model, *paths_of(video), photos, folder, *options.match.files]
    # Check the outputs before the long work.
    check_new_folder(output, MODEL_FILES, read, overwrite=overwrite)
    check_gaussians_path(gaussians, read, overwrite=overwrite)
    _check_distorted(model)
    reconstruction = read_model(model)
    posed = posed_images(reconstruction)
    least = options.triangulate.min_observations
    if len(posed) < least:
        raise ModelError(
            f"{model}: has {len(posed)} images, but points need {least} observations: give a "
            "larger model, or a smaller --min_observations"
        )
    cameras = {i.camera_id: reconstruction.cameras[i.camera_id] for i in posed.values()}
    inputs = _read_inputs(video, photos, options, posed).keep_videos_of(posed)
    with unchanged(*inputs.states):
        sizes = {name: _size(cameras[image.camera_id]) for name, image in posed.items()}
        of_videos = images_of_videos(model, sizes, inputs, folder, options.match.images)
        found = [_track(own, output, options, context) for own in of_videos]
        tracked = [images for images, _ in found]
        photos_there = [photo for photo in inputs.photos if photo.name in posed]
        image_set = inputs.image_set(
            [own.chosen for own in tracked],
            [own.tracks.num_frames for own in tracked],
            photos_there,
        )
        images = [posed[name] for name in image_set.images.names]
        views = views_of(images, cameras, image_set.masks)
        row = Tracks.in_sequence([own.tracks for own in tracked], image_set.num_frames)
        with clock.measure("points"):
            triangulated = triangulate_tracks(
                row,
                image_set.images.frames,
                views,
                options=options.triangulate,
                num_threads=context.num_threads,
                progress=progress,
            )
        _check_agreement(model, triangulated)
        of_tracks = fitting_in_images(
            triangulated.model_points(),
            views,
            options.triangulate.max_reprojection_error,
        )
        with scratch_folder(output) as scratch:
            cloud = _coloured_cloud(
                of_tracks,
                views,
                image_set,
                _pictures(image_set, of_videos, photos_there, scratch, options),
                options=options,
                context=context,
            )
    with clock.measure("coverage"):
        covered = coverage(views, cloud.xyz)
    with clock.measure("writing"):
        _write(output, cameras, images, cloud, overwrite)
    return DensifyReport(
        output=output,
        model=model,
        conversion=inputs.conversion([words for _, words in found]),
        num_images=len(images),
        masked=image_set.masked,
        num_tracks=triangulated.points.num_tracks,
        agreement=triangulated.agreement,
        num_points=len(cloud.xyz),
        num_model_points=reconstruction.num_points3D(),
        coverage=covered,
        model_coverage=coverage_of_model(reconstruction),
        mean_error=mean_error(cloud),
        gaussians=_write_gaussians(gaussians, cloud, views, clock),
        seconds=clock.seconds,
        warnings=(*inputs.warnings, *inputs.with_names([own.video.warnings for own in tracked])),
    )


def _track(
    images: VideoImages, output: Path, options: DensifyOptions, context: RunContext
) -> tuple[TrackedImages, str | None]:
    """Track a video in pixels of its images.

    Returns:
        The tracks, only in the frames that are images, and a description of the conversion.
    """
    matching = options.match
    with (
        open_source(images.video, matching.source, next_to=output, context=context) as source,
        unchanged(source.stream.state),
    ):
        chaining = chaining_for_points(
            matching.tracks, options.triangulate, is_downscaled=source.is_downscaled
        )
        found = track_chosen_images(
            source,
            replace(matching.tracking, tracks=chaining),
            ImageChoice(
                matching.images, images.names, images.folder, images.shown.display, of_model=True
            ),
            masks=images.masks,
            every_frame=False,
            context=context,
        )
    tracks = found.tracks.keep_frames(found.chosen.frames).scale_to(images.shown.size)
    return found.with_tracks(tracks), source.conversion


def _pictures(
    image_set: ImageSet,
    of_videos: Sequence[VideoImages],
    photos: Sequence[Photo],
    scratch: Path,
    options: DensifyOptions,
) -> Pictures:
    """A source of pictures in the size of the images; those of videos are kept in a folder."""
    shown = [
        ShownVideo.in_images(own.shown, own.video, KeptPictures(scratch / f"{number}.raw"))
        for number, own in enumerate(of_videos)
    ]
    return pictures_of(image_set, shown, [photo.path for photo in photos], options.match.reading)


def _coloured_cloud(
    tracked: ModelPoints,
    views: Sequence[PosedCamera],
    image_set: ImageSet,
    pictures: Pictures,
    *,
    options: DensifyOptions,
    context: RunContext,
) -> ModelPoints:
    """The points to write, with colours from the pictures."""

    def show(stage: str, look: Look) -> None:
        with context.clock.measure(stage):
            for done, (image, picture) in enumerate(pictures(list(range(len(views)))), start=1):
                context.progress(stage, done, len(views))
                look(image, picture)

    cloud = tracked
    if options.triangulate.points == "splats":
        cloud = swept_cloud(
            tracked,
            views,
            image_set.sequence,
            partial(show, "sweep"),
            max_points=options.triangulate.max_points,
            num_threads=context.num_threads,
            clock=context.clock,
        )
    colours = Colours(cloud, [own.size for own in views])
    show("colours", colours.add)
    with context.clock.measure("colours"):
        return replace(cloud, rgb=colours.rgb())


def _write(
    output: Path,
    cameras: Mapping[int, pycolmap.Camera],
    images: Sequence[ModelImage],
    points: ModelPoints,
    overwrite: bool,
) -> None:
    with writing(output), whole_folder(output, MODEL_FILES if overwrite else None) as partial:
        write_model(partial, cameras, images, points)


def _write_gaussians(
    path: str | os.PathLike[str] | None,
    points: ModelPoints,
    views: Sequence[PosedCamera],
    clock: Clock,
) -> Path | None:
    """Write initial Gaussians if a path is given, and return the path."""
    if path is None:
        return None
    with clock.measure("gaussians"):
        write_gaussians(Path(path), initial_gaussians(points, views))
    return Path(path)


def _check_agreement(model: Path, triangulated: TriangulatedTracks) -> None:
    """Raise `ModelError` if the model is of another video."""
    num_points = len(triangulated.points.xyz)
    if triangulated.agreement < LEAST_AGREEING or num_points == 0:
        raise ModelError(
            f"{model}: only {triangulated.agreement:.0%} of the video's tracks agree with the "
            f"model's poses, {num_points} points are triangulated: give the video that the model's "
            "images come from, and check that their names are frame numbers (--first_number, "
            "--frame_list)"
        )


def _check_distorted(model: Path) -> None:
    """Refuse a model of `reconstruct` whose images are undistorted, because tracks are not.

    Raises:
        ModelError: it is one.
    """
    output = output_of_model(model)
    if output is not None and _has_undistorted(output):
        raise ModelError(
            f"{model}: its images are undistorted, but tracks are not: run reconstruct with other "
            "options for points, or with --undistort 0, or give the model of a mapper"
        )


def _has_undistorted(output: Path) -> bool:
    """Whether a folder has the report of `reconstruct`, alone or in a batch, with undistortion."""
    try:
        return bool(read_output_report(output).get("undistorted"))
    except (OSError, ValueError):
        return False


def _read_inputs(
    video: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    photos: str | os.PathLike[str] | None,
    options: DensifyOptions,
    names: Collection[str],
) -> Inputs:
    """Read the videos, and the photos under the names of a model from `match` or `reconstruct`.

    `reconstruct` gives photos names that trainers accept.
    """
    inputs = read_inputs(video, photos, options.match)
    if any(photo.name in names for photo in inputs.photos):
        return inputs
    return read_inputs(video, photos, options.match, for_trainers=True) if inputs.photos else inputs


def _size(camera: pycolmap.Camera) -> tuple[int, int]:
    return int(camera.width), int(camera.height)
