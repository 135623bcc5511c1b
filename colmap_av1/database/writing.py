"""Writing images, keypoints, matches and two-view geometries to a database, all or nothing."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.file import is_new, write_existing, write_new
from colmap_av1.database.layout import columns, has_rows
from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.database.writing_frames import complete_frames, write_places
from colmap_av1.database.writing_keypoints import append_keypoints
from colmap_av1.database.writing_pairs import append_pairs, order_pairs
from colmap_av1.errors import DatabaseError
from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.options import OnExisting


def write_matched_images(
    database: str | os.PathLike[str],
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera] | None,
    matched: MatchedImages,
    on_existing: OnExisting = "error",
    *,
    places: NDArray[np.float64] | None = None,
) -> None:
    """Write matched images with their keypoints, matches and geometries, see `write_matches`."""
    write_matches(
        database,
        names,
        cameras,
        matched.keypoints,
        pairs=matched.pairs,
        matches=matched.matches,
        geometries=matched.geometries,
        on_existing=on_existing,
        places=places,
    )


def write_matches(
    database: str | os.PathLike[str],
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera] | None,
    keypoints: Sequence[ImageKeypoints],
    *,
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    geometries: Sequence[TwoViewGeometry],
    on_existing: OnExisting = "error",
    places: NDArray[np.float64] | None = None,
) -> None:
    """Write keypoints, matches and two-view geometries: all rows, or none.

    A file that is absent or empty is made; where it lists no images, cameras and images are
    inserted. Where it lists images, the rows go to those of the given names, and their
    cameras stay as they are. Rows of these images that hold nothing, as matchers leave them
    for pairs they could not match, are replaced. A file with frames, as COLMAP 3.12 and later
    write them, gets one for every image that has none: the mappers refuse a mixture.

    What becomes of keypoints and matches that the images have already, `on_existing` says:

    - "error": the file is refused.
    - "append": the new keypoints follow the present ones, which keep their numbers, columns
      and matches. They have no shape of their own, and where the present ones have
      descriptors, theirs are zero, which SIFT's matchers match with nothing. A pair that has
      rows gets both sets of matches and of inliers; its models are those of the geometry with
      more inliers. Matches that were never verified stay unverified.
    - "replace": keypoints, descriptors, matches and geometries of these images are removed,
      with all pairs they are part of. Other images keep theirs.

    Other than with "error", named images that the file does not list are inserted.

    Args:
        database: path of the file.
        names: name of each image, its path relative to the image folder.
        cameras: the camera of all inserted images, or one for each image, of which several may
            be the same object; may be None where the database lists the images.
        keypoints: keypoints of each image.
        pairs: int32 [m, 2] indices of images.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        geometries: for each pair, its verified geometry.
        on_existing: what becomes of rows that the images have already.
        places: float64 [num_images, 3] latitude and longitude in degrees and altitude of each
            image, NaN where unknown, for those that have no pose prior; None: none is known.

    Raises:
        DatabaseError: the file is locked, not a COLMAP database, lists other images, already
            has keypoints or matches of these images and must not, has these very keypoints,
            or cannot be written (no space, no permission). The file is then as it was.
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
        image_ids = _place_images(connection, path, names, cameras, on_existing)
        if on_existing == "error":
            _check_nothing_lost(connection, path, dict(zip(image_ids, names, strict=True)))
        elif on_existing == "replace":
            _clear_images(connection, set(image_ids))
        firsts = append_keypoints(connection, path, image_ids, keypoints)
        shifts = [np.array([firsts[i], firsts[j]], dtype=np.uint32) for i, j in pairs]
        append_pairs(
            connection,
            path,
            order_pairs(image_ids, pairs),
            shifts=shifts,
            matches=matches,
            geometries=geometries,
        )
        if names:
            complete_frames(connection, path)
        if places is not None:
            write_places(connection, image_ids, places)

    if is_new(path):
        write_new(path, fill)
    else:
        write_existing(path, fill)


def _place_images(
    connection: sqlite3.Connection,
    path: Path,
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera] | None,
    on_existing: OnExisting,
) -> list[int]:
    """Ids of the named images, inserted where the database does not list them and may."""
    listed = dict(connection.execute("SELECT name, image_id FROM images").fetchall())
    absent = [name for name in names if name not in listed]
    if listed and absent and (on_existing == "error" or cameras is None):
        raise DatabaseError(
            f"{path} lists {len(listed)} images, but not {absent[0]!r}: use images by the names "
            "it lists, or a new database"
        )
    if not listed:
        for table in ("rigs", "frames"):
            if columns(connection, table) and has_rows(connection, table):
                raise DatabaseError(
                    f"{path} has {table} but no images: import its images first, or use a new "
                    "database"
                )
    if absent:
        if cameras is None:
            raise ValueError("give a camera: the database lists no images")
        if not isinstance(cameras, pycolmap.Camera):
            if len(cameras) != len(names):
                raise ValueError("give one camera, or one for each image")
            each = dict(zip(names, cameras, strict=True))
            cameras = [each[name] for name in absent]
        listed |= _insert_images(connection, absent, cameras)
    return [listed[name] for name in names]


def _insert_images(
    connection: sqlite3.Connection,
    names: Sequence[str],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera],
) -> dict[str, int]:
    """Insert images with a camera for all or one for each; returns the ids of the names."""
    each: list[Any] = (
        [cameras] * len(names) if isinstance(cameras, pycolmap.Camera) else list(cameras)
    )
    rows = list({id(camera): camera for camera in each}.values())
    row_of = {id(camera): row for row, camera in enumerate(rows)}
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
    (first_image_id,) = connection.execute(
        "SELECT COALESCE(MAX(image_id), 0) + 1 FROM images"
    ).fetchone()
    connection.executemany(
        "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, ?)",
        (
            (first_image_id + i, name, first_id + row_of[id(camera)])
            for i, (name, camera) in enumerate(zip(names, each, strict=True))
        ),
    )
    return {name: first_image_id + i for i, name in enumerate(names)}


def _check_nothing_lost(
    connection: sqlite3.Connection, path: Path, name_of_id: dict[int, str]
) -> None:
    """Refuse to replace keypoints, or matches that refer to them."""
    way_out = "use a database without them, or on_existing append or replace"
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


def _clear_images(connection: sqlite3.Connection, image_ids: set[int]) -> None:
    """Remove all features and matches of some images, and of no others."""
    for table in ("keypoints", "descriptors"):
        if columns(connection, table):
            connection.executemany(
                f"DELETE FROM {table} WHERE image_id = ?", ((i,) for i in sorted(image_ids))
            )
    for table in ("matches", "two_view_geometries"):
        pair_ids = connection.execute(f"SELECT pair_id FROM {table}").fetchall()
        connection.executemany(
            f"DELETE FROM {table} WHERE pair_id = ?",
            (row for row in pair_ids if not image_ids.isdisjoint(image_ids_from_pair_id(row[0]))),
        )
