from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_av1.errors import ImageError
from colmap_av1.evaluate.metrics.renderings import rendering_metrics


def write(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image)
    return path


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 256, (18, 24, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (240, 180), interpolation=cv2.INTER_NEAREST)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def test_metrics_have_known_values(tmp_path: Path) -> None:
    # Greys 100 and 120 have the luma 16 + 219 / 255 * grey = 102 and 119.
    grey = [np.full((180, 240, 3), value, dtype=np.uint8) for value in (100, 120)]
    files = [write(tmp_path / f"{i}.png", image) for i, image in enumerate(grey)]
    metrics = rendering_metrics([files[0], files[0]], [files[1], files[0]])
    assert metrics.psnr_y[0] == pytest.approx(20 * math.log10(255 / 17), abs=1e-3)
    assert metrics.psnr_y[1] == 60
    # For constant images, SSIM only depends on the means: (2ab + c) / (a^2 + b^2 + c).
    ssim = (2 * 102 * 119 + 6.5025) / (102**2 + 119**2 + 6.5025)
    assert metrics.ssim_db[0] == pytest.approx(-10 * math.log10(1 - ssim), abs=1e-2)
    assert metrics.sharpness.tolist() == [0, 0]


def test_worse_images_score_worse(photograph: np.ndarray, tmp_path: Path) -> None:
    reference = write(tmp_path / "reference.png", photograph)
    blurred = [cv2.GaussianBlur(photograph, (0, 0), sigma) for sigma in (1.0, 2.0, 4.0)]
    files = [write(tmp_path / f"{i}.png", image) for i, image in enumerate(blurred)]
    metrics = rendering_metrics([reference, *files], [reference] * 4)
    for values in (metrics.psnr_y, metrics.ssim_db, metrics.vmaf, metrics.sharpness):
        assert np.all(np.diff(values) < 0)
    assert metrics.vmaf[0] > 95
    assert metrics.sharpness_difference[0] == 0
    assert np.all(np.diff(metrics.sharpness_difference) > 0)
    assert (metrics.lpips is None) == bool(metrics.no_lpips)


def test_sharpness_of_a_ramp_and_of_noise(tmp_path: Path) -> None:
    ramp = np.repeat(np.arange(0, 256, 2, dtype=np.uint8)[None], 64, axis=0)
    noise = np.random.default_rng(0).normal(128, 20, (512, 512)).clip(0, 255).astype(np.uint8)
    files = [write(tmp_path / f"{i}.png", image) for i, image in enumerate((ramp, noise))]
    metrics = rendering_metrics(files, files)
    # Gradients (2, 0) in 64 pixels: s1 = 16, s2 = 0, in every patch.
    assert metrics.sharpness[0] == pytest.approx(16)
    assert metrics.sharpness[1] < 1


def test_images_may_have_several_and_odd_sizes(photograph: np.ndarray, tmp_path: Path) -> None:
    small = write(tmp_path / "small.png", photograph[:121, :199])
    large = write(tmp_path / "large.png", photograph)
    other = write(tmp_path / "other.png", 255 - photograph)
    metrics = rendering_metrics([small, other, small], [small, large, small])
    assert metrics.psnr_y[[0, 2]].tolist() == [60, 60]
    assert metrics.psnr_y[1] < 20


def test_mismatched_or_missing_images_are_refused(photograph: np.ndarray, tmp_path: Path) -> None:
    large = write(tmp_path / "large.png", photograph)
    small = write(tmp_path / "small.png", photograph[:100])
    with pytest.raises(ImageError, match="size"):
        rendering_metrics([small], [large])
    with pytest.raises(ImageError, match="missing"):
        rendering_metrics([tmp_path / "none.png"], [large])
    with pytest.raises(ImageError, match="0 rendered"):
        rendering_metrics([], [large])
