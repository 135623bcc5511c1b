"""Predict which images COLMAP's incremental mapper registers after an initial pair."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from colmap_av1.matching.mapper_limits import MIN_INLIERS, POINT_MIN_ANGLE, REGISTRATION_MIN_INLIERS
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.util.arrays import Bools, Floats
from colmap_av1.util.graphs import connected_components
from colmap_av1.util.grouping import grouped, take_rows


class Growth:
    """The growth of a model of COLMAP's incremental mapper, predicted from known poses.

    The mapper registers an image that observes enough points of the model. Few points cross a fast
    turn, and points need a triangulation angle. How far a model grows therefore depends on the
    initial pair: the mapper may cross a turn in one direction but not in the other.

    The prediction assumes that each registered image gets its right pose and that no match is an
    outlier. A track has a point once a registered image observes it at a sufficient angle to the
    first one that does. The mapper requires a larger angle of the first points; this is ignored.

    Args:
        matched: the images.
        cameras: the camera of each image.
        known: for each model with known poses, float64 [3, 4] cam_from_world of each image, None if
            it is not in the model. An image is in one model at most.

    Attributes:
        model_of: int64 [num_images] index of the model of each image; -1 if it is in none.
    """

    def __init__(
        self,
        matched: MatchedImages,
        cameras: Sequence[pycolmap.Camera],
        known: Sequence[Sequence[Floats | None]],
    ) -> None:
        self._offsets = np.cumsum([0, *(len(own.xy) for own in matched.keypoints)])
        edges = [
            geometry.inlier_matches + self._offsets[pair]
            for pair, geometry in zip(matched.pairs, matched.geometries, strict=True)
            if len(geometry.inlier_matches) >= MIN_INLIERS
        ]
        self._track = connected_components(
            int(self._offsets[-1]), np.concatenate([np.empty((0, 2), np.int64), *edges])
        )
        views = np.repeat(np.arange(len(cameras)), np.diff(self._offsets))
        self._rays = np.full((len(views), 3), np.nan)
        self.model_of = np.full(len(cameras), -1)
        for number, poses in enumerate(known):
            for i, pose in enumerate(poses):
                if pose is None:
                    continue
                self.model_of[i] = number
                x = np.asarray(cameras[i].cam_from_img(matched.keypoints[i].xy.astype(float)))
                rays = np.column_stack([x, np.ones(len(x))]) @ pose[:, :3]
                rays /= np.linalg.norm(rays, axis=1, keepdims=True)
                self._rays[self._offsets[i] : self._offsets[i + 1]] = rays
        self._num_tracks = 1 + int(self._track.max(initial=-1))
        # The views of each track, one track after the other.
        order, self._bounds = grouped(self._track, self._num_tracks)
        self._views = views[order]

    def registered(self, pair: Sequence[int], max_images: int | None = None) -> Bools:
        """Which images the mapper registers.

        Args:
            pair: the initial pair, two images of a model.
            max_images: growth ends with this number of images, or when no further image registers.

        Returns:
            bool [num_images].
        """
        model = _GrowingModel(len(self.model_of), self._num_tracks)
        for image in pair:
            self._register(model, image)
        is_other = self.model_of != self.model_of[pair[0]]
        while max_images is None or model.registered.sum() < max_images:
            num_visible = np.where(is_other | model.registered, 0, model.num_visible)
            best = int(num_visible.argmax())
            if num_visible[best] < REGISTRATION_MIN_INLIERS:
                break
            self._register(model, best)
        return model.registered

    def _register(self, model: _GrowingModel, image: int) -> None:
        model.registered[image] = True
        own = slice(self._offsets[image], self._offsets[image + 1])
        waiting = np.flatnonzero(~model.is_point[self._track[own]]) + own.start
        track, rays = self._track[waiting], self._rays[waiting]
        first_ray = model.first_ray[track]
        cosine = np.einsum("ij,ij->i", first_ray, rays)
        is_first = np.isnan(first_ray[:, 0])
        model.first_ray[track[is_first]] = rays[is_first]
        new = np.unique(track[cosine < np.cos(np.radians(POINT_MIN_ANGLE))])
        model.is_point[new] = True
        _, observed = take_rows(self._bounds, new)
        model.num_visible += np.bincount(self._views[observed], minlength=len(model.registered))


class _GrowingModel:
    """A model that grows.

    Attributes:
        registered: bool [num_images] whether each image is registered.
        num_visible: int64 [num_images] number of points that each image observes.
        first_ray: float64 [num_tracks, 3] direction of each track from the first registered image
            that observes it; NaN if there is none.
        is_point: bool [num_tracks] whether each track has a point.
    """

    def __init__(self, num_images: int, num_tracks: int) -> None:
        self.registered = np.zeros(num_images, np.bool_)
        self.num_visible = np.zeros(num_images, np.int64)
        self.first_ray = np.full((num_tracks, 3), np.nan)
        self.is_point = np.zeros(num_tracks, np.bool_)
