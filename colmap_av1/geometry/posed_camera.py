"""Posed images: their cameras, poses and masks, and projections into them."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from colmap_av1 import _core
from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.masks import Mask
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.grouping import groups

# Number of points on each side of the image that bound the camera's field of view.
_EDGE_POINTS = 33
# Largest distance in pixels between a pixel and the projection of its ray.
_SAME_PIXEL = 1.0
# Largest distance between a point and the ray of its projection, relative to the point's distance.
_SAME_RAY = 1e-3


@dataclass(frozen=True)
class PosedCamera:
    """The camera, pose and mask of an image.

    Attributes:
        camera: pycolmap.Camera.
        cam_from_world: float64 [3, 4] pose, x_cam = R x_world + t.
        mask: the valid pixels of the image; None: all.
    """

    camera: pycolmap.Camera
    cam_from_world: Floats
    mask: Mask | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image in pixels."""
        return int(self.camera.width), int(self.camera.height)

    @property
    def centre(self) -> Floats:
        """Camera centre in the world, float64 [3]."""
        return np.asarray(-self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3])

    @functools.cached_property
    def _seen_rays(self) -> tuple[Floats, Floats] | None:
        """Smallest and largest (x / z, y / z) on the edge of the image, with a margin of 1 %.

        None if a point of the edge has no ray.
        """
        along = np.linspace(0.0, 1.0, _EDGE_POINTS)
        none, all_ = np.zeros_like(along), np.ones_like(along)
        edge = [(along, none), (along, all_), (none, along), (all_, along)]
        xy = np.concatenate([np.column_stack(side) for side in edge]) * self.size
        if not self._on_rays(xy).all():
            return None
        rays = self.rays(xy)[:, :2]
        low, high = rays.min(axis=0), rays.max(axis=0)
        margin = 0.01 * (high - low)
        return low - margin, high + margin

    def have_rays(self, xy: Floats) -> Bools:
        """Whether pixels [n, 2] of the image have a ray.

        All of them do if all pixels on the edge of the image do; otherwise each one is tested.
        """
        return np.ones(len(xy), np.bool_) if self._seen_rays else self._on_rays(xy)

    def keeps(self, xy: Floats) -> Bools:
        """Whether pixels [n, 2] of the image are valid and have a ray."""
        seen = self.have_rays(xy)
        return seen if self.mask is None else seen & self.mask.keeps(xy, self.size)

    def rays(self, xy: Floats) -> Floats:
        """Rays in camera coordinates of pixels [n, 2], float64 [n, 3] with z = 1."""
        rays = np.asarray(self.camera.cam_from_img(xy)).reshape(-1, 2)
        return np.column_stack([rays, np.ones(len(rays))])

    def in_camera(self, xyz: Floats) -> Floats:
        """Camera coordinates of points [n, 3] in the world, float64 [n, 3]."""
        return np.asarray(xyz @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3])

    def pixels(self, own: Floats) -> Floats:
        """Projections float64 [n, 2] of points [n, 3] in camera coordinates, in pixels."""
        return np.asarray(self.camera.img_from_cam(own)).reshape(-1, 2)

    def project(self, xyz: Floats) -> tuple[Ints, Floats, Floats]:
        """Project points, and keep those within the image.

        Args:
            xyz: float64 [n, 3] points in the world.

        Returns:
            int64 [m] ascending indices of the points within the image; float64 [m, 2] their pixels,
            the first pixel's centre at (0.5, 0.5); and float64 [m] their depths along the optical
            axis.
        """
        xyz = np.ascontiguousarray(xyz, np.float64)
        pose = np.ascontiguousarray(self.cam_from_world, np.float64)
        width, height = self.size
        if self.camera.model_name == "PINHOLE":
            return _core.points_in_picture(
                pose, np.asarray(self.camera.params), float(width), float(height), xyz
            )
        # Outside the field of view, the distortion model may project points into the image.
        low, high = self._seen_rays or (np.full(2, -np.inf), np.full(2, np.inf))
        index, own = _core.points_in_view(pose, low, high, xyz)
        xy = self.pixels(own)
        x, y = xy[:, 0], xy[:, 1]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        if self._seen_rays is None:
            inside[inside] = self.sees(own[inside], xy[inside])
        return index[inside], xy[inside], own[inside, 2]

    def sees(self, own: Floats, xy: Floats) -> Bools:
        """Whether points lie in the field of view of their pixels.

        Outside it, the distortion model may project points into the image.

        Args:
            own: float64 [n, 3] points in front of the camera, in its coordinates.
            xy: float64 [n, 2] their projections.
        """
        if self.camera.model_name == "PINHOLE":
            return np.ones(len(own), np.bool_)
        if self._seen_rays is not None:
            low, high = self._seen_rays
            slope = own[:, :2] / own[:, 2:]
            return np.asarray(((slope >= low) & (slope <= high)).all(axis=1))
        apart = np.linalg.norm(self.rays(xy) * own[:, 2:] - own, axis=1)
        return np.asarray(apart <= _SAME_RAY * np.linalg.norm(own, axis=1))

    def _on_rays(self, xy: Floats) -> Bools:
        """Whether pixels [n, 2] are the projections of their rays."""
        # COLMAP gives NaN or the ray of another pixel for those without one.
        again = self.pixels(self.rays(xy))
        return np.asarray(np.linalg.norm(again - xy, axis=1) <= _SAME_PIXEL)


def views_of(
    images: Sequence[ModelImage],
    cameras: Mapping[int, pycolmap.Camera],
    masks: Sequence[Mask | None] | None = None,
) -> list[PosedCamera]:
    """The camera, pose and mask of each image; `cameras` is by camera id."""
    if masks is None:
        masks = [None] * len(images)
    return [
        PosedCamera(cameras[image.camera_id], image.cam_from_world, mask)
        for image, mask in zip(images, masks, strict=True)
    ]


def observation_errors(points: ModelPoints, views: Sequence[PosedCamera]) -> Floats:
    """Reprojection error of each observation of some points.

    Args:
        points: the points.
        views: the images, by the index that observations have.

    Returns:
        float64 [num_observations] in pixels, in the order of the points' observations; infinite
        for points behind the camera and for points that its model cannot project.
    """
    point = points.point
    errors = np.full(len(point), np.inf)
    for view, own in zip(views, groups(points.image, len(views)), strict=True):
        in_camera = view.in_camera(points.xyz[point[own]])
        ahead = in_camera[:, 2] > 0
        seen = own[ahead]
        errors[seen] = np.linalg.norm(view.pixels(in_camera[ahead]) - points.xy[seen], axis=1)
    errors[np.isnan(errors)] = np.inf
    return errors
