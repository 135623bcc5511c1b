"""Rows of COLMAP's database: cameras, images, keypoints, matches, two-view geometries.

A new file has the layout of COLMAP 3.8, the oldest still in use: later versions read it and
migrate it, while older ones refuse what later ones make. An existing file keeps its layout,
so columns are always named and only those present are written. SQLite is used directly,
because opening a file with pycolmap migrates it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import secrets
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import DatabaseError, OptionError
from colmap_av1.options import CameraOptions
from colmap_av1.pairs import ImageKeypoints
from colmap_av1.verify import TwoViewGeometry

# COLMAP's kMaxNumImages: image ids stay below it, and it spreads pair ids.
MAX_NUM_IMAGES = 2147483647

_USER_VERSION = 3800
# Seconds to wait for another writer: one that is only closing a file is soon done.
_BUSY_TIMEOUT = 2.0

_SCHEMA = (
    "CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
    "model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, "
    "prior_focal_length INTEGER NOT NULL)",
    "CREATE TABLE images (image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
    "name TEXT NOT NULL UNIQUE, camera_id INTEGER NOT NULL, "
    "prior_qw REAL, prior_qx REAL, prior_qy REAL, prior_qz REAL, "
    "prior_tx REAL, prior_ty REAL, prior_tz REAL, "
    f"CONSTRAINT image_id_check CHECK(image_id >= 0 and image_id < {MAX_NUM_IMAGES}), "
    "FOREIGN KEY(camera_id) REFERENCES cameras(camera_id))",
    "CREATE UNIQUE INDEX index_name ON images(name)",
    "CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)",
    "CREATE TABLE descriptors (image_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)",
    "CREATE TABLE matches (pair_id INTEGER PRIMARY KEY NOT NULL, rows INTEGER NOT NULL, "
    "cols INTEGER NOT NULL, data BLOB)",
    "CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY NOT NULL, "
    "rows INTEGER NOT NULL, cols INTEGER NOT NULL, data BLOB, config INTEGER NOT NULL, "
    "F BLOB, E BLOB, H BLOB, qvec BLOB, tvec BLOB)",
)

# Columns without which a file is not a COLMAP database; others are written where present.
_REQUIRED_COLUMNS = {
    "cameras": {"camera_id", "model", "width", "height", "params", "prior_focal_length"},
    "images": {"image_id", "name", "camera_id"},
    "keypoints": {"image_id", "rows", "cols", "data"},
    "matches": {"pair_id", "rows", "cols", "data"},
    "two_view_geometries": {"pair_id", "rows", "cols", "data", "config"},
}


@dataclass(frozen=True)
class DatabaseImage:
    """An image that a database lists.

    Attributes:
        image_id: its id.
        name: path relative to the image folder.
        camera_id: id of its camera.
        width: width of the camera in pixels.
        height: height of the camera in pixels.
        num_keypoints: keypoints stored for it.
        num_matches: matches stored with other images, verified or not.
    """

    image_id: int
    name: str
    camera_id: int
    width: int
    height: int
    num_keypoints: int
    num_matches: int


def make_camera(options: CameraOptions, width: int, height: int) -> pycolmap.Camera:
    """Make the camera of new images.

    Without parameters it is COLMAP's first guess, without a focal length prior: focal length
    1.2 times the longer side, principal point in the centre, no distortion. Given parameters
    count as a prior.

    Args:
        options: camera model and parameters.
        width: image width in pixels.
        height: image height in pixels.

    Raises:
        OptionError: the model is unknown, or the parameters do not fit it.
    """
    names = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    if options.camera_model not in names:
        raise OptionError(
            f"unknown camera model {options.camera_model!r}: give one of {', '.join(names)}"
        )
    model = pycolmap.CameraModelId.__members__[options.camera_model]
    create = getattr(pycolmap.Camera, "create_from_model_id", None) or pycolmap.Camera.create
    camera = create(0, model, 1.2 * max(width, height), width, height)
    if len(camera.focal_length_idxs()) == 0:
        raise OptionError(
            f"camera model {options.camera_model} has no focal length, so it does not fit a "
            "video: give a perspective or fisheye model such as SIMPLE_RADIAL"
        )
    camera.has_prior_focal_length = options.camera_params is not None
    if options.camera_params is not None:
        camera.params = _parse_camera_params(options.camera_params, camera)
    return camera


def _parse_camera_params(text: str, camera: pycolmap.Camera) -> list[float]:
    wanted = f"{camera.model_name} takes {len(camera.params)} numbers, {camera.params_info}"
    try:
        params = [float(word) for word in text.split(",")]
    except ValueError:
        raise OptionError(f"cannot read camera_params {text!r}: {wanted}") from None
    if len(params) != len(camera.params) or not all(map(math.isfinite, params)):
        raise OptionError(f"camera_params {text!r} do not fit: {wanted}")
    if min(params[i] for i in camera.focal_length_idxs()) <= 0:
        raise OptionError(f"camera_params {text!r} hold a focal length of 0 or less: {wanted}")
    return params


def pair_id_from_image_ids(image_id1: int, image_id2: int) -> int:
    """Id of the pair of two images; their order does not matter."""
    return MAX_NUM_IMAGES * min(image_id1, image_id2) + max(image_id1, image_id2)


def image_ids_from_pair_id(pair_id: int) -> tuple[int, int]:
    """Ids of a pair's images, the smaller one first."""
    return pair_id // MAX_NUM_IMAGES, pair_id % MAX_NUM_IMAGES


