"""What a database says of images beside themselves: rigs and frames, and where they were taken.

COLMAP has rigs and frames since 3.12, and pose priors since 3.10, in a layout of its own since 4.0.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.layout import columns, has_rows
from colmap_av1.errors import DatabaseError

# COLMAP's SensorType of a camera.
_CAMERA_SENSOR = 0
# COLMAP's PosePriorCoordinateSystem of latitude, longitude and altitude.
WGS84 = 0
# The layout of COLMAP 3.10 to 3.13, which later ones migrate and earlier ones pass over.
_POSE_PRIORS = (
    "CREATE TABLE pose_priors (image_id INTEGER PRIMARY KEY NOT NULL, position BLOB, "
    "coordinate_system INTEGER NOT NULL, position_covariance BLOB, "
    "FOREIGN KEY(image_id) REFERENCES images(image_id) ON DELETE CASCADE)"
)
_UNKNOWN = np.full(9, np.nan, dtype="<f8")


def complete_frames(connection: sqlite3.Connection, path: Path) -> None:
    """Give every image a frame where the file has rigs or frames at all.

    COLMAP makes rigs and frames by itself, but only where there are none.
    """
    tables = ("rigs", "rig_sensors", "frames", "frame_data")
    if not all(columns(connection, table) for table in tables):
        return
    if not (has_rows(connection, "rigs") or has_rows(connection, "frames")):
        return
    rig_of_camera = dict(
        connection.execute(
            "SELECT ref_sensor_id, rig_id FROM rigs WHERE ref_sensor_type = ?", (_CAMERA_SENSOR,)
        ).fetchall()
    )
    in_larger_rig = {
        row[0]
        for row in connection.execute(
            "SELECT sensor_id FROM rig_sensors WHERE sensor_type = ?", (_CAMERA_SENSOR,)
        )
    }
    unframed = connection.execute(
        "SELECT image_id, name, camera_id FROM images WHERE image_id NOT IN "
        "(SELECT data_id FROM frame_data WHERE sensor_type = ?) ORDER BY image_id",
        (_CAMERA_SENSOR,),
    ).fetchall()
    for image_id, name, camera_id in unframed:
        if camera_id not in rig_of_camera:
            if camera_id in in_larger_rig:
                raise DatabaseError(
                    f"{path}: image {name!r} has no frame, and its camera is one of several in a "
                    "rig: run COLMAP's rig_configurator on the database first"
                )
            rig_of_camera[camera_id] = connection.execute(
                "INSERT INTO rigs (ref_sensor_id, ref_sensor_type) VALUES (?, ?)",
                (camera_id, _CAMERA_SENSOR),
            ).lastrowid
        frame_id = connection.execute(
            "INSERT INTO frames (rig_id) VALUES (?)", (rig_of_camera[camera_id],)
        ).lastrowid
        connection.execute(
            "INSERT INTO frame_data (frame_id, data_id, sensor_id, sensor_type) "
            "VALUES (?, ?, ?, ?)",
            (frame_id, image_id, camera_id, _CAMERA_SENSOR),
        )


def write_places(
    connection: sqlite3.Connection, image_ids: Sequence[int], places: NDArray[np.float64]
) -> None:
    """Write where images were taken as pose priors; images that have one keep it.

    A file of COLMAP 3.8 or 3.9 gets them where these look for them, too.

    Args:
        connection: the open file.
        image_ids: the images.
        places: float64 [n, 3] latitude, longitude and altitude; NaN where unknown.
    """
    known = [(i, p) for i, p in zip(image_ids, places, strict=True) if np.isfinite(p).all()]
    if not known:
        return
    if not columns(connection, "pose_priors"):
        connection.execute(_POSE_PRIORS)
    if "pose_prior_id" in columns(connection, "pose_priors"):
        _write_newer(connection, known)
    else:
        connection.executemany(
            "INSERT OR IGNORE INTO pose_priors (image_id, position, coordinate_system, "
            "position_covariance) VALUES (?, ?, ?, ?)",
            ((i, p.astype("<f8").tobytes(), WGS84, _UNKNOWN.tobytes()) for i, p in known),
        )
    if "prior_tx" in columns(connection, "images"):
        connection.executemany(
            "UPDATE images SET prior_tx = ?, prior_ty = ?, prior_tz = ? "
            "WHERE image_id = ? AND prior_tx IS NULL",
            ((*map(float, p), i) for i, p in known),
        )


def _write_newer(
    connection: sqlite3.Connection, known: Sequence[tuple[int, NDArray[np.float64]]]
) -> None:
    """The same in the layout of COLMAP 4.0 and later."""
    camera_of = dict(connection.execute("SELECT image_id, camera_id FROM images").fetchall())
    connection.executemany(
        "INSERT OR IGNORE INTO pose_priors (corr_data_id, corr_sensor_id, corr_sensor_type, "
        "position, position_covariance, gravity, coordinate_system) VALUES (?, ?, ?, ?, ?, ?, ?)",
        (
            (
                *(i, camera_of[i], _CAMERA_SENSOR, p.astype("<f8").tobytes()),
                *(_UNKNOWN.tobytes(), _UNKNOWN[:3].tobytes(), WGS84),
            )
            for i, p in known
        ),
    )
