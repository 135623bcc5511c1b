"""A model as pictures and pages show it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import (
    ModelImage,
    camera_centres,
    posed_images,
    read_model,
)
from colmap_av1.geometry.observable import framed_box, has_observable_depth

_Floats = NDArray[np.float64]

_NO_COLOUR = 190
# Cosine of the angle to the vertical from which on most cameras look straight down or up.
_VERTICAL = 0.95


@dataclass(frozen=True)
class Scene:
    """A model as it is drawn.

    Attributes:
        model: the pycolmap.Reconstruction.
        points: float64 [n, 3], in the order of their ids.
        colours: uint8 [n, 3] RGB.
        observable: bool [n] points of observable depth; that of the others is assumed.
        images: the registered images, in the order of their names.
        centres: float64 [m, 3] of their cameras.
        axes: float64 [3, 3] unit vectors to the right, up and back as most cameras see them.
    """

    model: pycolmap.Reconstruction
    points: _Floats
    colours: NDArray[np.uint8]
    observable: NDArray[np.bool_]
    images: list[ModelImage]
    centres: _Floats
    axes: _Floats

    @property
    def extent(self) -> float:
        """Length of the diagonal of most of the scene."""
        low, high = self.box(self.axes)
        return float(np.linalg.norm(high - low))

    def box(self, axes: _Floats) -> tuple[_Floats, _Floats]:
        """What is framed, along `axes` [d, 3]; see `framed_box`."""
        return framed_box(self.points @ axes.T, self.observable, self.centres @ axes.T)

    def camera_of(self, image: ModelImage) -> pycolmap.Camera:
        """The camera of an image."""
        return self.model.cameras[image.camera_id]

    def corners(self, image: ModelImage, size: float) -> _Floats:
        """Float64 [4, 3] the corners in the world of an image whose longer side has a length."""
        camera = self.camera_of(image)
        width, height = camera.width, camera.height
        # Without distortion, which folds what lies beyond the picture of a wide lens.
        at = np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2
        rays = np.column_stack([at, np.full(4, camera.mean_focal_length())])
        rotation, translation = image.cam_from_world[:, :3], image.cam_from_world[:, 3]
        return np.asarray((rays * (size / max(width, height)) - translation) @ rotation)


def read_scene(model: str | os.PathLike[str], *, up: _Floats | None = None) -> Scene:
    """Read a COLMAP model and find how its cameras were held.

    Args:
        model: folder of the model.
        up: float64 [3] unit vector that points up; None: as most cameras were held.

    Raises:
        ModelError: the folder holds no model, or one without poses.
    """
    reconstruction = read_model(model)
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    images = sorted(posed_images(reconstruction).values(), key=lambda image: image.name)
    poses = np.array([image.cam_from_world for image in images])
    # Cameras look along their third axis with the second pointing down.
    back, top = normalised(-poses[:, 2, :3].mean(axis=0)), -poses[:, 1, :3].mean(axis=0)
    if up is None:
        up = normalised(top - back * (top @ back))
    elif abs(back @ up) > _VERTICAL:
        back = -top
    back = normalised(back - up * (back @ up))
    colours = np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3)
    if not colours.any():  # mapped without images
        colours[:] = _NO_COLOUR
    return Scene(
        model=reconstruction,
        points=np.array([p.xyz for p in points], dtype=np.float64).reshape(-1, 3),
        colours=colours,
        observable=has_observable_depth(reconstruction),
        images=images,
        centres=camera_centres(poses),
        axes=np.stack([np.cross(up, back), up, back]),
    )


def vertical_view(scene: Scene) -> tuple[float, float]:
    """Vertical field of view in radians, and width by height, of the first image."""
    camera = scene.camera_of(scene.images[0])
    return (
        2 * math.atan2(camera.height / 2, camera.mean_focal_length()),
        camera.width / camera.height,
    )


def normalised(vector: _Floats) -> _Floats:
    """The vector with length 1."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
