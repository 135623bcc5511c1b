"""The stage of `reconstruct` that places the model in world coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_av1.database.reading import PosePrior
from colmap_av1.geometry.alignment import transform_poses
from colmap_av1.geometry.posed_model import write_posed_model
from colmap_av1.geometry.undistortion import output_cameras
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.positions import ImagePositions
from colmap_av1.poses.placing.placement import (
    PLACE_FILE,
    Place,
    PlacementData,
    find_placement,
    write_place,
)
from colmap_av1.poses.placing.up import pictures_for_lines, vertical_lines
from colmap_av1.poses.posed_images import PosedImages, PosesResult, read_posed_images
from colmap_av1.poses.run import Run
from colmap_av1.util.arrays import Floats
from colmap_av1.util.stages import Kept, run_stage


@dataclass(frozen=True)
class PlaceResult(PosesResult):
    """Result of `place_stage`.

    Attributes:
        place: coordinate system of the model.
        place_warnings: warnings about the placement.
    """

    place: Place
    place_warnings: tuple[str, ...]


def place_stage(
    run: Run, image_set: ImageSet, poses: Kept[PosesResult], positions: ImagePositions
) -> Kept[PlaceResult]:
    """Place the registered images by positions, gravity and a known distance.

    Args:
        run: the run.
        image_set: the images.
        poses: the stage with the poses.
        positions: GPS positions and gravity of the images of `image_set`.
    """
    options, seed = run.options.place, run.context.seed
    undistort = run.options.undistort
    file = f"{run.stages.name}/in_place.npz"

    def make(partial: Path) -> PlaceResult:
        registered = read_posed_images(run, poses, image_set)
        with run.clock.measure("place"):
            # Points are marked in the written pictures.
            cameras = output_cameras(registered.cameras, undistort=undistort)
            known = _placement_data(run, image_set, registered, positions)
            found, place_warnings = find_placement(registered.images, cameras, known, options, seed)
        write_place(partial, found)
        model = registered.model
        if found.is_moved:
            before = np.array([image.cam_from_world for image in model.images])
            moved = transform_poses(found.similarity, before)
            images = [
                replace(image, cam_from_world=pose)
                for image, pose in zip(model.images, moved, strict=True)
            ]
            model = replace(model, images=images)
        (partial / file).parent.mkdir()
        write_posed_model(partial / file, model)
        return PlaceResult(
            poses=Path(file).name,
            num_registered=len(model.images),
            place=found,
            place_warnings=place_warnings,
        )

    return run_stage(
        run.stages,
        "place",
        [poses.digest, options, positions.digest, seed, undistort],
        PlaceResult,
        into=run.output,
        products=[PLACE_FILE, file],
        make=make,
    )


def _placement_data(
    run: Run, image_set: ImageSet, registered: PosedImages, positions: ImagePositions
) -> PlacementData:
    index = {name: i for i, name in enumerate(image_set.images.names)}
    indices = [index[image.name] for image in registered.images]
    places = positions.places
    priors = {
        image_set.images.names[i]: PosePrior(places[i], is_cartesian=False)
        for i in indices
        if np.isfinite(places[i]).all()
    }

    def lines(up: Floats) -> list[Floats]:
        images = dict(pictures_for_lines([*zip(indices, registered.images, strict=True)]))
        return [
            vertical_lines(
                picture,
                registered.cameras[images[i].camera_id],
                images[i].cam_from_world,
                up,
            )
            for i, picture in run.pictures(image_set)(sorted(images))
        ]

    gravity = positions.gravity[indices]
    has_gravity = bool(np.isfinite(gravity).any())
    return PlacementData(priors, gravity if has_gravity else None, lines, positions.place)
