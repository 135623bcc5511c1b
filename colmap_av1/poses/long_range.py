"""Long-range check: whether matches of images far apart in time agree with the poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.geometry.colmap_model import ModelImage, posed_images
from colmap_av1.geometry.masks import Mask, make_mask
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.images.files import image_size, read_image
from colmap_av1.images.names import image_file, natural_order
from colmap_av1.matching.epipolar import error_of_pixels
from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.sift import Features, extract_features, masked_features
from colmap_av1.matching.links.matching import match_pairs
from colmap_av1.options import VerifyOptions
from colmap_av1.util.arrays import Floats, Picture
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.spread import evenly_spread

# Smallest distance in images of a long-range pair. Neighbours agree even in a bent model.
_GAP = 10
# Two images overlap if this share of the points of one projects into the other, with at most this
# angle in degrees between the viewing directions and this ratio of the distances (medians).
_MIN_OVERLAP = 0.5
_MAX_ANGLE = 30.0
_MAX_SCALE = 2.0
# About the number of points of an image that are projected.
_NUM_POINTS = 200
_NUM_PAIRS = 12
_NUM_FEATURES = 1500
# Number of images that pairs are made of, evenly spread. Each takes 0.05 s for its features.
_NUM_IMAGES = 16
# Long-range epipolar error in pixels (90th percentile) above which there is a warning. Good models
# have less than one, or two with long focal lengths.
_MAX_ERROR = 4.0
# Fewest matches of a pair that has an error. The geometry of 20 matches may be wrong.
_MIN_MATCHES = 30
# Smallest number of pairs, all without matches, for which there is a warning. Sharp images, which
# have at least this number of features, only count up to this angle: those of plants have few
# matches beyond it.
_MIN_UNMATCHED = 3
_SHARP_FEATURES = 200
_SHARP_ANGLE = 15.0
# Features of a model's image count up to this distance from the points that it observes, as a share
# of its longer side. Matchers leave out dynamic objects, which therefore have no points.
_POINT_DISTANCE = 0.03


@dataclass(frozen=True)
class LongRangeErrors:
    """Result of the long-range check.

    Attributes:
        pairs: (name, name) of the images of each pair with enough matches.
        error: float64 [num_pairs] long-range epipolar error of each pair: median distance in pixels
            of its matches from the epipolar lines of the poses.
        num_unmatched: number of pairs that should have matches by their poses, if none has any;
            otherwise 0.
        num_features: median number of features of the images; 0 if there are none.
    """

    pairs: tuple[tuple[str, str], ...]
    error: Floats
    num_unmatched: int
    num_features: int

    @property
    def median(self) -> float | None:
        """Median error over the pairs; None if no pair has enough matches."""
        return float(np.median(self.error)) if len(self.error) else None

    @property
    def worst(self) -> tuple[str, str] | None:
        """The images of the pair with the largest error."""
        return self.pairs[int(self.error.argmax())] if len(self.error) else None

    @property
    def largest(self) -> float | None:
        """90th percentile of the error over the pairs; None if no pair has enough matches."""
        return float(np.quantile(self.error, 0.9)) if len(self.error) else None

    @property
    def contradicts_poses(self) -> bool:
        """Whether the images contradict the poses."""
        return self.largest is not None and self.largest > _MAX_ERROR

    def warning(self, *, searched_loops: bool = False) -> str | None:
        """Warning about poses that the images contradict, or about images without matches.

        Args:
            searched_loops: whether loop closures have been searched in all videos.
        """
        if self.num_unmatched >= _MIN_UNMATCHED:
            cause = "the poses are wrong"
            if self.num_features < _SHARP_FEATURES:
                cause = (
                    f"the images are blurred or lack texture, with {self.num_features} features "
                    f"each, or {cause}"
                )
            return (
                f"{self.num_unmatched} pairs of images far apart in time overlap by their poses "
                f"but show nothing in common: {cause}"
            )
        if not self.contradicts_poses or self.worst is None:
            return None
        first, second = self.worst
        advice = "" if searched_loops else "; --links sift matches more images"
        return (
            f"images far apart in time contradict the poses, with a long-range epipolar error of "
            f"{self.largest:.1f} px (90th percentile), largest between '{first}' and '{second}': "
            f"surfaces may be doubled there{advice}"
        )


class LongRangeCheck:
    """Collects features of a few images, matches them, and compares the matches with the poses.

    Args:
        images: the images with their poses, in display order.
        cameras: pycolmap.Camera by id, of any model.
        points_of: returns float64 [n, 3] the points that an image, given by its index, observes.

    Attributes:
        wanted: indices of the images whose pictures are needed, ascending.
    """

    def __init__(
        self,
        images: Sequence[ModelImage],
        cameras: Mapping[int, pycolmap.Camera],
        points_of: Callable[[int], Floats],
    ) -> None:
        self._images = images
        self._cameras = [cameras[image.camera_id] for image in images]
        self._pairs, self._angles = _far_pairs(images, self._cameras, points_of)
        self.wanted: list[int] = np.unique(self._pairs).tolist()
        self._features: dict[int, Features] = {}
        self._num_features: list[int] = []  # before masking

    def add(self, index: int, picture: Picture, mask: Mask | None = None) -> None:
        """Extract features from the picture of an image.

        Args:
            index: index of a wanted image.
            picture: uint8 [height, width, 3], BGR, of the size of its camera.
            mask: which pixels are used; None for all.
        """
        features = extract_features(picture, _NUM_FEATURES)
        self._num_features.append(len(features.xy))
        self._features[index] = masked_features(features, picture, mask)

    def result(self) -> LongRangeErrors:
        """Match the pairs and compute their errors, after all `wanted` images have been added."""
        features = without_overlays(self._features, self._cameras)
        # Outliers are removed by each pair's own two-view geometry, not by the poses under test.
        found = match_pairs(
            self._pairs,
            features,
            self._cameras,
            VerifyOptions(),
            RunContext(num_threads=1),
        )
        names, errors = [], []
        for (i, j), geometry in zip(found.pairs.tolist(), found.geometries, strict=True):
            if len(geometry.inlier_matches) < _MIN_MATCHES:
                continue
            a, b = geometry.inlier_matches.T
            error = self._errors(i, j, features[i].xy[a], features[j].xy[b])
            if len(error):
                names.append((self._images[i].name, self._images[j].name))
                errors.append(float(np.median(error)))
        num_features = int(np.median(self._num_features or [0]))
        should_match = (self._angles <= _SHARP_ANGLE) | (num_features < _SHARP_FEATURES)
        return LongRangeErrors(
            tuple(names),
            np.array(errors),
            num_unmatched=0 if len(found.pairs) else int(should_match.sum()),
            num_features=num_features,
        )

    def _errors(self, i: int, j: int, xa: NDArray[np.floating], xb: NDArray[np.floating]) -> Floats:
        """Symmetric epipolar distance in pixels of matches [n, 2] by the poses of two images."""
        views = [PosedCamera(self._cameras[k], self._images[k].cam_from_world) for k in (i, j)]
        # The Sampson error splits the distance between both images; sqrt(2) refers it to one.
        return np.asarray(np.sqrt(2) * error_of_pixels(views, (xa, xb)))


def model_long_range_errors(
    reconstruction: pycolmap.Reconstruction,
    image_path: Path,
    progress: Progress = no_progress,
) -> LongRangeErrors:
    """Run the long-range check on a few pairs of a model's images.

    Args:
        reconstruction: pycolmap.Reconstruction whose image names sort in temporal order.
        image_path: folder of the images.
        progress: called for the stage "long range".

    Raises:
        ImageError: all images are missing, or one that is needed is missing, unreadable or of
            another size than its camera.
    """
    posed = posed_images(reconstruction)
    names = list(posed)
    images = [posed[names[k]] for k in natural_order(names)]
    of_cameras = {
        image.camera_id: file
        for image in images
        if (file := image_file(image_path, image.name)).is_file()
    }
    if not of_cameras:
        raise ImageError(
            f"{image_path}: has none of the model's images: give the folder of the model's images"
        )
    for camera_id, file in of_cameras.items():
        _check_size(file, image_size(file), reconstruction.cameras[camera_id])

    def points_of(index: int) -> Floats:
        seen = reconstruction.images[images[index].image_id].points2D
        ids = [p.point3D_id for p in seen if p.has_point3D()]
        points = [reconstruction.points3D[point_id].xyz for point_id in ids]
        return np.array(points, dtype=np.float64).reshape(-1, 3)

    check = LongRangeCheck(images, dict(reconstruction.cameras), points_of)
    for done, index in enumerate(check.wanted, start=1):
        image = images[index]
        file = image_file(image_path, image.name)
        picture = read_image(file)
        height, width = picture.shape[:2]
        size = (width, height)
        _check_size(file, size, reconstruction.cameras[image.camera_id])
        seen = reconstruction.images[image.image_id].points2D
        check.add(index, picture, _near_points([p.xy for p in seen if p.has_point3D()], size))
        progress("long range", done, len(check.wanted))
    return check.result()


def _check_size(file: Path, size: tuple[int, int], camera: pycolmap.Camera) -> None:
    """Raise `ImageError` if an image has another size than its camera."""
    if size != (camera.width, camera.height):
        raise ImageError(
            f"{file}: is {size[0]}x{size[1]}, but its camera in the model "
            f"{camera.width}x{camera.height}: give the folder of the model's images"
        )


def _near_points(positions: Sequence[Floats], size: tuple[int, int]) -> Mask | None:
    """The pixels near the positions of points in an image of this (width, height).

    None without points. If there are few, the distance is that at which they would cover the image.
    """
    if not positions:
        return None
    kept = np.zeros(size[::-1], np.uint8)
    covering = math.sqrt(size[0] * size[1] / (math.pi * len(positions)))
    radius = round(max(_POINT_DISTANCE * max(size), covering))
    for xy in positions:
        cv2.circle(kept, np.round(xy).astype(int).tolist(), radius, 1, thickness=cv2.FILLED)
    return make_mask(kept > 0)


def _far_pairs(
    images: Sequence[ModelImage],
    cameras: Sequence[pycolmap.Camera],
    points_of: Callable[[int], Floats],
) -> tuple[NDArray[np.int32], Floats]:
    """Choose a few pairs of images that are far apart in time and overlap by their poses.

    Returns:
        int32 [n, 2], first < second: first the longest spans, then others spread over the images;
        and float64 [n] the viewing angle of each, see `_viewing_angle`.
    """
    num_images = len(images)
    if num_images <= _GAP:
        return np.empty((0, 2), np.int32), np.empty(0)
    chosen = evenly_spread(num_images, _NUM_IMAGES)
    views = {i: PosedCamera(cameras[i], images[i].cam_from_world) for i in chosen}
    found: list[tuple[int, int, float]] = []
    for i in chosen:
        points = points_of(i)
        points = points[:: max(1, len(points) // _NUM_POINTS)]
        for j in reversed(chosen):
            angle = _viewing_angle(points, views[i], views[j]) if j >= i + _GAP else None
            if angle is not None:
                found.append((i, j, angle))
                break
    found.sort(key=lambda pair: (pair[0] - pair[1], pair[0]))
    half = _NUM_PAIRS // 2
    rest = sorted(found[half:])
    spread = rest[:: max(1, -(-len(rest) // half))]
    pairs = found[:half] + spread[:half]
    return (
        np.array([pair[:2] for pair in pairs], np.int32).reshape(-1, 2),
        np.array([angle for *_, angle in pairs]),
    )


def _viewing_angle(points: Floats, first: PosedCamera, second: PosedCamera) -> float | None:
    """Median angle in degrees between the directions of points of an image from two images.

    Returns None if the second image does not see most of the points of the first, or if the angle
    or the ratio of the distances is too large.

    Args:
        points: float64 [n, 3] points that the first image observes.
        first: the first image.
        second: the second image.
    """
    inside, _, _ = second.project(points)
    if len(inside) == 0 or len(inside) < _MIN_OVERLAP * len(points):
        return None
    rays = [points - view.centre for view in (first, second)]
    near, far = (np.linalg.norm(ray, axis=1) for ray in rays)
    cosine = np.median(np.sum(rays[0] * rays[1], axis=1) / np.maximum(near * far, 1e-12))
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    scale = np.median(near / np.maximum(far, 1e-12))
    is_similar = angle <= _MAX_ANGLE and 1 / _MAX_SCALE <= scale <= _MAX_SCALE
    return angle if is_similar else None
