"""Light SIFT features of pictures, for the few places that motion cannot connect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask
from colmap_av1.video.coded_size import smaller_grey

# Without the doubled picture SIFT takes a tenth of its time and keeps the features that views from
# far apart share; with it there are several times as many.
_FIRST_OCTAVE = {"light": 0, "full": -1}
# Of the width and height of the picture that quick ones are looked for in.
_QUICK_SCALE = 0.7
# COLMAP's own limits for matches of SIFT: angle of the nearest descriptor, in radians, and its
# ratio to that of the second nearest.
_MAX_ANGLE = 0.7
_MAX_RATIO = 0.8
_NUM_DIMENSIONS = 128
_WARNINGS = 1  # glog's number of the level


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

    def only(self, kept: NDArray[np.bool_]) -> Features:
        """Those of them that are kept: bool [n]."""
        return Features(self.xy[kept], self.descriptors[kept])


class FeatureExtractor:
    """Extracts SIFT features by pycolmap, on one thread.

    Args:
        max_num_features: about so many at most, those of the largest scale.
        effort: light: those of large scales, of large pictures in smaller ones, where they are the
            same; full: all.
    """

    def __init__(self, max_num_features: int, effort: Literal["light", "full"] = "light") -> None:
        self._effort = effort
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        options.sift.first_octave = _FIRST_OCTAVE[effort]
        options.sift.max_num_features = max_num_features
        # COLMAP says on standard error that it makes one.
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, _WARNINGS
        try:
            self._extractor: Any = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        finally:
            pycolmap.logging.minloglevel = level

    def extract(self, picture: NDArray[np.uint8]) -> Features:
        """The features of a picture: uint8 [height, width, 3], BGR."""
        light = self._effort == "light"
        grey = smaller_grey(picture) if light else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        keypoints, found = self._extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
        xy = np.array([(k.x, k.y) for k in keypoints], dtype=np.float32).reshape(-1, 2)
        xy *= np.array(picture.shape[1::-1], dtype=np.float32) / grey.shape[::-1]
        descriptors = np.asarray(found.data, dtype=np.float32).reshape(-1, _NUM_DIMENSIONS)
        length = np.linalg.norm(descriptors, axis=1, keepdims=True)
        return Features(xy, descriptors / np.maximum(length, 1e-6))


def quick_features(picture: NDArray[np.uint8], max_num_features: int) -> Features:
    """SIFT features of a picture by OpenCV, for views that differ little.

    In a picture of half its pixels, enlarged again for the smallest features, they take half the
    time of those of `FeatureExtractor`, and are placed as exactly.

    Args:
        picture: uint8 [height, width, 3], BGR.
        max_num_features: about so many at most, those that stand out most.
    """
    grey = smaller_grey(picture)
    size = tuple(max(1, round(length * _QUICK_SCALE)) for length in grey.shape[::-1])
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=max_num_features, enable_precise_upscale=True)
    keypoints, found = sift.detectAndCompute(grey, None)
    # OpenCV counts from the centre of the first pixel.
    xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2) + np.float32(0.5)
    xy *= np.array(picture.shape[1::-1], dtype=np.float32) / grey.shape[::-1]
    if found is None:
        found = np.empty((0, _NUM_DIMENSIONS), np.float32)
    # Root of the share of each: "RootSIFT", which COLMAP's own are by default.
    sums = np.maximum(found.sum(axis=1, keepdims=True), 1e-6)
    return Features(xy, np.sqrt(found / sums).astype(np.float32))


def masked_features(features: Features, picture: NDArray[np.uint8], mask: Mask | None) -> Features:
    """The features of a picture on pixels of it that count; None: all do."""
    if mask is None:
        return features
    return features.only(mask.keeps(features.xy, picture.shape[1::-1]))


def alike(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Bool [n] whether descriptors [n, 128] show the same, by COLMAP's limit."""
    return np.asarray(np.einsum("ij,ij->i", a, b) >= np.cos(_MAX_ANGLE))


def match_features(a: Features, b: Features) -> NDArray[np.uint32]:
    """Match features that are nearest to each other, by COLMAP's limits.

    Returns:
        uint32 [n, 2] indices of features (in a, in b), ascending in the first.
    """
    if min(len(a.xy), len(b.xy)) < 2:
        return np.empty((0, 2), dtype=np.uint32)
    likeness = a.descriptors @ b.descriptors.T
    rows = np.arange(len(likeness))
    nearest = likeness.argmax(axis=1)
    is_mutual = likeness.argmax(axis=0)[nearest] == rows
    best = likeness[rows, nearest]
    likeness[rows, nearest] = -1
    second = likeness.max(axis=1)
    angle, second_angle = (np.arccos(np.clip(x, -1, 1)) for x in (best, second))
    kept = is_mutual & (angle <= _MAX_ANGLE) & (angle <= _MAX_RATIO * second_angle)
    return np.column_stack([rows[kept], nearest[kept]]).astype(np.uint32)
