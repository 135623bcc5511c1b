"""Prepare a model for drawing."""

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
    point_colours,
    point_positions,
    posed_images,
    read_model,
)
from colmap_av1.geometry.observable import framed_box, has_observable_depth
from colmap_av1.images.names import natural_key
from colmap_av1.util.arrays import Bools, Floats

_NO_COLOUR = 190
# Above this cosine of the angle to the vertical, the cameras look straight down or up.
_VERTICAL = 0.95


@dataclass(frozen=True)
class Scene:
    """A model, prepared for drawing.

    Attributes:
        model: the pycolmap.Reconstruction.
        points: float64 [n, 3] positions, in the order of the point ids.
        colours: uint8 [n, 3] RGB.
        observable: bool [n] points with observable depth; the depth of the others is assumed.
        images: the registered images, in the natural order of their names.
        centres: float64 [m, 3] camera centres.
        axes: float64 [3, 3] unit vectors to the right, up and back for the average camera.
    """

    model: pycolmap.Reconstruction
    points: Floats
    colours: NDArray[np.uint8]
    observable: Bools
    images: list[ModelImage]
    centres: Floats
    axes: Floats

    @property
    def extent(self) -> float:
        """Length of the diagonal of the framed box."""
        low, high = self.box(self.axes)
        return float(np.linalg.norm(high - low))

    def box(self, axes: Floats) -> tuple[Floats, Floats]:
        """The framed box along `axes` [d, 3], see `framed_box`."""
        return framed_box(self.points @ axes.T, self.observable, self.centres @ axes.T)

    def camera_of(self, image: ModelImage) -> pycolmap.Camera:
        """The camera of an image."""
        return self.model.cameras[image.camera_id]

    def corners(self, image: ModelImage, size: float) -> Floats:
        """Corners in the world, float64 [4, 3], of an image plane whose longer side is `size`."""
        camera = self.camera_of(image)
        width, height = camera.width, camera.height
        # Distortion is left out: beyond the image of a wide lens it is not invertible.
        at = np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2
        rays = np.column_stack([at, np.full(4, camera.mean_focal_length())])
        rotation, translation = image.cam_from_world[:, :3], image.cam_from_world[:, 3]
        return np.asarray((rays * (size / max(width, height)) - translation) @ rotation)


def read_scene(model: str | os.PathLike[str], *, up: Floats | None = None) -> Scene:
    """Read a COLMAP model and find the axes from which to draw it.

    Args:
        model: folder of the model.
        up: float64 [3] unit vector that points up; None: the up direction of the average camera.

    Raises:
        ModelError: the folder has no model, or a model without poses.
    """
    reconstruction = read_model(model)
    images = sorted(
        posed_images(reconstruction).values(), key=lambda image: natural_key(image.name)
    )
    poses = np.array([image.cam_from_world for image in images])
    # A camera looks along its third axis; the second axis points down.
    back, top = normalised(-poses[:, 2, :3].mean(axis=0)), -poses[:, 1, :3].mean(axis=0)
    if up is None:
        up = normalised(top - back * (top @ back))
    elif abs(back @ up) > _VERTICAL:
        back = -top
    back = normalised(back - up * (back @ up))
    colours = point_colours(reconstruction)
    if not colours.any():  # mapped without images
        colours[:] = _NO_COLOUR
    return Scene(
        model=reconstruction,
        points=point_positions(reconstruction),
        colours=colours,
        observable=has_observable_depth(reconstruction),
        images=images,
        centres=camera_centres(poses),
        axes=np.stack([np.cross(up, back), up, back]),
    )


def vertical_view(scene: Scene) -> tuple[float, float]:
    """Vertical field of view in radians, and aspect ratio, of the first image."""
    camera = scene.camera_of(scene.images[0])
    return (
        2 * math.atan2(camera.height / 2, camera.mean_focal_length()),
        camera.width / camera.height,
    )


def normalised(vector: Floats) -> Floats:
    """Scale a vector to length 1."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
