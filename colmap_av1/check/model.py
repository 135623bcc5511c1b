"""Diagnose a COLMAP model: check its poses against its points, images and matches."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np  # noqa: F401 - before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.check.crossings import Crossings, model_crossings
from colmap_av1.check.model_figures import ModelFigures, model_figures
from colmap_av1.database.file import open_unaltered
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.geometry.posed_model import posed_model
from colmap_av1.geometry.uncertainty import expected_error, uncertainty_warning
from colmap_av1.images.names import natural_key
from colmap_av1.poses.long_range import LongRangeErrors, model_long_range_errors
from colmap_av1.poses.seams import Seams, model_seams
from colmap_av1.util.progress import Progress, no_progress


@dataclass(frozen=True)
class ModelCheck:
    """Diagnosis of a model.

    Attributes:
        figures: numbers of images and points, errors and focal length.
        seams: the points that join neighbouring images.
        expected_error: expected error of the camera centres as a share of their extent, by the
            covariance of the observations; None if it is not known.
        crossings: the matches across neighbouring images; None without a database.
        long_range: the long-range check; None without an image folder.
    """

    figures: ModelFigures
    seams: Seams
    expected_error: float | None
    crossings: Crossings | None
    long_range: LongRangeErrors | None

    @property
    def seam_warnings(self) -> tuple[str, ...]:
        """Warnings about neighbouring images that are joined weakly or wrongly."""
        found = (self.seams.warning, self.crossings.warning if self.crossings else None)
        return tuple(warning for warning in found if warning is not None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All warnings; none if nothing is wrong with the model."""
        far_warning = self.long_range.warning() if self.long_range else None
        found = (far_warning, uncertainty_warning(self.expected_error))
        return (*(warning for warning in found if warning is not None), *self.seam_warnings)


def check_model(
    model: str | os.PathLike[str] | pycolmap.Reconstruction,
    *,
    image_path: str | os.PathLike[str] | None = None,
    database: str | os.PathLike[str] | None = None,
    progress: Progress = no_progress,
) -> ModelCheck:
    """Check whether the poses of a model are consistent.

    Args:
        model: the model, or its folder.
        image_path: folder of its images, for the long-range check.
        database: COLMAP database of its matches, which is not changed.
        progress: called with the stage "long range", the amount of work done, and the total.

    Raises:
        ModelError: the model cannot be read or has no poses.
        ImageError: an image is missing, unreadable or of another size than its camera.
        DatabaseError: the database cannot be read, or is damaged.

    Examples:
        >>> from colmap_av1 import check_model
        >>> found = check_model("my_model/0", image_path="my_frames")
        >>> found.figures.num_registered, found.warnings
        (10, ())
    """
    if not isinstance(model, pycolmap.Reconstruction):
        model = read_model(model)
    figures = model_figures(model)
    # The long-range check comes before the others, because it raises if images are missing.
    long_range = None
    if image_path is not None:
        long_range = model_long_range_errors(model, Path(image_path), progress)
    posed = posed_model(model, with_points=True)
    names = {image.name for image in posed.images}
    if database is not None:
        with open_unaltered(Path(database)) as connection:
            names.update(name for (name,) in connection.execute("SELECT name FROM images"))
    return ModelCheck(
        figures=figures,
        seams=model_seams(posed, sorted(names, key=natural_key)),
        expected_error=expected_error(posed),
        crossings=None if database is None else model_crossings(model, Path(database)),
        long_range=long_range,
    )
