"""The registered images of a stage, and points of tracks in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_camera import views_of
from colmap_av1.geometry.posed_model import PosedModel, read_posed_model
from colmap_av1.geometry.track_points import TriangulatedTracks, triangulate_tracks
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import TriangulateOptions
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept

# For pose estimation even points of uncertain depth are useful, so their depth error is unlimited.
FOR_POSES = TriangulateOptions(max_depth_error=None, points="survey")
# Corners and links keep large errors, because these are errors of the poses: of a rolling shutter,
# or where the model is bent.
FROM_PICTURES = replace(FOR_POSES, max_reprojection_error=8.0)


@dataclass(frozen=True)
class PosesResult:
    """Result of a stage that estimates poses.

    Attributes:
        poses: file of the posed model, in the folder of the stages.
        num_registered: number of registered images.
    """

    poses: str
    num_registered: int


@dataclass(frozen=True)
class PosedImages:
    """The registered images of an image set.

    Attributes:
        model: their poses and cameras, without points. The images are in the order of the set.
        image_set: their frames, videos and masks.
    """

    model: PosedModel
    image_set: ImageSet

    @property
    def images(self) -> Sequence[ModelImage]:
        """The images with their poses."""
        return self.model.images

    @property
    def cameras(self) -> Mapping[int, pycolmap.Camera]:
        """Their cameras, by id."""
        return self.model.cameras

    @property
    def camera_of_image(self) -> list[pycolmap.Camera]:
        """The camera of each image."""
        return [self.cameras[image.camera_id] for image in self.images]

    @property
    def frames(self) -> NDArray[np.int32]:
        """int32 [num_images] frames of the images, numbered through all sequences."""
        return self.image_set.images.frames

    def of_video(self, video: int) -> PosedImages:
        """The images of a video."""
        own = self.image_set.images_of(video)
        images = self.images[own.start : own.stop]
        return PosedImages(replace(self.model, images=images), self.image_set.some(own))


def read_poses(run: Run, poses: Kept[PosesResult]) -> PosedModel:
    """The model of a stage."""
    return read_posed_model(run.stages / poses.result.poses)


def read_posed_images(run: Run, poses: Kept[PosesResult], image_set: ImageSet) -> PosedImages:
    """The registered images of a stage."""
    return posed_images_of(read_poses(run, poses), image_set)


def posed_images_of(poses: PosedModel, image_set: ImageSet) -> PosedImages:
    """The images of a set that are registered in a model."""
    posed_by_name = poses.by_name
    names = image_set.images.names
    index = [i for i, name in enumerate(names) if name in posed_by_name]
    found = [posed_by_name[names[i]] for i in index]
    cameras = {camera_id: poses.cameras[camera_id] for camera_id in {i.camera_id for i in found}}
    images = [replace(image, image_id=i + 1) for i, image in enumerate(found)]
    return PosedImages(PosedModel(cameras, images), image_set.some(index))


def triangulate_in(
    run: Run, registered: PosedImages, tracks: Tracks, options: TriangulateOptions
) -> TriangulatedTracks:
    """Triangulate tracks in the registered images."""
    return triangulate_tracks(
        tracks,
        registered.frames,
        views_of(registered.images, registered.cameras),
        options=options,
        num_threads=run.context.num_threads,
    )


def check_agreement(num_points: int, num_tracks: int) -> None:
    """Raise `ModelError` if no track agrees with the poses."""
    if num_points == 0:
        raise ModelError(
            f"none of the {num_tracks} tracks agrees with the poses: try the other --mapper, or "
            "give --camera_params"
        )
