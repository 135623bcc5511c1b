"""How accurately the windows of a picture can be matched, judged by their texture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Ints


def texture_at(
    image: NDArray[np.uint8], at: Ints, window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The texture around some pixels (x, y) [n, 2] of a picture, see `texture_of`."""
    width = 2 * (window + 1) + 1  # a window around every pixel of a window, and the gradients
    if len(at) * width**2 >= image.size:
        softness, contrast = texture_of(image, window)
        return softness[at[:, 1], at[:, 0]], contrast[at[:, 1], at[:, 0]]
    # The patches are stacked vertically to one picture.
    framed = np.pad(image, width // 2, mode="reflect")
    patches = np.lib.stride_tricks.sliding_window_view(framed, (width, width))
    softness, contrast = texture_of(patches[at[:, 1], at[:, 0]].reshape(-1, width), window)
    return softness[width // 2 :: width, width // 2], contrast[width // 2 :: width, width // 2]


def texture_of(
    image: NDArray[np.uint8], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The texture of the window around every pixel.

    Returns:
        (softness, contrast), both float32 [height, width]. Softness is the standard deviation in
        pixels of a match in the worst direction if every pixel has noise of one grey level.
        Contrast is the mean absolute deviation in grey levels.
    """
    grey = image.astype(np.float32)
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    size = (window, window)
    # Computed in place: allocating arrays for large pictures takes longer than the computation.
    product = np.multiply(dx, dy)
    xy = cv2.boxFilter(product, cv2.CV_32F, size, normalize=False)
    xx = cv2.boxFilter(np.multiply(dx, dx, out=product), cv2.CV_32F, size, dx, normalize=False)
    yy = cv2.boxFilter(np.multiply(dy, dy, out=product), cv2.CV_32F, size, dy, normalize=False)
    # The smaller eigenvalue: (xx + yy - sqrt((xx - yy)^2 + 4 xy^2)) / 2.
    root = np.subtract(xx, yy, out=product)
    root *= root
    xy *= xy
    xy *= 4
    root += xy
    np.sqrt(root, out=root)
    xx += yy
    xx -= root
    xx *= 0.5
    np.maximum(xx, 1e-6, out=xx)
    np.sqrt(xx, out=xx)
    softness = np.divide(1, xx, out=xx)
    mean = cv2.boxFilter(grey, cv2.CV_32F, size)
    np.subtract(grey, mean, out=mean)
    np.abs(mean, out=mean)
    contrast = cv2.boxFilter(mean, cv2.CV_32F, size)
    return np.asarray(softness, np.float32), np.asarray(contrast, np.float32)
