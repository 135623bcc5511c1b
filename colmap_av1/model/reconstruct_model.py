"""The last stage of `reconstruct`: all tracks on the poses, undistorted images, the model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.files import write_images
from colmap_av1.model.colmap_model import ModelPoints, points_seen, write_model
from colmap_av1.model.coverage import PosedCamera, coverage
from colmap_av1.model.far_views import FarViewCheck, FarViews
from colmap_av1.model.reconstruct_poses import PosedImages, read_posed_images, triangulate_images
from colmap_av1.model.reconstruct_stages import Run
from colmap_av1.model.track_points import (
    Colours,
    cloud_of,
    mean_error,
    seen_in,
)
from colmap_av1.model.triangulate import TriangulatedPoints
from colmap_av1.model.undistort import on_pinhole, pinhole_camera, undistortion
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import check_unchanged

_Image = NDArray[np.uint8]
# Trainers want one camera.
_CAMERA_ID = 1


@dataclass(frozen=True)
class _DenseCloud:
    """Points of all tracks, those of them that are written, in black, and what these cover."""

    points: TriangulatedPoints
    cloud: ModelPoints
    coverage: float


def _dense_cloud(
    run: Run, placed: PosedImages, camera: Any, seen: Tracks, view: NDArray[np.int64]
) -> _DenseCloud:
    options, clock = run.options.triangulate, run.clock
    with clock.measure("points"):
        points = triangulate_images(
            *(run, placed, seen, view), pinhole=camera, options=options, progress=run.progress
        )
    views = [PosedCamera(camera, image.cam_from_world) for image in placed.images]
    with clock.measure("cloud"):
        xy = on_pinhole(placed.camera, camera, seen.xy[points.observation])
        cloud = cloud_of(points, view, xy, views, options)
    with clock.measure("coverage"):
        return _DenseCloud(points, cloud, coverage(views, cloud.xyz))


def _write_images(
    run: Run, folder: Path, placed: PosedImages, camera: Any, cloud: ModelPoints
) -> tuple[FarViews, ModelPoints]:
    """Write the images, undistorted; look at their colours and at views from far apart on the way.

    Returns:
        How far views from far apart disagree; and the points in colours.
    """
    options, progress = run.options, run.progress
    undistort = undistortion(placed.camera, camera)
    far = FarViewCheck(placed.images, {_CAMERA_ID: camera}, lambda image: points_seen(cloud, image))
    colours = Colours(cloud, (int(camera.width), int(camera.height)), len(placed.images))
    index_of_frame = {int(frame): i for i, frame in enumerate(placed.frames)}
    names = [image.name for image in placed.images]

    def change(frame: int, picture: _Image) -> _Image:
        index = index_of_frame[frame]
        shown = undistort(picture) if undistort is not None else picture
        colours.add(index, shown)
        far.add(index, shown)
        return shown

    with run.clock.measure("images"):
        write_images(
            run.source.pictures,
            folder,
            names,
            placed.frames.tolist(),
            num_threads=options.match.run.num_threads,
            operating_point=options.match.read.operating_point,
            change=change,
            progress=lambda done: progress("images", done, len(names)),
        )
    with run.clock.measure("far views"):
        return far.result(), replace(cloud, rgb=colours.rgb())


def model_stage(run: Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    """Triangulate all tracks and write the images and the model that trainers open."""
    options, clock, source = run.options, run.clock, run.source

    def make(partial: Path) -> dict[str, Any]:
        placed = read_posed_images(run, posed, chosen)
        of_one = [replace(image, camera_id=_CAMERA_ID) for image in placed.images]
        placed = replace(placed, images=of_one)
        camera = pinhole_camera(placed.camera)
        seen, view = seen_in(tracks, placed.frames)
        dense = _dense_cloud(run, placed, camera, seen, view)
        points, cloud = dense.points, dense.cloud
        far_views, cloud = _write_images(run, partial / "images", placed, camera, cloud)
        check_unchanged(*source.files)
        with clock.measure("writing"):
            folder = partial / "sparse" / "0"
            folder.mkdir(parents=True)
            write_model(folder, {_CAMERA_ID: camera}, placed.images, cloud)
        return {
            "num_points": len(cloud.xyz),
            "num_observations": len(cloud.image),
            "coverage": dense.coverage,
            "mean_error": mean_error(cloud),
            "focal_length": float(camera.params[0]),
            "far_views": far_views.median,
            "far_views_largest": far_views.largest,
            "far_views_warning": far_views.warning,
            "agreeing": points.num_agreeing / max(points.num_tracks, 1),
        }

    given = (options.triangulate, options.match.images.image_name)
    return run_stage(
        run.stages,
        "model",
        [posed.digest, given],
        into=run.output,
        products=["images", "sparse"],
        make=make,
    )
