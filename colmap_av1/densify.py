"""From a model and its video to a dense model on the same poses."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, ModelError, cannot_write
from colmap_av1.images.choosing import ChosenImages, check_frame_list, choose_images
from colmap_av1.images.files import size_of_images
from colmap_av1.model.colmap_model import (
    MODEL_FILES,
    ModelImage,
    ModelPoints,
    posed_images,
    read_model,
    write_model,
)
from colmap_av1.model.coverage import PosedCamera, coverage, coverage_of_model
from colmap_av1.model.splats.gaussians import (
    check_gaussians_path,
    initial_gaussians,
    write_gaussians,
)
from colmap_av1.model.track_points import (
    LEAST_AGREEING,
    Colours,
    chaining_for_points,
    cloud_of,
    mean_error,
    seen_in,
    triangulate_tracks,
)
from colmap_av1.model.triangulate import TriangulatedPoints
from colmap_av1.options import DensifyOptions, MatchOptions
from colmap_av1.tracks.tracks import Tracks, scale_tracks
from colmap_av1.tracks.video_tracks import (
    VideoSource,
    decoded_pictures,
    open_source,
    times_of_frames,
    track_video,
)
from colmap_av1.util.arguments import checks_arguments
from colmap_av1.util.files import check_new_folder, whole_folder
from colmap_av1.util.outputs import check_folder
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.video.facts import Video, read_video
from colmap_av1.video.unchanged import unchanged


@dataclass(frozen=True)
class DensifyReport:
    """What `densify` made.

    Attributes:
        output: folder of the dense model.
        model: the model whose poses it has.
        conversion: how the video was converted, in words; None where it is AV1.
        num_images: images of the model.
        num_tracks: tracks of the video that its images see often enough.
        agreeing: share of these that agree with the poses.
        num_points: 3D points.
        num_model_points: those of the given model.
        coverage: share of the images' cells of 16x16 pixels that visible points project into.
        model_coverage: that of the given model's points.
        mean_error: mean reprojection error of the points in pixels.
        gaussians: file of initial Gaussians, where one was wanted.
        seconds: wall time of each stage.
        warnings: what the user should know.
    """

    output: Path
    model: Path
    conversion: str | None
    num_images: int
    num_tracks: int
    agreeing: float
    num_points: int
    num_model_points: int
    coverage: float
    model_coverage: float
    mean_error: float
    gaussians: Path | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@checks_arguments
def densify(
    model: str | os.PathLike[str],
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    image_path: str | os.PathLike[str] | None = None,
    gaussians: str | os.PathLike[str] | None = None,
    options: DensifyOptions | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> DensifyReport:
    """Triangulate the tracks of a video on the poses of an existing model.

    Poses, cameras and image names stay as they are; the points are new.

    Args:
        model: folder of a COLMAP model of this video's frames, from whatever mapper.
        video: a video; one that is not AV1 is converted first, see `match`.
        output: new or empty folder for the dense model.
        image_path: folder of the model's images, to recognise by their content which frames
            they are where their names leave doubt.
        gaussians: file, .ply, for initial Gaussians of the points; one from before is replaced.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.
        overwrite: replace an output that holds a model and nothing else.

    Raises:
        ModelError: there is no readable model with poses, it is not of this video, or the
            dense one cannot be written.
        VideoError: the video cannot be read, or changes meanwhile.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: the model's images do not say which frames they are.
        OptionError: an option does not go with the images, the folder is not empty, or the file
            for Gaussians cannot be made.
    """
    options = options if options is not None else DensifyOptions()
    progress = progress if progress is not None else no_progress
    model, output = Path(model), Path(output)
    folder = Path(image_path) if image_path is not None else None
    clock = Clock()
    inputs = [model, video, folder, options.match.images.frame_list]
    _check_outputs(output, gaussians, inputs, overwrite=overwrite)
    reconstruction = read_model(model)
    posed = posed_images(reconstruction)
    cameras = {i.camera_id: reconstruction.cameras[i.camera_id] for i in posed.values()}
    sizes = {name: _size(cameras[image.camera_id]) for name, image in posed.items()}
    video = read_video(video, options.match.read.operating_point)
    with unchanged(video.state):
        size = _check_input(model, video, folder, sizes, options)
        opening = open_source(video, options.match, beside=output, clock=clock, progress=progress)
        with opening as source, unchanged(source.stream.state):
            matching = chaining_for_points(options.match, options.triangulate)
            tracked = track_video(source, matching, one_size=True, clock=clock, progress=progress)
            with clock.measure("choice"):
                chosen = _choose(tracked.tracks, source, list(posed), folder, options.match)
        images = [posed[name] for name in chosen.names]
        seen, view = seen_in(scale_tracks(tracked.tracks, size), chosen.frames)
        with clock.measure("points"):
            points = triangulate_tracks(
                *(seen, view, [cameras[i.camera_id] for i in images]),
                *([i.cam_from_world for i in images], None),
                options=options.triangulate,
                num_threads=options.match.run.num_threads,
                progress=progress,
            )
        agreeing = _agreement(model, points)
        views = [PosedCamera(cameras[i.camera_id], i.cam_from_world) for i in images]
        with clock.measure("cloud"):
            xy = seen.xy[points.observation].astype(np.float64)
            cloud = cloud_of(points, view, xy, views, options.triangulate)
        with clock.measure("colours"):
            pictures = decoded_pictures(source, options.match)
            cloud = _coloured(cloud, size, pictures, chosen.frames, progress)
    with clock.measure("coverage"):
        covered = coverage(views, cloud.xyz)
    with clock.measure("writing"):
        _write(output, cameras, images, cloud, overwrite)
    wanted = _write_gaussians(gaussians, cloud, views, clock)
    return DensifyReport(
        output=output,
        model=model,
        conversion=source.conversion,
        num_images=len(images),
        num_tracks=points.num_tracks,
        agreeing=agreeing,
        num_points=len(cloud.xyz),
        num_model_points=reconstruction.num_points3D(),
        coverage=covered,
        model_coverage=coverage_of_model(reconstruction),
        mean_error=mean_error(cloud),
        gaussians=wanted,
        seconds=clock.seconds,
        warnings=tracked.warnings,
    )


def _size(camera: Any) -> tuple[int, int]:
    """(width, height) in pixels of the images of a pycolmap.Camera."""
    return int(camera.width), int(camera.height)


def _choose(
    tracks: Tracks,
    source: VideoSource,
    names: list[str],
    folder: Path | None,
    options: MatchOptions,
) -> ChosenImages:
    """The frames of the model's images."""
    return choose_images(
        tracks,
        options.images,
        existing=names,
        folder=folder,
        times=lambda: times_of_frames(source, tracks.num_frames),
        decode=lambda: decoded_pictures(source, options),
    )


