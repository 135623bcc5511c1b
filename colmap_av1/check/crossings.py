"""Check whether the verified matches across each gap between images fit the poses of a model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.database.file import open_unaltered
from colmap_av1.database.reading import image_ids_from_pair_id, matches_from_row, read_keypoints
from colmap_av1.errors import DatabaseError
from colmap_av1.geometry.colmap_model import ModelImage, posed_images
from colmap_av1.matching.epipolar import error_by_poses
from colmap_av1.matching.mapper_limits import MIN_INLIERS
from colmap_av1.poses.seams import images_in_time
from colmap_av1.util.arrays import Bools, Floats, Ints

# A match fits the poses within this Sampson error in pixels, COLMAP's limit for inliers.
_MAX_ERROR = 4.0
# Fewest matches across a gap that have to fit, as a share. Correct models have 87 % and more at
# every gap; a wrongly joined model had 55 %.
_LEAST_FITTING = 0.75
# Gaps with fewer matches than this are not judged.
_FEWEST = 30


@dataclass(frozen=True)
class Crossings:
    """Verified matches across the gaps between neighbouring images of the same camera and folder.

    Attributes:
        pairs: names of the images before and after each gap, in the order of their names.
        num_matches: int64 [n] matches between images before and images after each gap.
        num_fitting: int64 [n] matches that also fit the relative poses of their images.
    """

    pairs: tuple[tuple[str, str], ...]
    num_matches: Ints
    num_fitting: Ints

    @property
    def share(self) -> Floats:
        """Share of the matches that fit; 1 if there are too few to judge."""
        share = self.num_fitting / np.maximum(self.num_matches, 1)
        return np.where(self.num_matches >= _FEWEST, share, 1.0)

    @property
    def wrong(self) -> list[int]:
        """Gaps, by index, whose matches contradict the poses."""
        return [int(i) for i in np.flatnonzero(self.share < _LEAST_FITTING)]

    @property
    def warning(self) -> str | None:
        """A warning if the model does not fit the matches, or its parts are joined wrongly."""
        if not self.wrong:
            return None
        judged = self.share[self.num_matches >= _FEWEST]
        most = float(judged.max())
        if len(judged) > 1 and most < _LEAST_FITTING:
            return (
                f"at most {most:.0%} of the matches fit the poses anywhere: give the database that "
                "the model was mapped from, and the model of original images, not undistorted ones"
            )
        # All matches that do not fit cross the wrong gap. Neighbouring gaps have the same number if
        # no image between them has matches.
        unfit = self.num_matches - self.num_fitting
        largest = max(int(unfit[i]) for i in self.wrong)
        where = [i for i in self.wrong if unfit[i] == largest]
        first, second = self.pairs[where[0]][0], self.pairs[where[-1]][1]
        more = len(self.wrong) - len(where)
        others = f", and few at {more} more {'place' if more == 1 else 'places'}" if more else ""
        return (
            f"only {self.share[where[0]]:.0%} of the matches across '{first}' and '{second}' fit "
            f"the poses, usually {np.median(self.share):.0%} do{others}: the parts before and "
            "after are joined wrongly; try the other --mapper or reconstruct, film more slowly, or "
            "map the two parts separately"
        )


def model_crossings(reconstruction: pycolmap.Reconstruction, database: Path) -> Crossings:
    """Compare the verified matches of a database with the poses of a model.

    Args:
        reconstruction: the model; its images are found in the database by name.
        database: COLMAP database, which is not changed.

    Raises:
        DatabaseError: the database cannot be read, is damaged, or lists no image of the model.
    """
    images, gaps = images_in_time([*posed_images(reconstruction).values()])
    video = np.cumsum(~np.isin(np.arange(len(images)) - 1, gaps))
    matches, fitting = (np.zeros(len(images) + 1, np.int64) for _ in range(2))
    for i, j, fits in _fitting(images, reconstruction.cameras, database):
        if video[i] != video[j]:  # such a pair crosses no gap between neighbours in time
            continue
        for change, count in ((matches, len(fits)), (fitting, int(np.count_nonzero(fits)))):
            change[i] += count
            change[j] -= count
    return Crossings(
        tuple((images[k].name, images[k + 1].name) for k in gaps),
        np.cumsum(matches)[gaps],
        np.cumsum(fitting)[gaps],
    )


def _fitting(
    images: list[ModelImage], cameras: pycolmap.CameraMap, database: Path
) -> Iterator[tuple[int, int, Bools]]:
    """Yield each matched pair as indices i < j, with a mask of the matches that fit the poses.

    Keypoints are undistorted with the cameras of the model.
    """
    index_of = {image.name: k for k, image in enumerate(images)}
    with open_unaltered(database) as connection:
        of_id = {
            image_id: index_of[name]
            for image_id, name in connection.execute("SELECT image_id, name FROM images")
            if name in index_of
        }
        if not of_id:
            raise DatabaseError(
                f"{database}: lists no image of the model: give the database that the model was "
                "mapped from"
            )
        rays: dict[int, Floats] = {}
        for image_id, image in of_id.items():
            xy = read_keypoints(connection, database, image_id)[:, :2].astype(np.float64)
            rays[image_id] = np.asarray(cameras[images[image].camera_id].cam_from_img(xy)).T
        for pair_id, *row in connection.execute(
            "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows >= ?",
            (MIN_INLIERS,),
        ):
            a, b = image_ids_from_pair_id(pair_id)
            if a not in rays or b not in rays:
                continue
            matches = matches_from_row(database, pair_id, *row)
            if (matches >= [rays[a].shape[1], rays[b].shape[1]]).any():
                raise DatabaseError(
                    f"{database}: images {a} and {b} match keypoints that do not exist: run "
                    "'colmap-av1 check' for a full list of problems"
                )
            views = [images[of_id[k]] for k in (a, b)]
            error = error_by_poses(
                [view.cam_from_world for view in views],
                [cameras[view.camera_id] for view in views],
                [rays[a][:, matches[:, 0]], rays[b][:, matches[:, 1]]],
            )
            i, j = sorted((of_id[a], of_id[b]))
            yield i, j, error <= _MAX_ERROR
