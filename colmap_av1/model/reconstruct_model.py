"""The last stage of `reconstruct`: all tracks on the poses, undistorted images, the model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.files import write_images
from colmap_av1.model.colmap_model import write_model
from colmap_av1.model.far_views import FarViewCheck, FarViews
from colmap_av1.model.reconstruct_poses import PosedImages, read_posed_images, triangulate_images
from colmap_av1.model.reconstruct_stages import Run
from colmap_av1.model.track_points import Colours, seen_in, to_model_points
from colmap_av1.model.undistort import on_pinhole, pinhole_camera, undistortion
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import check_unchanged

_Image = NDArray[np.uint8]


def _write_images(
    run: Run, folder: Path, placed: PosedImages, colours: Colours
) -> tuple[Colours, FarViews]:
    """Write the images, undistorted; look at their colours and at views from far apart on the way.

    Returns:
        The colours with all pictures added, and how far views from far apart disagree.
    """
    options, progress = run.options, run.progress
    camera = pinhole_camera(placed.camera)
    undistort = undistortion(placed.camera, camera)
    far = FarViewCheck(placed.images, camera)
    index_of_frame = {int(frame): i for i, frame in enumerate(placed.frames)}
    names = [image.name for image in placed.images]

    def change(frame: int, picture: _Image) -> _Image:
        index = index_of_frame[frame]
        colours.add(index, picture)
        picture = undistort(picture) if undistort is not None else picture
        far.add(index, picture)
        return picture

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
        return colours, far.result()


def model_stage(run: Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    """Triangulate all tracks and write the images and the model that trainers open."""
    options, clock, progress = run.options, run.clock, run.progress
    source = run.source

    def make(partial: Path) -> dict[str, Any]:
        placed = read_posed_images(run, posed, chosen)
        distorted, frames = placed.camera, placed.frames
        camera = pinhole_camera(distorted)
        images = [replace(image, camera_id=1) for image in placed.images]
        seen, view = seen_in(tracks, frames)
        with clock.measure("points"):
            points = triangulate_images(
                *(run, placed, seen, view),
                pinhole=camera,
                options=options.triangulate,
                progress=progress,
            )
        colours, far_views = _write_images(
            run, partial / "images", placed, Colours(seen, view, points, len(images))
        )
        check_unchanged(*source.files)
        with clock.measure("writing"):
            folder = partial / "sparse" / "0"
            folder.mkdir(parents=True)
            xy = on_pinhole(distorted, camera, seen.xy[points.observation])
            dense = to_model_points(points, colours.mean(), view, xy)
            write_model(folder, {1: camera}, images, dense)
        return {
            "num_points": len(points.xyz),
            "num_observations": len(points.observation),
            "mean_error": float(points.error.mean()),
            "focal_length": float(camera.params[0]),
            "far_views": far_views.median,
            "far_views_largest": far_views.largest,
            "far_views_apart": far_views.worst,
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
