"""Front-ends that import other programs' files in hloc's layout; COLMAP verifies the matches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pycolmap

from colmap_av1.errors import HlocError
from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.frontend import (
    OF_OTHERS,
    Filled,
    Frontend,
    images_digest,
    list_images,
)
from colmap_av1.interop.hloc import HlocMatches, read_hloc
from colmap_av1.util.digests import digest_if_there
from colmap_av1.util.progress import Clock


def imported_frontend(features: Path, matches: Path) -> Frontend:
    """Features and matches from files in hloc's layout, verified by COLMAP."""
    return Frontend(
        partial(import_hloc, (features, matches)),
        lambda footage: (
            *(digest_if_there(path) for path in (features, matches)),
            pycolmap.__version__,
            images_digest(footage),
        ),
        (*OF_OTHERS, "database"),
        files=(features, matches),
    )


def import_hloc(
    files: tuple[Path, Path],
    footage: Footage,
    database: Path,
    names: Sequence[str] | None = None,
) -> Filled:
    """Fill a database from files in hloc's layout.

    Args:
        files: files of the features and of the matches.
        footage: the images of the database.
        database: the database.
        names: the images that the files must contain; None: all.

    Returns:
        Wall time of "import" and "verification".

    Raises:
        HlocError: the files cannot be read, or lack an image.
    """
    names = names if names is not None else footage.names
    clock = Clock()
    pycolmap.set_random_seed(0)
    with clock.measure("import"):
        found = read_hloc(*files)
        missing = next((name for name in names if name not in found.names), None)
        if missing is not None:
            raise HlocError(
                f"{files[0]}: lacks image '{missing}': extract the features of the images in "
                f"{footage.image_path}"
            )
        list_images(footage, database)
        _write_hloc(found, set(names), database)
    with clock.measure("verification"):
        pycolmap.geometric_verification(database)
    return Filled(clock.seconds)


def _write_hloc(found: HlocMatches, names: set[str], database: Path) -> None:
    """Write keypoints and matches of some images."""
    with pycolmap.Database.open(database) as rows:
        ids = {image.name: image.image_id for image in rows.read_all_images()}
        for name, xy in zip(found.names, found.keypoints, strict=True):
            if name in names:
                rows.write_keypoints(ids[name], xy)
        for (i, j), between in zip(found.pairs, found.matches, strict=True):
            pair = found.names[i], found.names[j]
            if names.issuperset(pair):
                rows.write_matches(ids[pair[0]], ids[pair[1]], between)
