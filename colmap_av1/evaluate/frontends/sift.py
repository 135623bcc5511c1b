"""Front-ends with COLMAP's SIFT, matched sequentially or exhaustively."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pycolmap

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.frontend import (
    OF_OTHERS,
    Frontend,
    images_digest,
    list_images,
)
from colmap_av1.util.progress import Clock


def sequential_sift() -> Frontend:
    """SIFT; each image is matched with the following ones, by COLMAP's sequential matcher."""
    return _sift_frontend(_pair_sequentially)


def exhaustive_sift() -> Frontend:
    """SIFT; all image pairs are matched."""
    return _sift_frontend(_pair_exhaustively)


def _sift_frontend(pairing: Callable[[Path], None]) -> Frontend:
    return Frontend(
        partial(_sift, pairing),
        lambda footage: (pycolmap.__version__, images_digest(footage)),
        OF_OTHERS,
    )


def _sift(pairing: Callable[[Path], None], footage: Footage, database: Path) -> dict[str, float]:
    clock = Clock()
    pycolmap.set_random_seed(0)
    list_images(footage, database)
    with clock.measure("extraction"):
        pycolmap.extract_features(database, footage.image_path, footage.names)
    with clock.measure("matching"):
        pairing(database)
    return clock.seconds


def _pair_sequentially(database: Path) -> None:
    pycolmap.match_sequential(database)


def _pair_exhaustively(database: Path) -> None:
    pycolmap.match_exhaustive(database)
