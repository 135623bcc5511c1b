from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import pytest

from colmap_av1.matching.features.sift import Features, extract_features, match_features


@pytest.mark.parametrize("effort", ["light", "full"])
@pytest.mark.parametrize("size", [(1920, 1080), (1601, 901)])
def test_features_of_large_pictures_are_located_accurately(
    size: tuple[int, int], effort: Literal["light", "full"]
) -> None:
    """Features of a large picture are found at reduced size; those of a part at full size."""
    noise = np.random.default_rng(0).standard_normal((135, 240)).astype(np.float32)
    large = cv2.resize(cv2.GaussianBlur(noise, (0, 0), 1.0), size, interpolation=cv2.INTER_CUBIC)
    large = cv2.cvtColor(np.clip(128 + 90 * large, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    whole = extract_features(large, 1500, effort)
    part = extract_features(large[200:800, 400:1200], 1500, effort)
    assert whole.xy.max() > 0.9 * size[0]
    matches = match_features(whole, part)
    assert len(matches) > 100
    off = whole.xy[matches[:, 0]] - (part.xy[matches[:, 1]] + [400, 200])
    assert np.median(np.abs(off)) < 0.2
    assert np.abs(np.median(off, axis=0)).max() < 0.1


def test_equal_descriptors_have_one_match() -> None:
    descriptors = np.eye(4, 128, dtype=np.float32)
    a = Features(np.zeros((5, 2), np.float32), descriptors[[0, 1, 1, 2, 3]])
    b = Features(np.zeros((4, 2), np.float32), descriptors)
    assert match_features(a, b).tolist() == [[0, 0], [1, 1], [3, 2], [4, 3]]


def test_untextured_pictures_have_no_features() -> None:
    for size in ((1, 1), (40, 60)):
        found = extract_features(np.full((*size, 3), 90, np.uint8), 100)
        assert found.xy.shape == (0, 2)
        assert found.descriptors.shape == (0, 128)
