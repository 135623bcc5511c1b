"""Measure the parallax of the pairs of a database, and whether they determine depth."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.check.contents import Images, Pairs
from colmap_av1.database.layout import columns
from colmap_av1.database.reading import matches_from_row
from colmap_av1.geometry.cameras import camera_fault
from colmap_av1.matching.depth import LEAST_MATCHES, DepthEvidence, depth_evidence
from colmap_av1.matching.mapper_limits import INITIAL_MAX_FORWARD_MOTION, INITIAL_MIN_INLIERS
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewConfig

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


def parallax_of(
    connection: sqlite3.Connection,
    path: Path,
    images: Images,
    pairs: Pairs,
    cameras: dict[int, pycolmap.Camera],
) -> Parallax | None:
    """Measure the displacement of the widest pair and the triangulation angle of the best pairs.

    Args:
        connection: the open database.
        path: its path, for messages.
        images: its images.
        pairs: its pairs.
        cameras: its cameras by camera id.

    Returns:
        None if mappers use no pair.
    """
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
    """Whether the pairs that mappers use determine depth, see `depth_evidence`.

    Args:
        connection: the open database.
        path: its path, for messages.
        images: its images.
        pairs: its pairs.
        cameras: its cameras by camera id.
    """
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
