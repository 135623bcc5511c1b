"""Draw the matches of two images of a database."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.file import open_unaltered
from colmap_av1.database.reading import (
    image_ids_from_pair_id,
    matches_from_row,
    pair_id_from_image_ids,
    read_keypoints,
)
from colmap_av1.errors import DatabaseError, ImageError
from colmap_av1.images.files import read_image
from colmap_av1.images.names import image_file
from colmap_av1.util.arrays import Picture
from colmap_av1.view.pictures import bgr, side_by_side
from colmap_av1.view.video import SHIFT, fixed_point

_MAX_LINES = 300


def view_database(
    database: str | os.PathLike[str],
    image_path: str | os.PathLike[str],
    pair: Sequence[str] | None = None,
) -> Picture:
    """Draw the matches between two images of a COLMAP database.

    Args:
        database: any COLMAP database; it is not changed.
        image_path: folder of its images.
        pair: names of two images; None: the pair with the most inliers.

    Returns:
        uint8 BGR picture with the images side by side, wide ones above each other, and their inlier
        matches drawn as lines. If the pair was not verified, all its matches are drawn.

    Raises:
        DatabaseError: the file is not a COLMAP database, or has no matches of the pair.
        ImageError: an image is missing or unreadable.
    """
    path = Path(database)
    names, keypoints, matches = _read_pair(path, pair)
    pictures = []
    for name, xy in zip(names, keypoints, strict=True):
        picture = read_image(image_file(Path(image_path), name))
        if len(xy) and np.any(xy.max(axis=0) > [picture.shape[1], picture.shape[0]]):
            raise ImageError(
                f"{Path(image_path) / name}: the image is smaller than the positions of its "
                "keypoints: give the images that were matched"
            )
        pictures.append(picture)
    return _draw_matches(pictures[0], pictures[1], keypoints[0], keypoints[1], matches)


def _read_pair(
    path: Path, pair: Sequence[str] | None
) -> tuple[tuple[str, str], list[NDArray[np.float32]], NDArray[np.uint32]]:
    """Names of a pair, keypoints [n, 2] of both images, and matches [m, 2] between them."""
    with open_unaltered(path) as connection:
        images = dict(connection.execute("SELECT name, image_id FROM images").fetchall())
        if pair is None:
            for table in ("two_view_geometries", "matches"):  # the second has unverified ones, too
                row = connection.execute(
                    f"SELECT pair_id FROM {table} WHERE rows > 0 "
                    "ORDER BY rows DESC, pair_id LIMIT 1"
                ).fetchone()
                if row is not None:
                    break
            if row is None:
                raise DatabaseError(f"{path}: has no matches: run 'colmap-av1 match' first")
            ids = image_ids_from_pair_id(row[0])
        else:
            missing = next((name for name in pair if name not in images), None)
            if missing is not None:
                raise DatabaseError(
                    f"{path}: has no image {missing!r}: give two images of the database"
                )
            ids = (images[pair[0]], images[pair[1]])
        pair_id = pair_id_from_image_ids(*ids)
        matches = np.empty((0, 2), dtype=np.uint32)
        for table in ("two_view_geometries", "matches"):
            row = connection.execute(
                f"SELECT rows, data FROM {table} WHERE pair_id = ?", (pair_id,)
            ).fetchone()
            if row is not None and row[0] > 0:
                matches = matches_from_row(path, pair_id, *row)
                break
        name_of = {image_id: name for name, image_id in images.items()}
        if not {*ids} <= name_of.keys():
            raise DatabaseError(
                f"{path}: has matches of images that are not listed: give a pair of listed images"
            )
        names = (name_of[ids[0]], name_of[ids[1]])
        if len(matches) == 0:
            raise DatabaseError(
                f"{path}: has no matches of {names[0]!r} and {names[1]!r}: give another pair"
            )
        keypoints = [read_keypoints(connection, path, image_id)[:, :2] for image_id in ids]
    if ids[0] > ids[1]:
        matches = matches[:, ::-1]
    if np.any(matches.max(axis=0) >= [len(k) for k in keypoints]):
        raise DatabaseError(
            f"{path}: {names[0]!r} and {names[1]!r} match keypoints that do not exist: run "
            "'colmap-av1 check' for a full list of problems"
        )
    return names, keypoints, matches


def _draw_matches(
    first: Picture,
    second: Picture,
    keypoints1: NDArray[np.float32],
    keypoints2: NDArray[np.float32],
    matches: NDArray[np.uint32],
) -> Picture:
    """Draw matches between two pictures: at most _MAX_LINES, spread over the first picture."""
    height, width = np.maximum(first.shape[:2], second.shape[:2])
    panels = [
        np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)))
        for image in (first, second)
    ]
    picture = side_by_side(panels)
    shift = np.array([picture.shape[1] - width, picture.shape[0] - height], dtype=np.float32)
    a, b = keypoints1[matches[:, 0]], keypoints2[matches[:, 1]]
    # Sorting by coarse rows makes every n-th match evenly spread over the image.
    order = np.lexsort((a[:, 0], a[:, 1] // 16))
    chosen = order[:: max(1, math.ceil(len(order) / _MAX_LINES))]
    hue = np.linspace(0, 179, len(chosen))
    full = np.full(len(chosen), 255.0)
    ends = np.stack([a[chosen], b[chosen] + shift], axis=1)
    for line, colour in zip(fixed_point(ends), bgr(hue, full, full), strict=True):
        cv2.polylines(picture, [line], False, colour.tolist(), 1, cv2.LINE_AA, SHIFT)
        for point in line:
            cv2.circle(picture, point.tolist(), 2 << SHIFT, colour.tolist(), -1, cv2.LINE_AA, SHIFT)
    return picture