def read_images(database: str | os.PathLike[str]) -> list[DatabaseImage]:
    """List the images of a database, by id.

    Returns:
        The images; none for a file that is absent, empty, or lists none.

    Raises:
        DatabaseError: the file is locked, unreadable, or not a COLMAP database.
    """
    path = Path(database)
    if _is_new(path):
        return []
    with _connect(path) as connection:
        _check_layout(connection, path)
        rows = connection.execute(
            "SELECT image_id, name, camera_id, COALESCE(width, 0), COALESCE(height, 0), "
            "COALESCE(keypoints.rows, 0) FROM images LEFT JOIN cameras USING (camera_id) "
            "LEFT JOIN keypoints USING (image_id) ORDER BY image_id"
        ).fetchall()
        # A pair is counted once, though it has its matches in one table or in both.
        pair_rows = connection.execute(
            "SELECT pair_id, MAX(rows) FROM (SELECT pair_id, rows FROM matches UNION ALL "
            "SELECT pair_id, rows FROM two_view_geometries) WHERE rows > 0 GROUP BY pair_id"
        ).fetchall()
    num_matches: dict[int, int] = {}
    for pair_id, count in pair_rows:
        for image_id in image_ids_from_pair_id(pair_id):
            num_matches[image_id] = num_matches.get(image_id, 0) + count
    return [
        DatabaseImage(
            image_id, name, camera_id, width, height, num_keypoints, num_matches.get(image_id, 0)
        )
        for image_id, name, camera_id, width, height, num_keypoints in rows
    ]


def read_cameras(database: str | os.PathLike[str]) -> dict[int, pycolmap.Camera]:
    """Read the cameras of a database, by id.

    Raises:
        DatabaseError: the file is locked, unreadable, or not a COLMAP database, or has a
            camera of a model that the installed pycolmap does not know.
    """
    path = Path(database)
    if _is_new(path):
        return {}
    with _connect(path) as connection:
        _check_layout(connection, path)
        rows = connection.execute(
            "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras "
            "ORDER BY camera_id"
        ).fetchall()
    models = {int(model.value): model for model in pycolmap.CameraModelId.__members__.values()}
    cameras = {}
    for camera_id, model, width, height, params, prior in rows:
        camera = pycolmap.Camera(
            camera_id=camera_id,
            model=models.get(model, pycolmap.CameraModelId.INVALID),
            width=width,
            height=height,
            params=np.frombuffer(params or b"", dtype="<f8"),
        )
        if model not in models or not camera.verify_params():
            raise DatabaseError(
                f"{path}: camera {camera_id} has model {model} with {len(camera.params)} "
                "parameters, which pycolmap does not know: update pycolmap"
            )
        camera.has_prior_focal_length = bool(prior)
        cameras[camera_id] = camera
    return cameras


