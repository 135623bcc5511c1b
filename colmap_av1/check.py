"""What COLMAP's mappers will make of a database, found without altering it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database import (
    cameras_of,
    image_ids_from_pair_id,
    keypoints_from_row,
    matches_from_row,
)
from colmap_av1.database_file import check_layout, columns, is_new, open_unaltered
from colmap_av1.errors import DatabaseError

# COLMAP's kinds of two-view geometry, by number.
_CONFIGS = (
    "UNDEFINED",
    "DEGENERATE",
    "CALIBRATED",
    "UNCALIBRATED",
    "PLANAR",
    "PANORAMIC",
    "PLANAR_OR_PANORAMIC",
    "WATERMARK",
    "MULTIPLE",
)
_IGNORED_CONFIGS = ("UNDEFINED", "DEGENERATE", "WATERMARK")
_FLAT_CONFIGS = ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")

# Defaults of COLMAP's mappers: inliers of a pair they use, of one they start with, and the
# angles of one they start with, at first and after halving it twice.
_MIN_INLIERS = 15
_MIN_INITIAL_INLIERS = 100
_INITIAL_ANGLE, _LEAST_INITIAL_ANGLE = 16.0, 4.0
_MAX_FORWARD_MOTION = 0.95
# Share of keypoints without a match that is worth a line.
_NOTED_SHARE = 0.01
# Pairs whose geometry is computed for the parallax, and the quantile of their angles that is
# taken for the largest: a wrong model may give any angle.
_NUM_DEEPEST = 24
_LARGEST = 0.9

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that a mapper's user should know of a database.

    Attributes:
        severity: "error": mappers stop or find nothing; "warning": a part is lost, or some
            program stops; "note": nothing is wrong.
        text: one line.
    """

    severity: Severity
    text: str


@dataclass(frozen=True)
class Parallax:
    """How far apart the views are.

    Attributes:
        names: names of the images of the widest pair.
        displacement: median distance between its matching keypoints, in pixels.
        angle: median triangulation angle, in degrees, that the best pairs reach: those whose
            keypoints move most unlike each other; None where none of them has a model.
        focal_known: the angle rests on focal lengths that are known beforehand.
        forward_share: share of these pairs whose motion is along the camera's axis.
    """

    names: tuple[str, str]
    displacement: float
    angle: float | None
    focal_known: bool
    forward_share: float


