"""Check, without changing it, what COLMAP's mappers will do with a database."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_av1.check.contents import images_with_rows, pairs_with_rows
from colmap_av1.check.findings import (
    Finding,
    frame_findings,
    gap_findings,
    image_findings,
    keypoint_findings,
    motion_findings,
    orphan_findings,
    pair_findings,
    value_findings,
)
from colmap_av1.check.parallax import Parallax, depth_of, parallax_of
from colmap_av1.check.versions import layout_of, readers_of
from colmap_av1.database.file import is_new, open_unaltered
from colmap_av1.database.reading import cameras_of
from colmap_av1.errors import DatabaseError
from colmap_av1.images.names import videos_of
from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.few_matches import few_match_gaps
from colmap_av1.matching.gaps import Gap
from colmap_av1.matching.two_view_geometry import config_name
from colmap_av1.util.graphs import connected_components


@dataclass(frozen=True)
class DatabaseCheck:
    """Contents of a database, and what the mappers will do with it.

    Attributes:
        database: the database file.
        user_version: the number by which COLMAP distinguishes layouts.
        layout: versions of COLMAP that write this layout.
        readers: versions of COLMAP that open it.
        num_images: number of images.
        num_cameras: number of cameras.
        num_priors: number of cameras with a focal length prior.
        image_sizes: number of images by (width, height) in pixels.
        num_keypoints: number of keypoints of all images.
        num_matched_keypoints: number of keypoints that are inliers of a pair that mappers use.
        keypoint_columns: number of images by the columns of their keypoints: 2 (x, y), 4 (with
            scale and orientation) or 6 (with an affine shape).
        num_described_images: number of images with descriptors.
        num_pairs: number of pairs with inliers.
        num_used_pairs: number of pairs that the mappers use.
        num_empty_pairs: number of pairs that were matched without result.
        num_inliers: number of inliers of all pairs that mappers use.
        configs: number of pairs with inliers by COLMAP's name of their configuration.
        num_connected_images: number of images in the largest group that used pairs connect.
        parallax: parallax of the widest pairs; None if no pair is used.
        depth: whether the pairs determine depth.
        few_match_gaps: gaps between images of a video with few matches across them.
        findings: the findings, most severe first.
    """

    database: Path
    user_version: int
    layout: str
    readers: str
    num_images: int
    num_cameras: int
    num_priors: int
    image_sizes: dict[tuple[int, int], int]
    num_keypoints: int
    num_matched_keypoints: int
    keypoint_columns: dict[int, int]
    num_described_images: int
    num_pairs: int
    num_used_pairs: int
    num_empty_pairs: int
    num_inliers: int
    configs: dict[str, int]
    num_connected_images: int
    parallax: Parallax | None
    depth: DepthEvidence
    few_match_gaps: tuple[Gap, ...]
    findings: tuple[Finding, ...]

    @property
    def mappable(self) -> bool:
        """Whether the mappers can use the database: no finding is an error."""
        return all(finding.severity != "error" for finding in self.findings)

    @property
    def damaged(self) -> bool:
        """Whether the file is damaged, even if mappers work around the damage."""
        return any(finding.damage for finding in self.findings)


def check_database(database: str | os.PathLike[str]) -> DatabaseCheck:
    """Check what the mappers will do with a COLMAP database of any version.

    The database is not changed or migrated, and no file is created next to it. The thresholds are
    the defaults of COLMAP's mappers.

    Args:
        database: path of the file.

    Raises:
        DatabaseError: the file is missing, locked, unreadable, or not a COLMAP database.

    Examples:
        >>> from colmap_av1 import check_database
        >>> report = check_database("my.db")
        >>> report.num_images, report.image_sizes
        (10, {(640, 360): 10})
        >>> report.mappable, report.findings
        (True, ())
    """
    path = Path(database)
    if is_new(path):
        what = "is an empty file" if path.exists() else "no such file"
        raise DatabaseError(f"{path}: {what}: give the path of a COLMAP database")
    with open_unaltered(path) as connection:
        return _check(connection, path)


def _check(connection: sqlite3.Connection, path: Path) -> DatabaseCheck:
    cameras = cameras_of(connection, path)
    images = images_with_rows(connection, path)
    pairs = pairs_with_rows(connection, path, images)
    used = pairs.used
    layout, readers = layout_of(connection)
    group = 0
    if used.any():
        connected = connected_components(len(images.ids), pairs.index[used])
        group = int(np.bincount(connected).max())
    parallax = parallax_of(connection, path, images, pairs, cameras)
    depth = depth_of(connection, path, images, pairs, cameras)
    configs = Counter(config_name(c) for c in pairs.config[pairs.num_inliers > 0].tolist())
    sizes = Counter(
        (int(cameras[c].width), int(cameras[c].height)) for c in images.camera_ids if c in cameras
    )
    keypoint_columns = Counter(n for n in images.columns if n > 0)
    videos = videos_of(images.camera_ids, images.names)
    gaps = few_match_gaps(pairs.index[used], pairs.num_inliers[used], images.names, videos)
    findings = [
        *image_findings(images, cameras),
        *value_findings(images, pairs, cameras),
        *frame_findings(connection, images),
        *keypoint_findings(images, pairs),
        *pair_findings(pairs, images),
        *motion_findings(pairs, parallax, depth, group, len(images.ids)),
        *gap_findings(gaps),
        *orphan_findings(connection, pairs),
    ]
    order = ("error", "warning", "note")
    return DatabaseCheck(
        database=path,
        user_version=connection.execute("PRAGMA user_version").fetchone()[0],
        layout=layout,
        readers=readers_of(cameras.values(), readers),
        num_images=len(images.ids),
        num_cameras=len(cameras),
        num_priors=sum(bool(camera.has_prior_focal_length) for camera in cameras.values()),
        image_sizes=dict(sorted(sizes.items())),
        num_keypoints=sum(map(len, images.keypoints)),
        num_matched_keypoints=sum(int(np.count_nonzero(m)) for m in pairs.matched),
        keypoint_columns=dict(sorted(keypoint_columns.items())),
        num_described_images=sum(n > 0 for n in images.num_descriptors),
        num_pairs=int(np.count_nonzero(pairs.num_inliers > 0)),
        num_used_pairs=int(np.count_nonzero(used)),
        num_empty_pairs=int(np.count_nonzero((pairs.num_inliers == 0) & (pairs.num_matches <= 0))),
        num_inliers=int(pairs.num_inliers[used].sum()),
        configs=dict(sorted(configs.items())),
        num_connected_images=group,
        parallax=parallax,
        depth=depth,
        few_match_gaps=gaps,
        findings=tuple(sorted(findings, key=lambda finding: order.index(finding.severity))),
    )
