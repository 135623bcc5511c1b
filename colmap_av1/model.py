"""COLMAP models on disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pycolmap

from colmap_av1.errors import ModelError

_FILES = ("cameras", "images", "points3D")


def read_model(model: str | os.PathLike[str]) -> Any:
    """Read a COLMAP model.

    Args:
        model: folder with cameras, images and points3D, all .bin or all .txt.

    Returns:
        The pycolmap.Reconstruction.

    Raises:
        ModelError: the folder holds no model, a damaged one, or one without poses.
    """
    path = Path(model)
    if not any(
        all((path / f"{name}{suffix}").is_file() for name in _FILES) for suffix in (".bin", ".txt")
    ):
        inside = next((p for p in sorted(path.glob("**/cameras.bin")) if p.parent != path), None)
        hint = f": did you mean {inside.parent}?" if inside else ": give a folder a mapper wrote"
        raise ModelError(f"{path}: holds no COLMAP model (cameras, images, points3D){hint}")
    try:
        reconstruction = pycolmap.Reconstruction(path)
    except (RuntimeError, ValueError, IndexError, OSError, MemoryError) as error:
        raise ModelError(
            f"{path}: the model cannot be read, it is damaged or of a newer COLMAP: map again, or "
            "update pycolmap"
        ) from error
    if reconstruction.num_reg_images() == 0:
        raise ModelError(f"{path}: no image of the model has a pose: give a mapped model")
    return reconstruction
