"""Front-ends with COLMAP's SIFT, matched sequentially or exhaustively."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import pycolmap

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.frontend import (
    OF_OTHERS,
    Filled,
    Frontend,
    images_digest,
    list_images,
)
from colmap_av1.util.progress import Clock

Pairing = Literal["sequential", "exhaustive"]


def sift_frontend(pairing: Pairing) -> Frontend:
    """SIFT features, matched by one of COLMAP's matchers."""
    return Frontend(
        partial(_sift, pairing),
        lambda footage: (pycolmap.__version__, images_digest(footage)),
        OF_OTHERS,
    )


def _sift(pairing: Pairing, footage: Footage, database: Path) -> Filled:
    clock = Clock()
    pycolmap.set_random_seed(0)
    list_images(footage, database)
    with clock.measure("extraction"):
        pycolmap.extract_features(database, footage.image_path, footage.names)
    with clock.measure("matching"):
        if pairing == "sequential":
            pycolmap.match_sequential(database)
        else:
            pycolmap.match_exhaustive(database)
    return Filled(clock.seconds)