@dataclass(frozen=True)
class CheckReport:
    """What a database holds, and what the mappers will make of it.

    Attributes:
        database: the database file.
        user_version: the number by which COLMAP tells layouts apart.
        layout: versions of COLMAP whose layout it is.
        readers: versions of COLMAP that open it.
        num_images: images listed.
        num_cameras: cameras listed.
        num_priors: cameras with a focal length known beforehand.
        image_sizes: number of images by (width, height) in pixels.
        num_keypoints: keypoints of all images.
        num_matched_keypoints: those that are inliers of a pair that mappers use.
        keypoint_columns: number of images by the columns of their keypoints: 2: x, y; 4: scale
            and orientation too; 6: an affine shape too.
        num_described_images: images with descriptors.
        num_pairs: pairs with inliers.
        num_used_pairs: those that the mappers use.
        num_empty_pairs: pairs that matchers tried in vain.
        num_inliers: inliers of all pairs that mappers use.
        configs: number of pairs with inliers by COLMAP's name of their geometry.
        num_connected_images: images of the largest group that used pairs connect.
        parallax: of the widest pairs; None where no pair is used.
        findings: what stands out, most severe first.
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
    findings: tuple[Finding, ...]

    @property
    def mappable(self) -> bool:
        """Whether nothing was found that stops the mappers."""
        return all(finding.severity != "error" for finding in self.findings)


def check(database: str | os.PathLike[str]) -> CheckReport:
    """Read a COLMAP database of any version and say what the mappers will make of it.

    The file is opened so that neither it nor anything beside it changes: it is not migrated,
    and no log is made. The thresholds are the defaults of COLMAP's mappers.

    Args:
        database: path of the file.

    Raises:
        DatabaseError: the file is missing, locked, unreadable, or not a COLMAP database.
    """
    path = Path(database)
    if is_new(path):
        what = "is an empty file" if path.exists() else "no such file"
        raise DatabaseError(f"{path}: {what}: give the path of a COLMAP database")
    with open_unaltered(path) as connection:
        check_layout(connection, path)
        return _check(connection, path)


@dataclass(frozen=True)
class _Images:
    """Images by id, ascending, with what is stored for each.

    Attributes:
        ids: int64 [n].
        names: their names.
        camera_ids: their cameras.
        keypoints: float32 [k, 2] positions of each one's keypoints.
        columns: columns of each one's keypoints; 0 where there is no row.
        num_descriptors: descriptors of each one; -1 where there is no row.
    """

    ids: NDArray[np.int64]
    names: list[str]
    camera_ids: list[int]
    keypoints: list[NDArray[np.float32]]
    columns: list[int]
    num_descriptors: list[int]


@dataclass(frozen=True)
class _Pairs:
    """Pairs of listed images that have a row, in any of the two tables.

    Attributes:
        ids: int64 [m] pair ids.
        index: int64 [m, 2] place of their images in `_Images`.
        num_matches: int64 [m]; -1 where there is no row.
        num_inliers: int64 [m]; -1 where there is no row.
        config: int64 [m] kind of geometry.
        displacement: float64 [m] median distance of the inliers' keypoints, in pixels.
        spread: float64 [m] how far these displacements differ, in pixels: parallax does that,
            and a turn of the camera much less.
        matched: for each image, bool [k] the keypoints that are inliers of a used pair.
        num_astray: pairs with matches of keypoints that are not there.
        num_foreign: pairs of images that are not listed, but with inliers enough to be used.
    """

    ids: NDArray[np.int64]
    index: NDArray[np.int64]
    num_matches: NDArray[np.int64]
    num_inliers: NDArray[np.int64]
    config: NDArray[np.int64]
    displacement: NDArray[np.float64]
    spread: NDArray[np.float64]
    matched: list[NDArray[np.bool_]]
    num_astray: int
    num_foreign: int

    @property
    def used(self) -> NDArray[np.bool_]:
        """Pairs that the mappers of all versions use."""
        ignored = [_CONFIGS.index(name) for name in _IGNORED_CONFIGS]
        return (self.num_inliers >= _MIN_INLIERS) & ~np.isin(self.config, ignored)


def _check(connection: sqlite3.Connection, path: Path) -> CheckReport:
    cameras = cameras_of(connection, path)
    images = _read_images(connection, path)
    pairs = _read_pairs(connection, path, images)
    used = pairs.used
    layout, readers = _layout(connection)
    group = _largest_group(len(images.ids), pairs.index[used])
    parallax = _parallax(connection, path, images, pairs, cameras)
    configs = [_name_of_config(c) for c in pairs.config[pairs.num_inliers > 0].tolist()]
    sizes = [
        (int(cameras[c].width), int(cameras[c].height)) for c in images.camera_ids if c in cameras
    ]
    findings = [
        *_image_findings(images, cameras),
        *_frame_findings(connection, images),
        *_keypoint_findings(images, pairs),
        *_pair_findings(pairs, images),
        *_motion_findings(pairs, parallax, group, len(images.ids)),
        *_orphan_findings(connection, pairs),
    ]
    order = ("error", "warning", "note")
    return CheckReport(
        database=path,
        user_version=connection.execute("PRAGMA user_version").fetchone()[0],
        layout=layout,
        readers=readers,
        num_images=len(images.ids),
        num_cameras=len(cameras),
        num_priors=sum(bool(camera.has_prior_focal_length) for camera in cameras.values()),
        image_sizes={size: sizes.count(size) for size in sorted(set(sizes))},
        num_keypoints=sum(map(len, images.keypoints)),
        num_matched_keypoints=sum(int(np.count_nonzero(m)) for m in pairs.matched),
        keypoint_columns={n: images.columns.count(n) for n in sorted(set(images.columns) - {0})},
        num_described_images=sum(n > 0 for n in images.num_descriptors),
        num_pairs=int(np.count_nonzero(pairs.num_inliers > 0)),
        num_used_pairs=int(np.count_nonzero(used)),
        num_empty_pairs=int(np.count_nonzero((pairs.num_inliers == 0) & (pairs.num_matches <= 0))),
        num_inliers=int(pairs.num_inliers[used].sum()),
        configs={name: configs.count(name) for name in sorted(set(configs))},
        num_connected_images=group,
        parallax=parallax,
        findings=tuple(sorted(findings, key=lambda finding: order.index(finding.severity))),
    )


def _layout(connection: sqlite3.Connection) -> tuple[str, str]:
    """Versions of COLMAP that lay out a file so, and those that open it."""
    oldest = "prior_qw" in columns(connection, "images")
    newest = "pose_prior_id" in columns(connection, "pose_priors")
    if newest:
        migrated = ("3.8 or 3.9, migrated by 4.x", "3.8, 3.9 and 4.x")
        return migrated if oldest else ("4.x", "4.x")
    if oldest:
        return "3.8 or 3.9", "3.8 and later"
    framed = bool(columns(connection, "frames"))
    return ("3.12 or 3.13" if framed else "3.10 or 3.11"), "3.10 and later"


def _read_images(connection: sqlite3.Connection, path: Path) -> _Images:
    rows = connection.execute(
        "SELECT image_id, name, camera_id FROM images ORDER BY image_id"
    ).fetchall()
    place = {row[0]: i for i, row in enumerate(rows)}
    keypoints = [np.empty((0, 2), dtype=np.float32)] * len(rows)
    num_columns, num_descriptors = [0] * len(rows), [-1] * len(rows)
    for image_id, *row in connection.execute("SELECT image_id, rows, cols, data FROM keypoints"):
        if image_id in place:
            num_columns[place[image_id]] = row[1]
            if row[0]:
                keypoints[place[image_id]] = keypoints_from_row(path, image_id, *row)[:, :2]
    if columns(connection, "descriptors"):
        for image_id, count in connection.execute("SELECT image_id, rows FROM descriptors"):
            if image_id in place:
                num_descriptors[place[image_id]] = count
    return _Images(
        ids=np.array([row[0] for row in rows], dtype=np.int64),
        names=[row[1] for row in rows],
        camera_ids=[row[2] for row in rows],
        keypoints=keypoints,
        columns=num_columns,
        num_descriptors=num_descriptors,
    )


def _read_pairs(connection: sqlite3.Connection, path: Path, images: _Images) -> _Pairs:
    """Read pair by pair: the matches of a large database do not fit into memory."""
    place = {int(image_id): i for i, image_id in enumerate(images.ids)}
    num_matches = dict(connection.execute("SELECT pair_id, rows FROM matches").fetchall())
    matched = [np.zeros(len(k), dtype=np.bool_) for k in images.keypoints]
    rows: dict[int, tuple[int, int, float, float]] = {}
    num_astray = 0
    ignored = [_CONFIGS.index(name) for name in _IGNORED_CONFIGS]
    for pair_id, num_rows, data, config in connection.execute(
        "SELECT pair_id, rows, data, config FROM two_view_geometries"
    ):
        rows[pair_id] = (num_rows, config, 0.0, 0.0)
        i, j = (place.get(image_id, -1) for image_id in image_ids_from_pair_id(pair_id))
        if min(i, j) < 0 or num_rows == 0:
            continue
        inliers = matches_from_row(path, pair_id, num_rows, data)
        there = (inliers < [len(images.keypoints[i]), len(images.keypoints[j])]).all(axis=1)
        num_astray += not there.all()
        a, b = inliers[there].T
        if len(a):
            step = images.keypoints[j][b].astype(np.float64) - images.keypoints[i][a]
            spread = np.hypot(*np.subtract(*np.quantile(step, (0.9, 0.1), axis=0)))
            rows[pair_id] = (num_rows, config, np.median(np.hypot(*step.T)), spread)
        if num_rows >= _MIN_INLIERS and config not in ignored:
            matched[i][a] = matched[j][b] = True
    pair_ids = np.array(sorted(rows.keys() | num_matches.keys()), dtype=np.int64)
    index = np.array(
        [[place.get(i, -1) for i in image_ids_from_pair_id(int(p))] for p in pair_ids],
        dtype=np.int64,
    ).reshape(-1, 2)
    listed = (index >= 0).all(axis=1)
    kept = [int(p) for p in pair_ids[listed]]
    geometry = np.array([rows.get(p, (-1, 0, 0.0, 0.0)) for p in kept]).reshape(-1, 4)
    return _Pairs(
        ids=pair_ids[listed],
        index=index[listed],
        num_matches=np.array([num_matches.get(p, -1) for p in kept], dtype=np.int64),
        num_inliers=geometry[:, 0].astype(np.int64),
        config=geometry[:, 1].astype(np.int64),
        displacement=geometry[:, 2],
        spread=geometry[:, 3],
        matched=matched,
        num_astray=num_astray,
        num_foreign=sum(rows.get(int(p), (-1,))[0] >= _MIN_INLIERS for p in pair_ids[~listed]),
    )


def _largest_group(num_images: int, edges: NDArray[np.int64]) -> int:
    if len(edges) == 0:
        return 0
    # Slow to import, and nothing else of the package's daily work needs it.
    from scipy.sparse import coo_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    graph = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(num_images, num_images))
    _, label = connected_components(graph, directed=False)
    return int(np.bincount(label).max())


def _parallax(
    connection: sqlite3.Connection,
    path: Path,
    images: _Images,
    pairs: _Pairs,
    cameras: dict[int, pycolmap.Camera],
) -> Parallax | None:
    """Displacement of the widest pair, and the angles that the best pairs reach."""
    used = np.flatnonzero(pairs.used)
    if used.size == 0:
        return None
    # The mapper starts with pairs of many inliers; without one, any used pair will do.
    strong = used[pairs.num_inliers[used] >= _MIN_INITIAL_INLIERS]
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
            angles.append(np.rad2deg(geometry.tri_angle))
            forward.append(abs(geometry.cam2_from_cam1.translation[2]) >= _MAX_FORWARD_MOTION)
            known = known and all(camera.has_prior_focal_length for camera in ends)
    widest = candidates[np.argmax(pairs.displacement[candidates])]
    i, j = pairs.index[widest]
    return Parallax(
        names=(images.names[i], images.names[j]),
        displacement=float(pairs.displacement[widest]),
        angle=float(np.quantile(angles, _LARGEST)) if angles else None,
        focal_known=known and bool(angles),
        forward_share=float(np.mean(forward)) if forward else 0.0,
    )


def _read_geometry(
    connection: sqlite3.Connection, path: Path, pair_id: int
) -> pycolmap.TwoViewGeometry | None:
    """A stored geometry; None where the model that its kind needs is missing."""
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
    kind = _name_of_config(config)
    needed = {"CALIBRATED": "E", "UNCALIBRATED": "F"}.get(kind, "H")
    if kind == "MULTIPLE" or kind not in _CONFIGS or needed not in models:
        return None
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration(config)
    geometry.inlier_matches = matches_from_row(path, pair_id, num_rows, data)
    for name, model in models.items():
        setattr(geometry, name, model)
    return geometry


def _name_of_config(config: int) -> str:
    """COLMAP's name of a kind of geometry; the number of one that it has none for."""
    return _CONFIGS[config] if 0 <= config < len(_CONFIGS) else str(config)


