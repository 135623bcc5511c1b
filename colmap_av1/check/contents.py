"""Read the images and pairs of a COLMAP database for `check`."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.layout import columns
from colmap_av1.database.reading import image_ids_from_pair_id, matches_from_row, stored_keypoints
from colmap_av1.matching.depth import motion_spread
from colmap_av1.matching.mapper_limits import MIN_INLIERS
from colmap_av1.matching.two_view_geometry import UNUSED_CONFIGS
from colmap_av1.util.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class Images:
    """The images of a database, in the order of their ids.

    Attributes:
        ids: int64 [n] image ids.
        names: name of each image.
        camera_ids: camera id of each image.
        keypoints: float32 [k, 2] keypoint positions of each image, in pixels.
        columns: number of keypoint columns of each image; 0 if it has no row of keypoints.
        num_descriptors: number of descriptors of each image; -1 if it has no row of descriptors.
    """

    ids: Ints
    names: list[str]
    camera_ids: list[int]
    keypoints: list[NDArray[np.float32]]
    columns: list[int]
    num_descriptors: list[int]


@dataclass(frozen=True)
class Pairs:
    """Pairs of listed images that have a row of matches or of a two-view geometry.

    Attributes:
        ids: int64 [m] pair ids.
        index: int64 [m, 2] indices of the two images in `Images`.
        num_matches: int64 [m]; -1 if there is no row.
        num_inliers: int64 [m]; -1 if there is no row.
        config: int64 [m] configuration of the geometry.
        displacement: float64 [m] median distance between matching keypoints, in pixels.
        spread: float64 [m] spread of these displacements, in pixels. Parallax makes it large, a
            rotation of the camera much less.
        matched: for each image, bool [k] keypoints that are inliers of a used pair.
        num_astray: number of pairs with matches, verified or not, of missing keypoints.
        num_with_itself: number of pairs of an image with itself.
        num_swapped: number of pairs whose first image has the larger id.
        num_foreign: number of pairs of unlisted images that have enough inliers to be used.
    """

    ids: Ints
    index: Ints
    num_matches: Ints
    num_inliers: Ints
    config: Ints
    displacement: Floats
    spread: Floats
    matched: list[Bools]
    num_astray: int
    num_with_itself: int
    num_swapped: int
    num_foreign: int

    @property
    def used(self) -> Bools:
        """Pairs that the mappers of all COLMAP versions use, bool [m]."""
        return (self.num_inliers >= MIN_INLIERS) & ~np.isin(self.config, UNUSED_CONFIGS)


def images_with_rows(connection: sqlite3.Connection, path: Path) -> Images:
    """Read the images with their keypoints and descriptors."""
    rows = connection.execute(
        "SELECT image_id, name, camera_id FROM images ORDER BY image_id"
    ).fetchall()
    index_of = {row[0]: i for i, row in enumerate(rows)}
    keypoints = [np.empty((0, 2), dtype=np.float32)] * len(rows)
    num_columns, num_descriptors = [0] * len(rows), [-1] * len(rows)
    for image_id, *row in connection.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        if image_id in index_of:
            num_columns[index_of[image_id]] = row[1]
            if row[0]:
                keypoints[index_of[image_id]] = stored_keypoints(path, image_id, *row)[:, :2]
    if columns(connection, "descriptors"):
        for image_id, count in connection.execute("SELECT image_id, rows FROM descriptors"):
            if image_id in index_of:
                num_descriptors[index_of[image_id]] = count
    return Images(
        ids=np.array([row[0] for row in rows], dtype=np.int64),
        names=[row[1] for row in rows],
        camera_ids=[row[2] for row in rows],
        keypoints=keypoints,
        columns=num_columns,
        num_descriptors=num_descriptors,
    )


def pairs_with_rows(connection: sqlite3.Connection, path: Path, images: Images) -> Pairs:
    """Read the pairs one by one, because all matches of a large database do not fit in memory."""
    index_of = {int(image_id): i for i, image_id in enumerate(images.ids)}
    num_matches: dict[int, int] = {}
    matched = [np.zeros(len(k), dtype=np.bool_) for k in images.keypoints]
    rows: dict[int, tuple[int, int, float, float]] = {}
    num_points = [len(k) for k in images.keypoints]
    astray: set[int] = set()
    for pair_id, num_rows, data in connection.execute("SELECT pair_id, rows, data FROM matches"):
        num_matches[pair_id] = num_rows
        i, j = (index_of.get(image_id, -1) for image_id in image_ids_from_pair_id(pair_id))
        found = matches_from_row(path, pair_id, num_rows, data)
        if min(i, j) >= 0 and len(found) and (found >= [num_points[i], num_points[j]]).any():
            astray.add(pair_id)
    for pair_id, num_rows, data, config in connection.execute(
        "SELECT pair_id, rows, data, config FROM two_view_geometries"
    ):
        rows[pair_id] = (num_rows, config, 0.0, 0.0)
        i, j = (index_of.get(image_id, -1) for image_id in image_ids_from_pair_id(pair_id))
        if min(i, j) < 0 or num_rows == 0:
            continue
        inliers = matches_from_row(path, pair_id, num_rows, data)
        there = (inliers < [num_points[i], num_points[j]]).all(axis=1)
        if not there.all():
            astray.add(pair_id)
        a, b = inliers[there].T
        if len(a):
            xa, xb = images.keypoints[i][a], images.keypoints[j][b]
            length = float(np.median(np.hypot(*(xb.astype(np.float64) - xa).T)))
            rows[pair_id] = (num_rows, config, length, motion_spread(xa, xb))
        if num_rows >= MIN_INLIERS and config not in UNUSED_CONFIGS:
            matched[i][a] = matched[j][b] = True
    pair_ids = np.array(sorted(rows.keys() | num_matches.keys()), dtype=np.int64)
    index = np.array(
        [[index_of.get(i, -1) for i in image_ids_from_pair_id(int(p))] for p in pair_ids],
        dtype=np.int64,
    ).reshape(-1, 2)
    listed = (index >= 0).all(axis=1)
    kept = [int(p) for p in pair_ids[listed]]
    geometry = np.array([rows.get(p, (-1, 0, 0.0, 0.0)) for p in kept]).reshape(-1, 4)
    return Pairs(
        ids=pair_ids[listed],
        index=index[listed],
        num_matches=np.array([num_matches.get(p, -1) for p in kept], dtype=np.int64),
        num_inliers=geometry[:, 0].astype(np.int64),
        config=geometry[:, 1].astype(np.int64),
        displacement=geometry[:, 2],
        spread=geometry[:, 3],
        matched=matched,
        num_astray=len(astray),
        num_with_itself=int(np.count_nonzero(index[listed][:, 0] == index[listed][:, 1])),
        num_swapped=int(np.count_nonzero(index[listed][:, 0] > index[listed][:, 1])),
        num_foreign=sum(rows.get(int(p), (-1,))[0] >= MIN_INLIERS for p in pair_ids[~listed]),
    )
