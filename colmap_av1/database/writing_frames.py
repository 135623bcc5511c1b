"""Rigs and frames of images in a database, which COLMAP has since 3.12."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from colmap_av1.database.layout import columns, has_rows
from colmap_av1.errors import DatabaseError

# COLMAP's SensorType of a camera.
_CAMERA_SENSOR = 0


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
