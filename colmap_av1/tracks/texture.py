"""How well the windows of a picture can be found again, by their texture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def texture_at(
    image: NDArray[np.uint8], at: NDArray[np.int64], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The texture, see `texture_of`, around some pixels (x, y) [n, 2] of a picture."""
    width = 2 * (window + 1) + 1  # two windows, one around every pixel of the other, and a gradient
    if len(at) * width**2 >= image.size:
        softness, contrast = texture_of(image, window)
        return softness[at[:, 1], at[:, 0]], contrast[at[:, 1], at[:, 0]]
    # Patches below each other, as one picture.
    framed = np.pad(image, width // 2, mode="reflect")
    patches = np.lib.stride_tricks.sliding_window_view(framed, (width, width))
    softness, contrast = texture_of(patches[at[:, 1], at[:, 0]].reshape(-1, width), window)
    return softness[width // 2 :: width, width // 2], contrast[width // 2 :: width, width // 2]


def texture_of(
    image: NDArray[np.uint8], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The texture of the window around every pixel.

    Returns:
        float32 [height, width] standard deviation in pixels of a match in the worst direction
        where every pixel has a noise of one grey level, and mean deviation in grey levels.
    """
    grey = image.astype(np.float32)
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    size = (window, window)
    # In place: new memory for arrays of large pictures takes longer than what is done in it.
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
