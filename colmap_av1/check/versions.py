"""The COLMAP versions that write and open a database."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable

import pycolmap

from colmap_av1.database.layout import columns

# The last camera model of COLMAP 3.8.
_LAST_OLD_MODEL = int(pycolmap.CameraModelId.THIN_PRISM_FISHEYE)


def layout_of(connection: sqlite3.Connection) -> tuple[str, str]:
    """COLMAP versions that write the layout of a database, and versions that open it.

    Args:
        connection: the open database.
    """
    oldest = "prior_qw" in columns(connection, "images")
    newest = "pose_prior_id" in columns(connection, "pose_priors")
    if newest:
        migrated = ("3.8 or 3.9, migrated by 4.x", "3.8, 3.9 and 4.x")
        return migrated if oldest else ("4.x", "4.x")
    if oldest:
        return "3.8 or 3.9", "3.8 and later"
    framed = bool(columns(connection, "frames"))
    return ("3.12 or 3.13" if framed else "3.10 or 3.11"), "3.10 and later"


def readers_of(cameras: Iterable[pycolmap.Camera], of_layout: str) -> str:
    """COLMAP versions that open a database.

    Args:
        cameras: its cameras.
        of_layout: versions that open its layout.
    """
    newer = {c.model_name for c in cameras if int(c.model) > _LAST_OLD_MODEL}
    needed = ", ".join(sorted(newer))
    return f"{of_layout}, if they have the camera model {needed}" if newer else of_layout
