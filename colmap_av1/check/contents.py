"""Read the images and pairs of a COLMAP database for `check`."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.layout import columns
from colmap_av1.database.reading import image_ids_from_pair_id, matches_from_row, stored_keypoints
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.matching.depth import LEAST_MATCHES, DepthEvidence, depth_evidence, motion_spread
from colmap_av1.matching.mapper_limits import (
    INITIAL_MAX_FORWARD_MOTION,
    INITIAL_MIN_INLIERS,
    MIN_INLIERS,
)
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, UNUSED_CONFIGS, TwoViewConfig
from colmap_av1.util.arrays import Bools, Floats, Ints

# The model that determines the pose, by configuration. Other configurations have no single model.
_MODEL_OF_CONFIG = {
    TwoViewConfig.CALIBRATED: "E",
    TwoViewConfig.CALIBRATED_RIG: "E",
    TwoViewConfig.UNCALIBRATED: "F",
    **dict.fromkeys(FLAT_CONFIGS, "H"),
}
# Number of pairs whose triangulation angle is computed, and the quantile of these angles that is
# reported. The maximum is not used, because a wrong model may give any angle.
_NUM_DEEPEST = 24
_ANGLE_QUANTILE = 0.9
# The last camera model of COLMAP 3.8.
_LAST_OLD_MODEL = int(pycolmap.CameraModelId.THIN_PRISM_FISHEYE)


@dataclass(frozen=True)
class Parallax:
    """The parallax of the images.

    Attributes:
        names: names of the images of the widest pair.
        displacement: median distance between its matching keypoints, in pixels.
        angle: a high quantile, in degrees, of the triangulation angles of the pairs whose keypoint
            displacements differ most; None if none of these pairs has a model.
        focal_known: whether the angle was computed with focal length priors only.
        forward_share: share of these pairs that move along the optical axis.
    """

    names: tuple[str, str]
    displacement: float
    angle: float | None
    focal_known: bool
    forward_share: float

    @property
    def is_forward(self) -> bool:
        """Whether the camera moves along its axis: most pairs are no initial pair of the mapper."""
        return self.focal_known and self.forward_share > 0.5


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


def readers_of(cameras: Iterable[pycolmap.Camera], of_layout: str) -> str:
    """COLMAP versions that open a database.

    Args:
        cameras: its cameras.
        of_layout: versions that open its layout.
    """
    newer = {c.model_name for c in cameras if int(c.model) > _LAST_OLD_MODEL}
    needed = ", ".join(sorted(newer))
    return f"{of_layout}, if they have the camera model {needed}" if newer else of_layout


def layout_of(connection: sqlite3.Connection) -> tuple[str, str]:
    """COLMAP versions that write this layout, and versions that open it."""
    oldest = "prior_qw" in columns(connection, "images")
    newest = "pose_prior_id" in columns(connection, "pose_priors")
    if newest:
        migrated = ("3.8 or 3.9, migrated by 4.x", "3.8, 3.9 and 4.x")
        return migrated if oldest else ("4.x", "4.x")
    if oldest:
        return "3.8 or 3.9", "3.8 and later"
    framed = bool(columns(connection, "frames"))
    return ("3.12 or 3.13" if framed else "3.10 or 3.11"), "3.10 and later"


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
    num_matches = dict(connection.execute("SELECT pair_id, rows FROM matches").fetchall())
    matched = [np.zeros(len(k), dtype=np.bool_) for k in images.keypoints]
    rows: dict[int, tuple[int, int, float, float]] = {}
    num_points = [len(k) for k in images.keypoints]
    astray: set[int] = set()
    for pair_id, num_rows, data in connection.execute("SELECT pair_id, rows, data FROM matches"):
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


def parallax_of(
    connection: sqlite3.Connection,
    path: Path,
    images: Images,
    pairs: Pairs,
    cameras: dict[int, pycolmap.Camera],
) -> Parallax | None:
    """Measure the displacement of the widest pair and the triangulation angle of the best pairs."""
    used = np.flatnonzero(pairs.used)
    if used.size == 0:
        return None
    # The mapper starts with pairs of many inliers. If there are none, all used pairs count.
    strong = used[pairs.num_inliers[used] >= INITIAL_MIN_INLIERS]
    candidates = strong if strong.size else used
    deepest = candidates[np.argsort(-pairs.spread[candidates], kind="stable")]
    angles, forward, known = [], [], True
    for pair in deepest[:_NUM_DEEPEST]:
        i, j = pairs.index[pair]
        if not {images.camera_ids[i], images.camera_ids[j]} <= cameras.keys():
            continue
        ends = [cameras[images.camera_ids[k]] for k in (i, j)]
        geometry = _read_geometry(connection, path, int(pairs.ids[pair]))
        limits = [len(images.keypoints[i]), len(images.keypoints[j])]
        if geometry is None or (geometry.inlier_matches >= limits).any():
            continue
        if pycolmap.estimate_two_view_geometry_pose(
            ends[0], images.keypoints[i], ends[1], images.keypoints[j], geometry
        ):
            pose = geometry.cam2_from_cam1
            assert pose is not None
            angles.append(np.rad2deg(geometry.tri_angle))
            forward.append(abs(pose.translation[2]) >= INITIAL_MAX_FORWARD_MOTION)
            known = known and all(camera.has_prior_focal_length for camera in ends)
    widest = candidates[np.argmax(pairs.displacement[candidates])]
    i, j = pairs.index[widest]
    return Parallax(
        names=(images.names[i], images.names[j]),
        displacement=float(pairs.displacement[widest]),
        angle=float(np.quantile(angles, _ANGLE_QUANTILE)) if angles else None,
        focal_known=known and bool(angles),
        forward_share=float(np.mean(forward)) if forward else 0.0,
    )


def depth_of(
    connection: sqlite3.Connection,
    path: Path,
    images: Images,
    pairs: Pairs,
    cameras: dict[int, pycolmap.Camera],
) -> DepthEvidence:
    """Whether the pairs that mappers use determine depth, see `depth_evidence`."""
    used = np.flatnonzero(pairs.used & (pairs.num_inliers >= LEAST_MATCHES))
    counts = np.array([len(xy) for xy in images.keypoints])

    def inliers(pair: int) -> NDArray[np.integer]:
        rows = matches_from_row(
            path,
            int(pairs.ids[used[pair]]),
            *connection.execute(
                "SELECT rows, data FROM two_view_geometries WHERE pair_id = ?",
                (int(pairs.ids[used[pair]]),),
            ).fetchone(),
        )
        there = (rows < counts[pairs.index[used[pair]]]).all(axis=1)
        return np.asarray(rows[there])

    return depth_evidence(
        images.keypoints,
        pairs.index[used],
        pairs.spread[used],
        inliers,
        [
            camera if (camera := cameras.get(own)) and camera_fault(camera) is None else None
            for own in images.camera_ids
        ],
    )


def _read_geometry(
    connection: sqlite3.Connection, path: Path, pair_id: int
) -> pycolmap.TwoViewGeometry | None:
    """Read a two-view geometry; None if the model that its configuration needs is missing."""
    stored = columns(connection, "two_view_geometries")
    names = [name for name in ("E", "F", "H") if name in stored]
    num_rows, data, config, *blobs = connection.execute(
        f"SELECT {', '.join(['rows', 'data', 'config', *names])} FROM two_view_geometries "
        "WHERE pair_id = ?",
        (pair_id,),
    ).fetchone()
    models = {
        name: np.frombuffer(blob, dtype="<f8").reshape(3, 3)
        for name, blob in zip(names, blobs, strict=True)
        if blob is not None and len(blob) == 72
    }
    if _MODEL_OF_CONFIG.get(config) not in models:
        return None
    geometry = pycolmap.TwoViewGeometry()
    if config == TwoViewConfig.CALIBRATED_RIG:
        # COLMAP takes no pose from this configuration, although its E is an ordinary one.
        config = TwoViewConfig.CALIBRATED
    geometry.config = pycolmap.TwoViewGeometryConfiguration(config)
    geometry.inlier_matches = matches_from_row(path, pair_id, num_rows, data)
    for name, model in models.items():
        setattr(geometry, name, model)
    return geometry
