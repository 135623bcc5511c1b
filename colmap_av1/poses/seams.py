"""How firmly points join the images on either side of each gap between neighbours in time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import ModelImage, camera_centres, posed_images
from colmap_av1.images.names import natural_order, videos_of

# Two views of a point say nothing of how far one of them is from a third.
_FEWEST_VIEWS = 3
# A seam is doubtful, and may be looked at again, that has less than this share of the points that
# the seams of a model usually have; and weak below the other. Jerks that links mend have 15 % and
# more afterwards, models that were bent there 1 to 5 %.
_DOUBTFUL = 0.15
_WEAK = 0.07
# Images between two that see a point, beyond which these say nothing of the seams between: a place
# seen again would count for all of the way there and back.
REACH = 10
# So many points hold any seam, however many others have: bent ones had 50 at most.
_ENOUGH = 100
# Share of the points of usual seams that images before a seam share with those after it, however
# far apart, from which on it is not weak: parts of a cut video may see each other elsewhere.
_ELSEWHERE = 0.5
# A point has depth if its parallax exceeds this many pixels: several times the error of an
# observation.
_LEAST_PARALLAX = 2.0
# The scale of a model is lost at a seam that less than this share of the usual points carry it
# across, though so many points have depth on either side. Where a camera stands still and turns by
# as much as it sees at once few do: bent models had 7 % at most, others 11 % and more.
_LOST = 0.08
_DEEP = 100


@dataclass(frozen=True)
class Seams:
    """What joins neighbouring images of the same camera and folder.

    Attributes:
        pairs: names of the images before and after each seam, in the order of their names.
        num_points: int64 [n] points that join them: which images on both sides see, up to ten
            images apart, and three images at least.
        num_elsewhere: int64 [n] points that images on both sides see, however far apart.
        num_scaled: int64 [n] points that carry the scale across: which have depth by the views up
            to the image before, and by those from it on. A place that is seen again more than ten
            images later counts as another point.
        num_deep: int64 [n] points that have depth by the views up to the image before, or by those
            from it on, whichever are fewer.
    """

    pairs: tuple[tuple[str, str], ...]
    num_points: NDArray[np.int64]
    num_elsewhere: NDArray[np.int64]
    num_scaled: NDArray[np.int64]
    num_deep: NDArray[np.int64]

    @property
    def weak(self) -> list[int]:
        """Seams, by index, that hold far less than the others do: a model may be bent there."""
        if len(self.num_points) == 0:
            return []
        enough = _ELSEWHERE * float(np.median(self.num_points))
        return [i for i in self.thin if self.num_elsewhere[i] < enough]

    @property
    def doubtful(self) -> list[int]:
        """Seams, by index, that hold much less than the others do, the weak ones among them."""
        return self._below(_DOUBTFUL)

    @property
    def usual_scaled(self) -> float:
        """Number of points that carry the scale across a usual seam: the third quartile."""
        # Much of a clip may be a turn, so the median may be that of turns.
        return float(np.quantile(self.num_scaled, 0.75)) if len(self.num_scaled) else 0.0

    @property
    def unscaled(self) -> list[int]:
        """Seams, by index, across which nothing carries the scale of the model."""
        least = _LOST * self.usual_scaled
        return [int(i) for i in np.flatnonzero((self.num_scaled < least) & (self.num_deep > _DEEP))]

    @property
    def thin(self) -> list[int]:
        """Seams, by index, that few points join, whatever both sides see elsewhere."""
        return self._below(_WEAK, most=_ENOUGH)

    @property
    def turns(self) -> list[int]:
        """The weakest seam, by index, of every run of seams that do not carry the scale."""
        runs: list[list[int]] = []
        for seam in self.unscaled:
            if runs and runs[-1][-1] == seam - 1:
                runs[-1].append(seam)
            else:
                runs.append([seam])
        return [
            min(run, key=lambda i: (int(self.num_scaled[i]), abs(2 * i - run[0] - run[-1])))
            for run in runs
        ]

    def _below(self, share: float, most: float = math.inf) -> list[int]:
        if len(self.num_points) == 0:
            return []
        least = min(share * float(np.median(self.num_points)), most)
        return [int(i) for i in np.flatnonzero(self.num_points < least)]

    @property
    def warning(self) -> str | None:
        """What the user should know of a model that hardly holds together somewhere."""
        return self.weak_warning or self._scale_warning

    @property
    def weak_warning(self) -> str | None:
        """What the user should know of weak seams."""
        if not self.weak:
            return None
        where = min(self.weak, key=lambda i: (int(self.num_points[i]), i))
        (first, second), count = self.pairs[where], int(self.num_points[where])
        more = len(self.weak) - 1
        others = f", and few at {more} more {'place' if more == 1 else 'places'}" if more else ""
        usual = int(np.median(self.num_points))
        return (
            f"only {count} points join '{first}' and what is before it to '{second}' and what "
            f"follows, usually {usual} do{others}: scale and direction may change there; film it "
            "more slowly, or reconstruct the parts on either side apart"
        )

    @property
    def _scale_warning(self) -> str | None:
        """What the user should know of a model whose parts have scales of their own."""
        if not self.unscaled:
            return None
        first = last = self.unscaled[0]
        while last + 1 in self.unscaled:
            last += 1
        more = self.unscaled[-1] > last
        return (
            f"nothing carries the scale from '{self.pairs[first][0]}' to '{self.pairs[last][1]}'"
            f"{', and elsewhere' if more else ''}: the camera turns there without moving aside, so "
            "that what is before and what follows may have scales of their own; film such turns "
            "while walking, or reconstruct the parts on either side apart"
        )


def model_seams(reconstruction: pycolmap.Reconstruction) -> Seams:
    """What joins neighbouring images in a model.

    Images that are neighbours in the order of their names, as frames of a video are named, have a
    seam where one camera took both into one folder.
    """
    images, seams = images_in_time(reconstruction)
    views, point, xyz = _seen_points(reconstruction, images)
    num_images, num_seams = len(images), max(len(images) - 1, 0)
    order = np.lexsort((views, point))
    views, point = views[order], point[order]
    near = np.flatnonzero((np.diff(point) == 0) & (np.diff(views) <= REACH))
    first, last = (np.full(len(xyz), fill) for fill in (num_images, -1))
    np.minimum.at(first, point, views)
    np.maximum.at(last, point, views)
    # Views of a place that is seen again carry no scale to what lies between, so each visit counts
    # as a point of its own.
    starts = np.ones(len(point), np.bool_)
    starts[1 + near] = False
    visit = np.cumsum(starts) - 1
    begin = views[starts]
    end = views[np.append(starts[1:], True)] if len(views) else views
    # The first view that gives a visit depth beside its first one, and the last beside its last.
    deep_from, deep_to = (np.full(len(begin), fill) for fill in (num_images, -1))
    focal = [reconstruction.cameras[image.camera_id].mean_focal_length() for image in images]
    least_angle = np.degrees(_LEAST_PARALLAX / np.median(focal)) if focal else 0.0
    centres = camera_centres(np.array([image.cam_from_world for image in images]).reshape(-1, 3, 4))
    from_first = _angle(centres[views], centres[begin[visit]], xyz[point]) >= least_angle
    from_last = _angle(centres[views], centres[end[visit]], xyz[point]) >= least_angle
    np.minimum.at(deep_from, visit[from_first], views[from_first])
    np.maximum.at(deep_to, visit[from_last], views[from_last])

    def between(start: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many points have each seam from `start` on and before `end`."""
        some = start < end
        change = np.bincount(start[some], minlength=num_images + 1)
        change -= np.bincount(end[some], minlength=num_images + 1)
        return np.cumsum(change)[:num_seams]

    deep = deep_from < num_images
    before = between(deep_from[deep], np.full(np.count_nonzero(deep), num_images))
    after = between(np.zeros(np.count_nonzero(deep), np.int64), deep_to[deep] + 1)
    return Seams(
        tuple((images[k].name, images[k + 1].name) for k in seams),
        num_points=between(views[near], views[near + 1])[seams],
        num_elsewhere=between(first, last)[seams],
        num_scaled=between(deep_from, deep_to + 1)[seams],
        num_deep=np.minimum(before, after)[seams],
    )


