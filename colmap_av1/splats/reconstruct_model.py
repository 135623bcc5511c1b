"""The last stage of `reconstruct`: points of all tracks, undistorted images, and the model."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.geometry.cameras import is_undistorted
from colmap_av1.geometry.colmap_model import ModelImage, write_model
from colmap_av1.geometry.coverage import coverage
from colmap_av1.geometry.masks import Mask
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera, views_of
from colmap_av1.geometry.track_points import (
    Colours,
    fitting_in_images,
    mean_error,
    triangulate_tracks,
)
from colmap_av1.geometry.undistortion import (
    Undistortion,
    on_pinholes,
    output_cameras,
    undistorted_masks,
    undistortion,
)
from colmap_av1.images.files import read_image, write_image, write_images
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.dynamic.short_tracks import static_points
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.posed_images import (
    PosedImages,
    PosesResult,
    check_agreement,
    read_posed_images,
)
from colmap_av1.poses.run import Run
from colmap_av1.splats.gaussians import remove_gaussians_in
from colmap_av1.splats.swept_cloud import Look, swept_cloud
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Picture
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import check_unchanged

# Folder of the masks, if there are any.
_MASKS = "masks"


def _tracked_points(
    run: Run, registered: PosedImages, views: Sequence[PosedCamera], tracks: Tracks
) -> tuple[ModelPoints, float]:
    """Points of all tracks, in black, with observations in pixels of the written images.

    Returns:
        The points, and the share of the tracks that agree with the poses.
    """
    cameras = [own.camera for own in views]
    found = triangulate_tracks(
        tracks,
        registered.frames,
        views_of(registered.images, registered.cameras),
        options=run.options.triangulate,
        num_threads=run.context.num_threads,
        pinholes=cameras,
        progress=run.progress,
    )
    check_agreement(len(found.points.xyz), found.points.num_tracks)
    if run.options.undistort:
        of_points = found.points.observation
        xy = on_pinholes(found.rays[of_points], found.view[of_points], cameras)
        return found.model_points(xy), found.agreement
    most = run.options.triangulate.max_reprojection_error
    return fitting_in_images(found.model_points(), views, most), found.agreement


# Returns the undistortion of an image, given by its index; None if it is written unchanged.
_Undistort = Callable[[int], Undistortion | None]


def _undistortions(registered: PosedImages, cameras: Mapping[int, pycolmap.Camera]) -> _Undistort:
    """The undistortion of each image; `cameras` are those of the written images, by id."""

    # Consecutive images share a camera, and the maps of many cameras would need much memory.
    @functools.lru_cache(maxsize=1)
    def of_camera(camera_id: int) -> Undistortion | None:
        return undistortion(registered.cameras[camera_id], cameras[camera_id])

    one_at_a_time = threading.Lock()  # else each thread would create the same map

    def of_image(index: int) -> Undistortion | None:
        with one_at_a_time:
            return of_camera(registered.images[index].camera_id)

    return of_image


def _undistorted(picture: Picture, how: Undistortion | None) -> Picture:
    return how(picture) if how is not None else picture


def _write_images(
    run: Run,
    folder: Path,
    registered: PosedImages,
    undistort: _Undistort,
    look: Look,
) -> None:
    """Write the images, and call `look` with those of videos."""
    options, progress = run.options, run.progress
    index_of_frame = {int(frame): i for i, frame in enumerate(registered.frames)}
    names = [image.name for image in registered.images]

    def change(first: int, frame: int, picture: Picture) -> Picture:
        return _undistorted(picture, undistort(index_of_frame[first + frame]))

    def look_at(first: int, frame: int, picture: Picture) -> None:
        look(index_of_frame[first + frame], picture)

    done = 0

    def report(count: int) -> None:
        progress("images", done + count, len(names))

    for sequence in np.unique(registered.image_set.sequence).tolist():
        own = registered.image_set.images_of(sequence)
        first = int(registered.image_set.first_frame[sequence])
        if sequence < len(run.sources):
            write_images(
                run.sources[sequence].pictures,
                folder,
                names[own.start : own.stop],
                (registered.frames[own.start : own.stop] - first).tolist(),
                num_threads=run.context.num_threads,
                operating_point=options.match.read.operating_point,
                change=functools.partial(change, first),
                look=functools.partial(look_at, first),
                kept=run.sources[sequence].kept,
                progress=report,
            )
        else:
            photo = run.inputs.photos[sequence - len(run.sources)]
            (folder / photo.name).parent.mkdir(parents=True, exist_ok=True)
            shown = _undistorted(read_image(photo.path), undistort(own[0]))
            write_image(folder / photo.name, shown)
            report(1)
        done += len(own)


def _written_cloud(
    run: Run,
    folder: Path,
    registered: PosedImages,
    views: Sequence[PosedCamera],
    tracked: ModelPoints,
    *,
    undistort: _Undistort,
) -> ModelPoints:
    """Write the images; returns the points, in black, that `points` of the options requests."""
    options, clock = run.options.triangulate, run.clock

    def show(look: Look) -> None:
        with clock.measure("images"):
            _write_images(run, folder, registered, undistort, look)

    if options.points == "survey":
        show(lambda *_: None)
        return tracked
    return swept_cloud(
        tracked,
        views,
        registered.image_set.sequence,
        show,
        max_points=options.max_points,
        num_threads=run.context.num_threads,
        clock=clock,
    )


def _coloured(
    run: Run,
    image_set: ImageSet,
    registered: PosedImages,
    views: Sequence[PosedCamera],
    cloud: ModelPoints,
    *,
    undistort: _Undistort,
) -> ModelPoints:
    """Colour the points from the decoded video.

    Reading the written images instead would take several times as long.
    """
    colours = Colours(cloud, [view.size for view in views])
    indices = np.searchsorted(image_set.images.frames, registered.frames).tolist()
    index_of = {k: index for index, k in enumerate(indices)}
    with run.clock.measure("colours"):
        for done, (k, picture) in enumerate(run.pictures(image_set)(indices), start=1):
            index = index_of[k]
            colours.add(index, picture, undistort(index))
            run.progress("colours", done, len(views))
        return replace(cloud, rgb=colours.rgb())


def _write_masks(
    folder: Path,
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    masks: Sequence[Mask | None],
) -> None:
    """Write a mask for each image, all white for images without a mask.

    Trainers search for `masks/NAME.png` next to `images/NAME.jpg`, and so does COLMAP if images
    are PNG.
    """
    for image, mask in zip(images, masks, strict=True):
        camera = cameras[image.camera_id]
        shape = (int(camera.height), int(camera.width))
        kept = mask.kept if mask is not None else np.ones(shape, np.bool_)
        file = (folder / image.name).with_suffix(".png")
        file.parent.mkdir(parents=True, exist_ok=True)
        write_image(file, np.where(kept, np.uint8(255), np.uint8(0)))


@dataclass(frozen=True)
class ModelResult:
    """Figures of the model that `model_stage` writes.

    Attributes:
        num_points: number of 3D points.
        num_observations: number of observations of all points.
        coverage: share of the images' cells of 16x16 pixels that visible points project into.
        mean_error: mean reprojection error of the points in pixels.
        focal_lengths: the shortest and the longest of the cameras in pixels.
        undistorted: whether images were undistorted, so that they differ from the pictures.
        agreement: share of the tracks that agree with the poses.
    """

    num_points: int
    num_observations: int
    coverage: float
    mean_error: float
    focal_lengths: tuple[float, float]
    undistorted: bool
    agreement: float


def model_stage(
    run: Run,
    tracks: EstimateTracks,
    image_set: ImageSet,
    poses: Kept[PosesResult],
) -> Kept[ModelResult]:
    """Triangulate all tracks, and write the undistorted images and the model.

    Args:
        run: inputs and options of the run.
        tracks: the tracks of all videos, without dynamic pixels.
        image_set: all images.
        poses: the stage that estimated the poses.
    """
    options, clock = run.options, run.clock
    masked = run.inputs.masks is not None or options.moving == "mask"

    def make(partial: Path) -> ModelResult:
        registered = read_posed_images(run, poses, image_set)
        cameras = output_cameras(registered.cameras, undistort=options.undistort)
        images = registered.images
        masks = registered.image_set.masks
        given = undistorted_masks(masks, registered.camera_of_image, cameras)
        joined = registered.image_set.masked_by(tracks.dynamic_masks).masks
        valid = undistorted_masks(joined, registered.camera_of_image, cameras)
        views = views_of(images, cameras, valid)
        with clock.measure("points"):
            tracked, agreement = _tracked_points(
                run, registered, views, Tracks.concatenate(tracks.motion, tracks.link_tracks)
            )
            shows_dynamic = np.array([image.name in tracks.dynamic_masks for image in images])
            tracked = tracked.take(static_points(tracked, shows_dynamic))
        undistort = _undistortions(registered, cameras)
        cloud = _written_cloud(
            run, partial / "images", registered, views, tracked, undistort=undistort
        )
        check_unchanged(*run.files)
        with clock.measure("coverage"):
            covered = coverage(views, cloud.xyz)
        cloud = _coloured(run, image_set, registered, views, cloud, undistort=undistort)
        with clock.measure("writing"):
            folder = partial / "sparse" / "0"
            folder.mkdir(parents=True)
            write_model(folder, cameras, images, cloud)
            if masked:
                shown = valid if options.moving == "mask" else given
                _write_masks(partial / _MASKS, images, cameras, shown)
        remove_gaussians_in(run.output)  # Brush would begin with those of an earlier model
        focal = [camera.mean_focal_length() for camera in cameras.values()]
        return ModelResult(
            num_points=len(cloud.xyz),
            num_observations=len(cloud.image),
            coverage=covered,
            mean_error=mean_error(cloud),
            focal_lengths=(min(focal), max(focal)),
            undistorted=options.undistort
            and not all(map(is_undistorted, registered.cameras.values())),
            agreement=agreement,
        )

    how = (options.triangulate, options.match.images.file_name, options.moving, options.undistort)
    return run_stage(
        run.stages,
        "model",
        [poses.digest, how],
        ModelResult,
        into=run.output,
        products=["images", "sparse", *([_MASKS] if masked else [])],
        make=make,
    )
