"""Store the cameras, image poses and points of an intermediate model in one .npz file.

COLMAP's format is not suitable: trainers search a folder, including hidden folders, for
`cameras.bin`, and could take an intermediate model for the finished one.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import ModelImage, model_points, posed_images
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import observation_errors, views_of
from colmap_av1.util.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class PosedModel:
    """The cameras, the registered images and the points of a model.

    Attributes:
        cameras: pycolmap.Camera by camera id.
        images: the registered images.
        points: the points; empty if only the poses matter.
    """

    cameras: Mapping[int, pycolmap.Camera]
    images: Sequence[ModelImage]
    points: ModelPoints = field(default_factory=ModelPoints.empty)

    @property
    def by_name(self) -> dict[str, ModelImage]:
        """The images by their names."""
        return {image.name: image for image in self.images}

    def some(self, kept: Bools) -> tuple[PosedModel, Ints]:
        """The model of some of its images, with the points that two or more of them observe.

        Args:
            kept: bool [num_images].

        Returns:
            The model, and int64 [n] the indices of its points in this model.
        """
        points, left = self.points.keep_observations(kept[self.points.image])
        index = np.cumsum(kept) - 1
        images = [image for image, own in zip(self.images, kept, strict=True) if own]
        used = {image.camera_id for image in images}
        cameras = {i: camera for i, camera in self.cameras.items() if i in used}
        return PosedModel(cameras, images, replace(points, image=index[points.image])), left


def posed_model(
    reconstruction: pycolmap.Reconstruction, *, with_points: bool = False
) -> PosedModel:
    """The cameras and registered images of a pycolmap.Reconstruction, ordered by id.

    Args:
        reconstruction: the model.
        with_points: include the points.
    """
    images = sorted(posed_images(reconstruction).values(), key=lambda image: image.image_id)
    used = {image.camera_id for image in images}
    # Copied, because pycolmap's cameras are freed with the reconstruction.
    cameras = {i: copy.copy(reconstruction.cameras[i]) for i in sorted(used)}
    points = model_points(reconstruction, images) if with_points else ModelPoints.empty()
    return PosedModel(cameras, images, points)


def reprojection_errors(model: PosedModel) -> Floats:
    """Reprojection errors in pixels of the points' observations, see `observation_errors`.

    Args:
        model: a model with points.
    """
    return observation_errors(model.points, views_of(model.images, model.cameras))


def write_posed_model(path: Path, model: PosedModel) -> None:
    """Write a model to a file without loss of precision.

    Args:
        path: the file, .npz.
        model: the model.

    Raises:
        OSError: the file cannot be written.
    """
    cameras = [
        {
            "camera_id": camera_id,
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
            "has_prior_focal_length": camera.has_prior_focal_length,
        }
        for camera_id, camera in model.cameras.items()
    ]
    with path.open("wb") as file:
        np.savez(
            file,
            cameras=np.array(json.dumps(cameras)),
            image_id=np.array([image.image_id for image in model.images], np.int64),
            name=np.array([image.name for image in model.images], np.str_),
            camera_id=np.array([image.camera_id for image in model.images], np.int64),
            cam_from_world=np.array([i.cam_from_world for i in model.images]).reshape(-1, 3, 4),
            **{f"points_{name}": array for name, array in vars(model.points).items()},
        )


def read_posed_model(path: Path) -> PosedModel:
    """Read a model written by `write_posed_model`.

    Raises:
        ModelError: the file cannot be read.
    """
    try:
        with np.load(path) as file:
            cameras = {
                int(own["camera_id"]): pycolmap.Camera(
                    camera_id=own["camera_id"],
                    model=own["model"],
                    width=own["width"],
                    height=own["height"],
                    params=own["params"],
                    has_prior_focal_length=own["has_prior_focal_length"],
                )
                for own in json.loads(str(file["cameras"]))
            }
            images = [
                ModelImage(int(image_id), str(name), int(camera_id), pose)
                for image_id, name, camera_id, pose in zip(
                    file["image_id"],
                    file["name"],
                    file["camera_id"],
                    file["cam_from_world"],
                    strict=True,
                )
            ]
            points = ModelPoints(**{f.name: file[f"points_{f.name}"] for f in fields(ModelPoints)})
    except (OSError, ValueError, KeyError) as error:
        raise ModelError(f"{path}: cannot be read: {error}: run the same command again") from error
    return PosedModel(cameras, images, points)
