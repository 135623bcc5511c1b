"""Whether views from far apart in time agree with the poses, by what the pictures show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.matching.features import FeatureExtractor, Features
from colmap_av1.matching.link_matches import match_pairs
from colmap_av1.matching.two_view_models import epipolar_terms
from colmap_av1.model.colmap_model import ModelImage, camera_centres
from colmap_av1.options import RunOptions, VerifyOptions
from colmap_av1.util.progress import no_progress

_Floats = NDArray[np.float64]
_Image = NDArray[np.uint8]

# Images between two views that are far apart: neighbours agree whatever the model is like.
GAP = 10
# Two images see the same where they look the same way, to this angle in degrees, from places that
# lie this share of the path's extent apart at most.
_MAX_ANGLE = 20.0
_MAX_DISTANCE = 0.25
_NUM_PAIRS = 12
_NUM_FEATURES = 1500


@dataclass(frozen=True)
class FarViews:
    """How far apart views from far apart in time are.

    Attributes:
        pairs: (name, name) of the images of each pair that has matches.
        error: float64 [num_pairs] median distance in pixels of a pair's matched features from
            their epipolar lines, by the poses.
    """

    pairs: tuple[tuple[str, str], ...]
    error: _Floats

    @property
    def median(self) -> float | None:
        """Median over the pairs; None where no two views from far apart show the same."""
        return float(np.median(self.error)) if len(self.error) else None

    @property
    def worst(self) -> tuple[str, str] | None:
        """The images of the pair that is farthest apart."""
        return self.pairs[int(self.error.argmax())] if len(self.error) else None

    @property
    def largest(self) -> float | None:
        """The 90 % quantile over the pairs; None as for the median."""
        return float(np.quantile(self.error, 0.9)) if len(self.error) else None


class FarViewCheck:
    """Collects features of a few images and holds their matches against the poses.

    Args:
        images: the images with their poses, in display order.
        camera: their pycolmap.Camera, of pinhole model.
    """

    def __init__(self, images: Sequence[ModelImage], camera: Any) -> None:
        self._images = images
        self._camera = camera
        self._pairs = far_pairs(np.array([image.cam_from_world for image in images]))
        self._wanted = set(self._pairs.ravel().tolist())
        self._extractor = FeatureExtractor(_NUM_FEATURES) if self._wanted else None
        self._features: dict[int, Features] = {}

    def add(self, index: int, picture: _Image) -> None:
        """Take the picture of an image: uint8 [height, width, 3], BGR, undistorted."""
        if index in self._wanted and self._extractor is not None:
            self._features[index] = self._extractor.extract(picture)

    def result(self) -> FarViews:
        """What the pictures say; all that are needed have been added."""
        cameras = [self._camera] * len(self._images)
        # Each pair is freed of outliers by a geometry of its own, not by the poses.
        found = match_pairs(
            self._pairs,
            self._features,
            cameras=cameras,
            verify=VerifyOptions(),
            run=RunOptions(),
            progress=no_progress,
        )
        names, errors = [], []
        for (i, j), geometry in zip(found.pairs.tolist(), found.geometries, strict=True):
            a, b = geometry.inlier_matches.T
            error = self._errors(i, j, self._features[i].xy[a], self._features[j].xy[b])
            names.append((self._images[i].name, self._images[j].name))
            errors.append(float(np.median(error)))
        return FarViews(tuple(names), np.array(errors))

    def _errors(self, i: int, j: int, xa: NDArray[Any], xb: NDArray[Any]) -> _Floats:
        """Symmetric epipolar distance in pixels of matches [n, 2] by the poses of two images."""
        a, b = self._images[i].cam_from_world, self._images[j].cam_from_world
        rotation = b[:, :3] @ a[:, :3].T
        t = b[:, 3] - rotation @ a[:, 3]
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        inverse = np.linalg.inv(self._camera.calibration_matrix())
        F = inverse.T @ cross @ rotation @ inverse
        algebraic, squared = epipolar_terms(F, xa.T.astype(np.float64), xb.T.astype(np.float64))
        # Per image: each has a part of the distance.
        return np.asarray(np.sqrt(2) * np.abs(algebraic) / np.sqrt(np.maximum(squared, 1e-12)))


def far_pairs(cam_from_world: _Floats) -> NDArray[np.int32]:
    """Choose pairs of images that by their poses see the same though many images lie between.

    Args:
        cam_from_world: float64 [num_images, 3, 4] poses in display order.

    Returns:
        int32 [n, 2], first < second; few, spread over the images, with the longest spans first.
    """
    num_images = len(cam_from_world)
    if num_images <= GAP:
        return np.empty((0, 2), np.int32)
    centres = camera_centres(cam_from_world)
    directions = cam_from_world[:, 2, :3]
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    # Beginnings of pairs are spread over the images; each takes its partner farthest in time.
    anchors = np.unique(np.linspace(0, num_images - GAP - 1, 2 * _NUM_PAIRS).round().astype(int))
    found = []
    for i in anchors.tolist():
        later = np.arange(i + GAP, num_images)
        same_way = directions[later] @ directions[i] >= np.cos(np.radians(_MAX_ANGLE))
        near = np.linalg.norm(centres[later] - centres[i], axis=1) <= _MAX_DISTANCE * extent
        partners = later[same_way & near]
        if len(partners):
            found.append((i, int(partners[-1])))
    found.sort(key=lambda pair: (pair[0] - pair[1], pair[0]))
    half = _NUM_PAIRS // 2
    # Half of them the longest spans, half spread over the rest.
    rest = sorted(found[half:])
    spread = rest[:: max(1, -(-len(rest) // half))] if rest else []
    return np.array(found[:half] + spread[:half], dtype=np.int32).reshape(-1, 2)