def write_matches(
    database: str | os.PathLike[str],
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera] | None,
    keypoints: Sequence[ImageKeypoints],
    *,
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    geometries: Sequence[TwoViewGeometry],
) -> None:
    """Write keypoints, matches and two-view geometries: all rows, or none.

    A file that is absent or empty is made; where it lists no images, cameras and images are
    inserted. Where it lists images, the rows go to those of the given names, and their
    cameras stay as they are. Rows of these images that hold nothing, as matchers leave them
    for pairs they could not match, are replaced.

    Args:
        database: path of the file.
        names: name of each image, its path relative to the image folder.
        cameras: the camera of all images, or one for each; may be None where the database
            lists the images.
        keypoints: keypoints of each image.
        pairs: int32 [m, 2] indices of images.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        geometries: for each pair, its verified geometry.

    Raises:
        DatabaseError: the file is locked, not a COLMAP database, lists other images, already
            has keypoints or matches of these images, or cannot be written (no space, no
            permission). The file is then as it was.
    """
    path = Path(database)
    if not (len(names) == len(keypoints) and len(pairs) == len(matches) == len(geometries)):
        raise ValueError("give one name for each image, and matches and geometry for each pair")
    if len(set(names)) != len(names) or "" in names:
        raise DatabaseError("two images have the same name, or one has none: name each by itself")

    for (i, j), pair_matches in zip(pairs, matches, strict=True):
        limits = (len(keypoints[i].xy), len(keypoints[j].xy))
        if len(pair_matches) and np.any(pair_matches.max(axis=0) >= limits):
            raise ValueError(f"matches of images {i} and {j} name keypoints that are not there")

    def fill(connection: sqlite3.Connection) -> None:
        image_ids = _find_images(connection, path, names)
        if image_ids is None:
            image_ids = _insert_images(connection, path, names, cameras)
        _check_nothing_lost(connection, path, dict(zip(image_ids, names, strict=True)))
        _insert_keypoints(connection, image_ids, keypoints)
        _insert_pairs(connection, _order_pairs(image_ids, pairs), matches, geometries)

    if _is_new(path):
        _write_new(path, fill)
    else:
        _write_existing(path, fill)


def _is_new(path: Path) -> bool:
    """Whether the file is absent or empty, so that making it loses nothing."""
    if path.is_dir():
        raise DatabaseError(f"{path} is a folder: give the path of a database file")
    if path.exists() and path.stat().st_size > 0:
        return False
    if not path.resolve().parent.is_dir():
        raise DatabaseError(f"{path}: the folder does not exist: make it first")
    for suffix in ("-journal", "-wal"):
        # SQLite would replay such a file into whatever database appears beside it.
        leftover = path.with_name(path.name + suffix)
        if leftover.exists():
            raise DatabaseError(f"{leftover} is left from another database: remove it first")
    return True


@contextlib.contextmanager
def _connect(path: Path, named: Path | None = None) -> Iterator[sqlite3.Connection]:
    """Open a file that exists and close it at the end; SQLite's errors become ours.

    Args:
        path: file to open.
        named: path that messages name, where it differs.
    """
    named = named if named is not None else path
    try:
        with contextlib.closing(
            sqlite3.connect(
                f"{path.resolve().as_uri()}?mode=rw",
                uri=True,
                timeout=_BUSY_TIMEOUT,
                isolation_level=None,
            )
        ) as connection:
            yield connection
    except sqlite3.Error as error:
        raise DatabaseError(_explain(named, error)) from error


def _explain(path: Path, error: sqlite3.Error) -> str:
    text = str(error)
    causes = {
        "locked": "it is in use by another process: wait until that is done, or end it",
        "busy": "it is in use by another process: wait until that is done, or end it",
        "not a database": "it is not a COLMAP database: give another path",
        "malformed": "it is damaged: restore it from a copy, or give another path",
        "full": "the disk is full: free some space",
        "disk I/O error": "it cannot be read or written (disk full, quota, or a failing disk)",
        "readonly": "it may not be written: change its permissions, or give another path",
        "unable to open": "it cannot be opened: check the path and its permissions",
    }
    for sign, cause in causes.items():
        if sign in text:
            return f"{path}: {cause}"
    return f"{path}: SQLite refuses: {text}"


