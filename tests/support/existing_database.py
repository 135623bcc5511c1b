"""COLMAP databases in the schemas of all versions, as other programs write them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from synthetic_scene import CAMERA_PARAMS, HEIGHT, WIDTH, make_scene, match_scene

from colmap_av1.database.reading import pair_id_from_image_ids
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.options import CameraOptions

LAYOUTS = ("3.8", "3.11", "3.13", "4.2")
NUM_IMAGES = 8
NAMES = [f"frame_{i:03d}.png" for i in range(NUM_IMAGES)]
CAMERA = make_camera(CameraOptions(camera_params=CAMERA_PARAMS), WIDTH, HEIGHT)
CAMERAS = [CAMERA] * NUM_IMAGES
# Different points, observed by the same cameras.
THEIR_SCENE, OUR_SCENE = (
    make_scene(num_frames=NUM_IMAGES, num_points=500, seed=seed) for seed in (1, 2)
)
THEIRS = match_scene(THEIR_SCENE, CAMERA)
OURS = match_scene(OUR_SCENE, CAMERA)


def query(database: Path, sql: str, *values: object) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(sql, values).fetchall()


def alter(database: Path, sql: str, *values: object) -> None:
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(sql, values)


def make_layout(path: Path, layout: str) -> None:
    """Create an empty database as `database_creator` of this version does."""
    script = Path(__file__).parents[1] / "data" / "schemas" / f"colmap-{layout}.sql"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.executescript(script.read_text())


def list_images(path: Path, layout: str, names: Iterable[str] = NAMES) -> dict[str, int]:
    """Create a database with images, and with frames if the version has them.

    Image ids are in reverse order of the names.

    Returns:
        Image ids by name.
    """
    make_layout(path, layout)
    names = sorted(names, reverse=True)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(
            "INSERT INTO cameras (camera_id, model, width, height, params, prior_focal_length) "
            "VALUES (1, ?, ?, ?, ?, 1)",
            (int(CAMERA.model.value), WIDTH, HEIGHT, np.asarray(CAMERA.params).tobytes()),
        )
        for image_id, name in enumerate(names, 1):
            connection.execute(
                "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, 1)", (image_id, name)
            )
        if layout in ("3.13", "4.2"):
            connection.execute("INSERT INTO rigs VALUES (1, 1, 0)")
            for image_id in range(1, len(names) + 1):
                connection.execute("INSERT INTO frames VALUES (?, 1)", (image_id,))
                connection.execute("INSERT INTO frame_data VALUES (?, ?, 1, 0)", (image_id,) * 2)
    return {name: i for i, name in enumerate(names, 1)}


def sift_keypoints(index: int) -> NDArray[np.float32]:
    """Keypoints of an image with affine shapes, as of SIFT: float32 [n, 6]."""
    xy = THEIRS.keypoints[index].xy
    shapes = np.random.default_rng(index).normal(0, 3, (len(xy), 4))
    return np.concatenate([xy, shapes], axis=1).astype(np.float32)


def sift_descriptors(index: int) -> NDArray[np.uint8]:
    """Descriptors [n, 128] of norm 512, equal for all observations of a point."""
    track = THEIRS.keypoints[index].track
    of_track = np.random.default_rng(0).gamma(1.0, 1.0, (track.max(initial=0) + 1, 128))
    of_track *= 512 / np.linalg.norm(of_track, axis=1, keepdims=True)
    return np.minimum(np.rint(of_track[track]), 255).astype(np.uint8)


def fill_with_sift(path: Path, ids: dict[str, int]) -> None:
    """Add keypoints, descriptors and verified matches as COLMAP's SIFT commands do."""
    has_type = "type" in {row[1] for row in query(path, "PRAGMA table_info(descriptors)")}
    with closing(sqlite3.connect(path)) as connection, connection:
        for index, name in enumerate(NAMES):
            keypoints, descriptors = sift_keypoints(index), sift_descriptors(index)
            connection.execute(
                "INSERT INTO keypoints (image_id, rows, cols, data) VALUES (?, ?, 6, ?)",
                (ids[name], len(keypoints), keypoints.tobytes()),
            )
            # COLMAP 4 stores the type of descriptors; 0 is SIFT.
            extra = (", type", ", 0") if has_type else ("", "")
            connection.execute(
                f"INSERT INTO descriptors (image_id, rows, cols, data{extra[0]}) "
                f"VALUES (?, ?, 128, ?{extra[1]})",
                (ids[name], len(descriptors), descriptors.tobytes()),
            )
        for (i, j), matches, geometry in zip(
            THEIRS.pairs, THEIRS.matches, THEIRS.geometries, strict=True
        ):
            a, b = ids[NAMES[i]], ids[NAMES[j]]
            pair_id = pair_id_from_image_ids(a, b)
            step = 1 if a < b else -1
            connection.execute(
                "INSERT INTO matches VALUES (?, ?, 2, ?)",
                (pair_id, len(matches), matches[:, ::step].astype(np.uint32).tobytes()),
            )
            inliers = geometry.inlier_matches[:, ::step].astype(np.uint32)
            E, F = (None if m is None else (m if a < b else m.T) for m in (geometry.E, geometry.F))
            connection.execute(
                "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config, E, F) "
                "VALUES (?, ?, 2, ?, ?, ?, ?)",
                (
                    pair_id,
                    len(inliers),
                    inliers.tobytes(),
                    int(geometry.config),
                    None if E is None else E.tobytes(),
                    None if F is None else F.tobytes(),
                ),
            )


def make_existing(path: Path, layout: str, state: str) -> dict[str, int]:
    """Create a database with images only ("listed") or also with SIFT matches ("sift")."""
    ids = list_images(path, layout)
    if state == "sift":
        fill_with_sift(path, ids)
    return ids
