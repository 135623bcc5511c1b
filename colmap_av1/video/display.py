"""How players show the pictures of a video: cropped, rotated, with non-square pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Largest difference of an entry of a display matrix, its columns scaled to length 1, from a
# rotation by a multiple of 90 degrees.
_QUARTER_TURN_TOLERANCE = 0.02

Turn = tuple[tuple[int, int], tuple[int, int]]

UPRIGHT: Turn = ((1, 0), (0, 1))


@dataclass(frozen=True)
class Display:
    """How players show the pictures of a stream, compared with how they are stored.

    Attributes:
        crop: pixels to crop at the left, top, right and bottom of stored pictures.
        turn: ((a, b), (c, d)), a rotation by a multiple of 90 degrees, a reflection, or both: a
            point stored at (x, y) from the centre, x right and y down, is shown at
            (a x + b y, c x + d y).
        pixel_aspect: width of a shown pixel divided by its height.
    """

    crop: tuple[int, int, int, int] = (0, 0, 0, 0)
    turn: Turn = UPRIGHT
    pixel_aspect: float = 1.0

    @property
    def rotation(self) -> int:
        """The rotation in degrees counter-clockwise, without the reflection."""
        (a, b), _ = self.turn
        if a:
            return 0 if a > 0 else 180
        return 90 if b > 0 else 270

    @property
    def is_mirrored(self) -> bool:
        """Whether the pictures are also reflected, along y after the rotation."""
        (a, b), (c, d) = self.turn
        return a * d - b * c < 0


def turn_of_matrix(matrix: Sequence[int]) -> Turn | None:
    """The rotation and reflection that a container's display matrix describes.

    Args:
        matrix: the 9 values of ISO/IEC 14496-12, 8.3.2: a, b, u, c, d, v, x, y, w.

    Returns:
        The turn as in `Display`; None if the angle is not a multiple of 90 degrees.
    """
    a, b, c, d = matrix[0], matrix[1], matrix[3], matrix[4]
    # The matrix maps (1, 0) and (0, 1) to these columns, and may also scale.
    columns = np.array([[a, c], [b, d]], dtype=np.float64)
    lengths = np.hypot(columns[0], columns[1])
    if not lengths.all():
        return None
    columns /= lengths
    turn = np.rint(columns)
    if np.abs(columns - turn).max() > _QUARTER_TURN_TOLERANCE or abs(np.linalg.det(turn)) != 1:
        return None
    (p, q), (r, s) = turn.astype(int).tolist()
    return ((p, q), (r, s))


def turned_back(display: Display) -> Display:
    """The inverse, from shown pictures back to stored ones; cropped pixels are not restored."""
    (a, b), (c, d) = display.turn
    aspect = display.pixel_aspect if a else 1 / display.pixel_aspect
    return Display(turn=((a, c), (b, d)), pixel_aspect=aspect)


def shown_size(size: tuple[int, int], display: Display) -> tuple[int, int]:
    """(width, height) in pixels at which stored pictures of a given size are shown."""
    left, top, right, bottom = display.crop
    width, height = size[0] - left - right, size[1] - top - bottom
    return (width, height) if display.turn[0][0] else (height, width)


def shown_picture(stored: NDArray[np.uint8], display: Display) -> NDArray[np.uint8]:
    """Crop and rotate a stored picture, uint8 [height, width, 3], as players show it."""
    left, top, right, bottom = display.crop
    height, width = stored.shape[:2]
    picture = stored[top : height - bottom, left : width - right]
    (a, b), (c, d) = display.turn
    if a == 0:
        picture = picture.transpose(1, 0, 2)
    if a + b < 0:
        picture = picture[:, ::-1]
    if c + d < 0:
        picture = picture[::-1]
    return np.ascontiguousarray(picture)


def shown_points(
    stored: NDArray[np.float32], size: tuple[int, int], display: Display
) -> NDArray[np.float32]:
    """Map points of stored pictures to the pictures as shown.

    Args:
        stored: float32 [n, 2] (x, y) in pixels, origin at the stored picture's top-left corner.
        size: (width, height) of the stored pictures.
        display: how they are shown.

    Returns:
        float32 [n, 2], origin at the shown picture's top-left corner; points that are cropped
        lie outside the picture. The same array if pictures are shown as they are stored.
    """
    if display.turn == UPRIGHT and not any(display.crop):
        return stored
    turn = np.array(display.turn, dtype=np.float32)
    left, top, _, _ = display.crop
    points = (stored - np.array([left, top], dtype=np.float32)) @ turn.T
    # Coordinates along a reversed axis are measured from the opposite edge.
    points += np.where(turn.sum(axis=1) < 0, shown_size(size, display), 0)
    return np.asarray(points, dtype=np.float32)