def _write_new(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Make a database under another name in the same folder, then give it its own."""
    target = path.resolve()
    partial = target.with_name(f".{target.name}.{secrets.token_hex(8)}.partial")
    try:
        partial.touch(exist_ok=False)
        with _connect(partial, named=path) as connection:
            # The file is thrown away on any failure: nothing needs to be rolled back.
            connection.execute("PRAGMA journal_mode = OFF")
            connection.execute("BEGIN EXCLUSIVE")
            for statement in _SCHEMA:
                connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {_USER_VERSION}")
            fill(connection)
            connection.execute("COMMIT")
        if not _is_new(path):
            raise DatabaseError(f"{path} was made by another process meanwhile: run again")
        partial.replace(target)
    except OSError as error:
        raise DatabaseError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)


def _write_existing(path: Path, fill: Callable[[sqlite3.Connection], None]) -> None:
    """Add to a database in one transaction."""
    with _connect(path) as connection:
        connection.execute("BEGIN IMMEDIATE")
        try:
            _check_layout(connection, path)
            fill(connection)
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def _columns(connection: sqlite3.Connection, table: str) -> set[str]:
    return {row[1] for row in connection.execute(f"PRAGMA table_info({table})")}


def _check_layout(connection: sqlite3.Connection, path: Path) -> None:
    for table, required in _REQUIRED_COLUMNS.items():
        missing = required - _columns(connection, table)
        if missing:
            what = "table" if missing == required else f"{sorted(missing)[0]!r} in table"
            raise DatabaseError(
                f"{path}: it is not a COLMAP database (no {what} {table!r}): give another path"
            )


def _find_images(
    connection: sqlite3.Connection, path: Path, names: Sequence[str]
) -> list[int] | None:
    """Ids of the named images; None where the database lists no images at all."""
    listed = dict(connection.execute("SELECT name, image_id FROM images").fetchall())
    if not listed:
        return None
    for name in names:
        if name not in listed:
            raise DatabaseError(
                f"{path} lists {len(listed)} images, but not {name!r}: use images by the names "
                "it lists, or a new database"
            )
    return [listed[name] for name in names]


def _insert_images(
    connection: sqlite3.Connection,
    path: Path,
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera] | None,
) -> list[int]:
    # COLMAP makes rigs and frames by itself, but only where there are none: images without
    # a frame beside images with one stop it.
    for table in ("rigs", "frames"):
        if _columns(connection, table) and _has_rows(connection, table):
            raise DatabaseError(
                f"{path} has {table} but no images: import its images first, or use a new database"
            )
    if cameras is None:
        raise ValueError("give a camera: the database lists no images")
    shared = isinstance(cameras, pycolmap.Camera)
    rows: list[Any] = [cameras] if shared else list(cameras)
    if not shared and len(rows) != len(names):
        raise ValueError("give one camera, or one for each image")
    (first_id,) = connection.execute(
        "SELECT COALESCE(MAX(camera_id), 0) + 1 FROM cameras"
    ).fetchone()
    connection.executemany(
        "INSERT INTO cameras (camera_id, model, width, height, params, prior_focal_length) "
        "VALUES (?, ?, ?, ?, ?, ?)",
        (
            (
                first_id + i,
                int(camera.model.value),
                int(camera.width),
                int(camera.height),
                np.asarray(camera.params, dtype="<f8").tobytes(),
                int(camera.has_prior_focal_length),
            )
            for i, camera in enumerate(rows)
        ),
    )
    image_ids = list(range(1, len(names) + 1))
    connection.executemany(
        "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)",
        (
            (image_id, name, first_id if shared else first_id + image_id - 1)
            for image_id, name in zip(image_ids, names, strict=True)
        ),
    )
    return image_ids


def _has_rows(connection: sqlite3.Connection, table: str) -> bool:
    return connection.execute(f"SELECT 1 FROM {table} LIMIT 1").fetchone() is not None


def _check_nothing_lost(
    connection: sqlite3.Connection, path: Path, name_of_id: dict[int, str]
) -> None:
    """Refuse to replace keypoints, or matches that refer to them."""
    way_out = "use a database without them, such as a new one"
    for (image_id,) in connection.execute("SELECT image_id FROM keypoints WHERE rows > 0"):
        if image_id in name_of_id:
            raise DatabaseError(
                f"{path} already has keypoints of image {name_of_id[image_id]!r}: {way_out}"
            )
    for (pair_id,) in connection.execute(
        "SELECT pair_id FROM matches WHERE rows > 0 "
        "UNION SELECT pair_id FROM two_view_geometries WHERE rows > 0"
    ):
        for image_id in image_ids_from_pair_id(pair_id):
            if image_id in name_of_id:
                raise DatabaseError(
                    f"{path} already has matches of image {name_of_id[image_id]!r}: {way_out}"
                )


def _insert_keypoints(
    connection: sqlite3.Connection, image_ids: Sequence[int], keypoints: Sequence[ImageKeypoints]
) -> None:
    connection.executemany(
        "INSERT OR REPLACE INTO keypoints (image_id, rows, cols, data) VALUES (?, ?, 2, ?)",
        (
            (image_id, len(k.xy), k.xy.astype("<f4").tobytes())
            for image_id, k in sorted(
                zip(image_ids, keypoints, strict=True), key=lambda row: row[0]
            )
        ),
    )


def _order_pairs(image_ids: Sequence[int], pairs: NDArray[np.int32]) -> list[tuple[int, int, bool]]:
    """Rows (pair id, index of the pair, whether its images swap), by pair id.

    COLMAP's columns follow the smaller image id, whatever the order of the images.
    """
    rows = []
    for index, (i, j) in enumerate(pairs):
        ids = image_ids[i], image_ids[j]
        rows.append((pair_id_from_image_ids(*ids), index, ids[0] > ids[1]))
    rows.sort()
    if len({row[0] for row in rows}) != len(rows):
        raise ValueError("a pair of images is given twice")
    return rows


def _insert_pairs(
    connection: sqlite3.Connection,
    order: Sequence[tuple[int, int, bool]],
    matches: Sequence[NDArray[np.uint32]],
    geometries: Sequence[TwoViewGeometry],
) -> None:
    connection.executemany(
        "INSERT OR REPLACE INTO matches (pair_id, rows, cols, data) VALUES (?, ?, 2, ?)",
        (
            (pair_id, len(matches[index]), _matches_blob(matches[index], swap))
            for pair_id, index, swap in order
        ),
    )
    present = _columns(connection, "two_view_geometries")
    models = [name for name in ("F", "E", "H", "qvec", "tvec") if name in present]
    columns = ["pair_id", "rows", "cols", "data", "config", *models]

    def row(pair_id: int, geometry: TwoViewGeometry, swap: bool) -> tuple[Any, ...]:
        inliers = _matches_blob(geometry.inlier_matches, swap)
        if swap:
            geometry = _swap_images(geometry)
        blobs = (_float_blob(getattr(geometry, name)) for name in models)
        num_inliers = len(geometry.inlier_matches)
        return (pair_id, num_inliers, 2, inliers, int(geometry.config), *blobs)

    connection.executemany(
        f"INSERT OR REPLACE INTO two_view_geometries ({', '.join(columns)}) "
        f"VALUES ({', '.join('?' * len(columns))})",
        (row(pair_id, geometries[index], swap) for pair_id, index, swap in order),
    )


def _matches_blob(matches: NDArray[np.uint32], swap: bool) -> bytes:
    return np.asarray(matches[:, ::-1] if swap else matches, dtype="<u4").tobytes()


def _float_blob(values: NDArray[np.float64] | None) -> bytes | None:
    return None if values is None else np.asarray(values, dtype="<f8").tobytes()


def _swap_images(geometry: TwoViewGeometry) -> TwoViewGeometry:
    """The models of the same geometry from the second image to the first.

    The columns of `inlier_matches` stay as they are.
    """
    qvec = tvec = H = None
    if geometry.qvec is not None and geometry.tvec is not None:
        w, x, y, z = geometry.qvec
        qvec = np.array([w, -x, -y, -z])
        tvec = -_rotation(qvec) @ geometry.tvec
    if geometry.H is not None and np.linalg.cond(geometry.H) < 1 / np.finfo(np.float64).eps:
        H = np.asarray(np.linalg.inv(geometry.H), dtype=np.float64)
    return dataclasses.replace(
        geometry,
        E=None if geometry.E is None else geometry.E.T,
        F=None if geometry.F is None else geometry.F.T,
        H=H,
        qvec=qvec,
        tvec=tvec,
    )


def _rotation(qvec: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, (x, y, z) = qvec[0], qvec[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)