def images_in_time(reconstruction: pycolmap.Reconstruction) -> tuple[list[ModelImage], list[int]]:
    """The images of a model with a pose, in the natural order of their names.

    Returns:
        The images, and indices of those whose next one is a neighbour in time, see `videos_of`.
    """
    posed = posed_images(reconstruction)
    names = list(posed)
    images = [posed[names[k]] for k in natural_order(names)]
    videos = videos_of([i.camera_id for i in images], [i.name for i in images])
    return images, [k for k, (own, other) in enumerate(pairwise(videos)) if own == other]


def _seen_points(
    reconstruction: pycolmap.Reconstruction, images: Sequence[ModelImage]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Places [m] of the images that see a point, number [m] of that point, and positions [n, 3].

    Points that fewer than three images see are left out.
    """
    place = {image.image_id: k for k, image in enumerate(images)}
    views, counts, xyz = list[int](), list[int](), list[NDArray[np.float64]]()
    for point in reconstruction.points3D.values():
        own = {place[e.image_id] for e in point.track.elements if e.image_id in place}
        if len(own) >= _FEWEST_VIEWS:
            views += own
            counts.append(len(own))
            xyz.append(point.xyz)
    number = np.repeat(np.arange(len(counts)), counts)
    return np.array(views, np.int64), number, np.array(xyz, np.float64).reshape(-1, 3)


def _angle(
    a: NDArray[np.float64], b: NDArray[np.float64], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Angle in degrees at which points [n, 3] are seen from two places each."""
    rays = [(point - c) / np.linalg.norm(point - c, axis=1, keepdims=True) for c in (a, b)]
    half = np.linalg.norm(rays[0] - rays[1], axis=1) / 2
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(half, 1))))
