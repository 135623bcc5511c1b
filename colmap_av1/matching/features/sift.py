"""Extract and match SIFT features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask
from colmap_av1.util.arrays import Bools
from colmap_av1.video.coded_size import smaller_grey

# Scale of the picture before extraction. SIFT first doubles the size; light features use half the
# pixels, which takes half the time and locates features as exactly.
_SCALE = {"light": 0.7, "full": 1.0}
# Contrast threshold. The lower one finds about twice as many features, also in blurred pictures.
_CONTRAST = {"light": 0.04, "full": 0.02}
# COLMAP's limits for SIFT matches: angle to the nearest descriptor in radians, and its ratio to the
# angle of the second nearest.
_MAX_ANGLE = 0.7
_MAX_RATIO = 0.8
NUM_DIMENSIONS = 128


@dataclass(frozen=True)
class Features:
    """Features of one picture.

    Attributes:
        xy: float32 [n, 2] position in pixels, origin at the picture's top-left corner: the first
            pixel's centre is (0.5, 0.5).
        descriptors: float32 [n, 128] of unit length.
    """

    xy: NDArray[np.float32]
    descriptors: NDArray[np.float32]

    def only(self, kept: Bools) -> Features:
        """Select the features where `kept`, bool [n], is True."""
        return Features(self.xy[kept], self.descriptors[kept])


def extract_features(
    picture: NDArray[np.uint8], max_num_features: int, effort: Literal["light", "full"] = "light"
) -> Features:
    """Extract SIFT features of a picture with OpenCV.

    Large pictures are reduced first, see `smaller_grey`.

    Args:
        picture: uint8 [height, width, 3], BGR.
        max_num_features: largest number of features; those of the highest contrast are kept.
        effort: "light" finds fewer features in half the time, "full" finds all.
    """
    grey = smaller_grey(picture)
    size = tuple(max(1, round(length * _SCALE[effort])) for length in grey.shape[::-1])
    if size != grey.shape[::-1]:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(
        nfeatures=max_num_features,
        contrastThreshold=_CONTRAST[effort],
        enable_precise_upscale=True,
    )
    keypoints, found = sift.detectAndCompute(grey, None)
    # OpenCV's origin is the centre of the first pixel.
    xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2) + np.float32(0.5)
    xy *= np.array(picture.shape[1::-1], dtype=np.float32) / grey.shape[::-1]
    if found is None:
        found = np.empty((0, NUM_DIMENSIONS), np.float32)
    # RootSIFT (L1 norm, then square root), COLMAP's default.
    sums = np.maximum(found.sum(axis=1, keepdims=True), 1e-6)
    return Features(xy, np.sqrt(found / sums).astype(np.float32))


def masked_features(features: Features, picture: NDArray[np.uint8], mask: Mask | None) -> Features:
    """Keep the features on unmasked pixels of a picture; all if `mask` is None."""
    if mask is None:
        return features
    return features.only(mask.keeps(features.xy, picture.shape[1::-1]))


def are_similar(a: NDArray[np.float32], b: NDArray[np.float32]) -> Bools:
    """Whether descriptors [n, 128] match within COLMAP's limit, bool [n]."""
    return np.asarray(np.einsum("ij,ij->i", a, b) >= np.cos(_MAX_ANGLE))


def match_features(a: Features, b: Features) -> NDArray[np.uint32]:
    """Match mutual nearest neighbours within COLMAP's limits.

    Returns:
        uint32 [n, 2] indices of features (in a, in b), ascending in the first.
    """
    if min(len(a.xy), len(b.xy)) < 2:
        return np.empty((0, 2), dtype=np.uint32)
    similarity = a.descriptors @ b.descriptors.T
    rows = np.arange(len(similarity))
    nearest = similarity.argmax(axis=1)
    best = similarity[rows, nearest]
    # `argmax` along columns would be slow.
    is_mutual = best == similarity.max(axis=0)[nearest]
    similarity[rows, nearest] = -1
    second = similarity.max(axis=1)
    angle, second_angle = (np.arccos(np.clip(x, -1, 1)) for x in (best, second))
    kept = rows[is_mutual & (angle <= _MAX_ANGLE) & (angle <= _MAX_RATIO * second_angle)]
    # If descriptors are equal, only the first one is matched.
    kept = kept[np.sort(np.unique(nearest[kept], return_index=True)[1])]
    return np.column_stack([kept, nearest[kept]]).astype(np.uint32)