def _image_findings(images: _Images, cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    if len(images.ids) == 0:
        yield Finding("error", "lists no images")
        return
    lost = [n for n, c in zip(images.names, images.camera_ids, strict=True) if c not in cameras]
    if lost:
        yield Finding("error", f"{_some(lost, 'image')} without a camera: the mappers stop")
    unknown = sum(not camera.has_prior_focal_length for camera in cameras.values())
    if unknown:
        yield Finding(
            "note",
            f"{unknown} of {len(cameras)} cameras have no focal length known beforehand: the "
            "mappers start from a guess and refine it",
        )
    sizes = {(c.width, c.height) for i, c in cameras.items() if i in set(images.camera_ids)}
    if len(sizes) > 1:
        yield Finding("note", f"images have {len(sizes)} sizes")
    if images.names != sorted(images.names):
        yield Finding("note", "image ids do not follow the order of names: match by name, not id")


def _frame_findings(connection: sqlite3.Connection, images: _Images) -> Iterator[Finding]:
    if not (columns(connection, "frames") and columns(connection, "frame_data")):
        return
    rigs = dict(
        connection.execute("SELECT rig_id, ref_sensor_id FROM rigs WHERE ref_sensor_type = 0")
    )
    framed = {
        row[0] for row in connection.execute("SELECT data_id FROM frame_data WHERE sensor_type = 0")
    }
    if framed or connection.execute("SELECT 1 FROM frames LIMIT 1").fetchone():
        bare = [
            name
            for image_id, name in zip(images.ids, images.names, strict=True)
            if int(image_id) not in framed
        ]
        if bare:
            yield Finding(
                "error",
                f"{_some(bare, 'image')} without a frame, others with one: mappers from COLMAP "
                "3.12 on stop; 'colmap-av1 match' completes the frames",
            )
    elif rigs and any(rigs.get(camera_id) != camera_id for camera_id in images.camera_ids):
        yield Finding("error", "has rigs but no frames: mappers from COLMAP 3.12 on stop")


def _keypoint_findings(images: _Images, pairs: _Pairs) -> Iterator[Finding]:
    counts = [len(k) for k in images.keypoints]
    if counts and not any(counts):
        yield Finding("error", "no image has keypoints: extract and match features first")
        return
    in_pair = np.zeros(len(counts), dtype=np.bool_)
    in_pair[pairs.index[pairs.num_inliers >= _MIN_INLIERS].ravel()] = True
    bare = [n for n, c, p in zip(images.names, counts, in_pair, strict=True) if p and not c]
    if bare:
        yield Finding(
            "error", f"{_some(bare, 'image')} with matches but without keypoints: most mappers stop"
        )
    elif pairs.num_astray:
        yield Finding(
            "warning",
            f"{pairs.num_astray} pairs match keypoints that are not there: mappers leave such "
            "matches out",
        )
    empty = [n for n, c in zip(images.names, counts, strict=True) if not c]
    if empty and not bare:
        yield Finding("warning", f"{_some(empty, 'image')} without keypoints")
    uneven = [
        name
        for name, count, described in zip(images.names, counts, images.num_descriptors, strict=True)
        if described not in (-1, count)
    ]
    if uneven:
        yield Finding(
            "warning",
            f"{_some(uneven, 'image')} with another number of descriptors than of keypoints: "
            "guided matching and vocabulary trees stop, mappers do not mind",
        )
    total, matched = sum(counts), sum(int(np.count_nonzero(m)) for m in pairs.matched)
    if total - matched > _NOTED_SHARE * total:
        yield Finding("note", f"{(total - matched) / total:.1%} of the keypoints have no match")


def _pair_findings(pairs: _Pairs, images: _Images) -> Iterator[Finding]:
    used = pairs.used
    unverified = np.count_nonzero((pairs.num_matches >= _MIN_INLIERS) & (pairs.num_inliers < 0))
    if unverified:
        yield Finding(
            "warning",
            f"{unverified} pairs have matches that were never verified: mappers leave them out; "
            "run a matcher of COLMAP, which verifies them",
        )
    if any(map(len, images.keypoints)) and not used.any():
        yield Finding("error", f"no pair has {_MIN_INLIERS} verified matches: mappers find nothing")
    few = np.count_nonzero((pairs.num_inliers > 0) & (pairs.num_inliers < _MIN_INLIERS))
    if few:
        yield Finding(
            "note", f"{few} pairs have fewer than {_MIN_INLIERS} inliers: mappers leave them out"
        )
    for config, why in (
        ("UNDEFINED", "their geometry was never estimated: mappers from COLMAP 4.2 on"),
        ("DEGENERATE", "their geometry is degenerate: mappers from COLMAP 4.2 on"),
        ("WATERMARK", "they match a watermark: mappers"),
    ):
        count = np.count_nonzero(
            (pairs.num_inliers >= _MIN_INLIERS) & (pairs.config == _CONFIGS.index(config))
        )
        if count:
            yield Finding(
                "note" if config == "WATERMARK" else "warning",
                f"{count} pairs have inliers, but {why} leave them out",
            )
    multiple = np.count_nonzero(used & (pairs.config == _CONFIGS.index("MULTIPLE")))
    if multiple:
        yield Finding(
            "note", f"{multiple} pairs have several geometries: the global mapper leaves them out"
        )
    unpaired = np.count_nonzero(used & (pairs.num_matches < 0))
    if unpaired:
        yield Finding(
            "warning",
            f"{unpaired} verified pairs have no row in 'matches': standalone GLOMAP leaves them "
            "out, and matchers of COLMAP match them again",
        )
    empty = np.count_nonzero((pairs.num_inliers == 0) & (pairs.num_matches <= 0))
    if empty:
        yield Finding(
            "note", f"{empty} pairs were matched in vain: matchers skip them, writers replace them"
        )


def _motion_findings(
    pairs: _Pairs, parallax: Parallax | None, group: int, num_images: int
) -> Iterator[Finding]:
    used = pairs.used
    if parallax is None:
        return
    if group < num_images:
        yield Finding(
            "warning",
            f"pairs connect at most {group} of {num_images} images: the others stay out of the "
            "model, or go to another one",
        )
    if pairs.num_inliers[used].max() < _MIN_INITIAL_INLIERS:
        yield Finding(
            "warning",
            f"no pair has {_MIN_INITIAL_INLIERS} inliers: the incremental mapper starts with "
            "none unless --Mapper.init_min_num_inliers is lower",
        )
    flat = np.isin(pairs.config[used], [_CONFIGS.index(name) for name in _FLAT_CONFIGS])
    if np.mean(flat) > 0.5:
        yield Finding(
            "warning",
            f"{np.mean(flat):.0%} of the pairs see a plane or a camera that only turns: there is "
            "little depth to find",
        )
    if parallax.angle is None:
        yield Finding("note", "parallax is unknown: the widest pairs have no model stored")
    elif parallax.angle < _LEAST_INITIAL_ANGLE:
        yield Finding(
            "warning",
            f"parallax of {parallax.angle:.1f} degrees: the incremental mapper may find no start, "
            "take the global one",
        )
    elif parallax.angle < _INITIAL_ANGLE:
        yield Finding(
            "note",
            f"parallax of {parallax.angle:.1f} degrees: the incremental mapper starts "
            "only after lowering its limit",
        )
    if parallax.focal_known and parallax.forward_share > 0.5:
        yield Finding(
            "warning",
            "the camera moves along its axis: the incremental mapper starts only with "
            "--Mapper.init_max_forward_motion 1, and the focal length cannot be found",
        )


def _orphan_findings(connection: sqlite3.Connection, pairs: _Pairs) -> Iterator[Finding]:
    if pairs.num_foreign:
        yield Finding(
            "error",
            f"{pairs.num_foreign} pairs are of images that are not listed: mappers from COLMAP "
            "3.12 on stop",
        )
    for table in ("keypoints", "descriptors"):
        if not columns(connection, table):
            continue
        (count,) = connection.execute(
            f"SELECT COUNT(*) FROM {table} WHERE image_id NOT IN (SELECT image_id FROM images)"
        ).fetchone()
        if count:
            yield Finding("note", f"{count} rows of '{table}' belong to no image")


def _some(names: Sequence[str], what: str) -> str:
    """A count and an example, such as "3 images (a.png, ...)"."""
    plural = "s" if len(names) > 1 else ""
    return f"{len(names)} {what}{plural} ({names[0]}{', ...' if plural else ''})"