def _coloured(
    cloud: ModelPoints,
    size: tuple[int, int],
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    frames: NDArray[np.int32],
    progress: Progress,
) -> ModelPoints:
    """The points in the colours of the images of a size, whose frames ascend."""
    colours = Colours(cloud, size, len(frames))
    image_of_frame = {int(frame): i for i, frame in enumerate(frames)}
    last = int(frames[-1])
    for frame, picture in pictures:
        progress("colours", frame + 1, last + 1)
        if frame in image_of_frame:
            colours.add(image_of_frame[frame], picture)
        if frame >= last:
            break
    return replace(cloud, rgb=colours.rgb())


def _write(
    output: Path,
    cameras: Mapping[int, Any],
    images: Sequence[ModelImage],
    points: ModelPoints,
    overwrite: bool,
) -> None:
    try:
        with whole_folder(output, overwrite=overwrite) as partial:
            write_model(partial, cameras, images, points)
    except OSError as error:
        raise ModelError(cannot_write(output, error)) from error


def _write_gaussians(
    path: str | os.PathLike[str] | None,
    points: ModelPoints,
    views: Sequence[PosedCamera],
    clock: Clock,
) -> Path | None:
    """Write initial Gaussians where they are wanted; where they are."""
    if path is None:
        return None
    with clock.measure("gaussians"):
        write_gaussians(Path(path), initial_gaussians(points, views))
    return Path(path)


def _agreement(model: Path, points: TriangulatedPoints) -> float:
    """Share of the tracks that agree with the poses; refuses a model of another video."""
    agreeing = points.num_agreeing / max(points.num_tracks, 1)
    if agreeing < LEAST_AGREEING or len(points.xyz) == 0:
        raise ModelError(
            f"{model}: only {agreeing:.0%} of the video's tracks agree with the model's poses and "
            f"{len(points.xyz)} give a point: give the video that the model's images come from, "
            "and see that their names count its frames (--first_number, --frame_list)"
        )
    return agreeing


def _check_outputs(
    output: Path,
    gaussians: str | os.PathLike[str] | None,
    inputs: Sequence[str | os.PathLike[str] | None],
    *,
    overwrite: bool,
) -> None:
    """Refuse what must not or cannot be written, before the long work."""
    check_new_folder(output, MODEL_FILES, overwrite=overwrite)
    check_folder(output, inputs)
    check_gaussians_path(gaussians, inputs, overwrite=overwrite)


def _check_input(
    model: Path,
    video: Video,
    folder: Path | None,
    sizes: Mapping[str, tuple[int, int]],
    options: DensifyOptions,
) -> tuple[int, int]:
    """Refuse what does not fit before the long work; (width, height) of the model's images."""
    check_frame_list(options.match.images)
    if len(sizes) < 2:
        raise ModelError(f"{model}: only one image has a pose: give a model with two or more")
    try:
        size = size_of_images(sizes, video.picture_size, video.display.pixel_aspect)
    except ImageError as error:
        raise ImageError(f"{model}: {error}") from error
    missing = next((n for n in sizes if folder is not None and not (folder / n).is_file()), None)
    if missing is not None:
        raise ImageError(f"{folder}: lacks the model's image '{missing}': give the folder of these")
    return size
