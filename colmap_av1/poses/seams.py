"""How well points connect the images before and after each seam of a model.

A seam lies between two images that are neighbours in time.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.images.names import natural_order, videos_of
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.grouping import sums_beside_gaps

# Points with fewer views are ignored: two views do not constrain the scale between images.
_FEWEST_VIEWS = 3
# A seam is doubtful, or has few points, if it has less than this share of the median number of
# points. At jerks, links bring correct models to 15 % or more; models that were bent had 1 to 5 %.
_DOUBTFUL = 0.15
_FEW = 0.07
# A point connects two images that are at most this many images apart. Otherwise a place that is
# seen again would connect all seams in between.
_REACH = 10
# This many points are never few, however many other seams have: bent models had at most 50.
_ENOUGH = 100
# A seam with few points is not disconnected if this share of the median number of points have views
# before and after it, however far apart: the parts of a cut video may see the same place elsewhere.
_ELSEWHERE = 0.5
# If the images of other folders see more than this share of the points near a seam, they hold its
# images together: photos of a scene that a video shows, for example.
_SHARED = 0.5
# A point has depth if its parallax exceeds this many pixels, several times the error of an
# observation.
_LEAST_PARALLAX = 2.0
# The scale of a model is lost at a seam if fewer points than this share of the usual number carry
# it across, although more than _DEEP points have depth on either side. This happens where the
# camera turns on the spot by its field of view: bent models of rendered walks had at most 6 %,
# which was 32 points, correct ones at least 9 %. With _SCALED points it is not lost, however many
# others have: a correct model of a walk through a café had 44 of 730.
_LOST = 0.07
_SCALED = 40
_DEEP = 100


@dataclass(frozen=True)
class Seams:
    """The points at each seam: between neighbours in time of the same camera and folder.

    Images that are held together by those of other folders have no seams, see `_SHARED`. Only
    points with at least three views count. A model may be bent at seams of these kinds:

    - `doubtful`: far fewer points than usual connect the sides;
    - `few_points`: the doubtful seams that even fewer points connect;
    - `disconnected`: those of `few_points` whose sides share few points elsewhere either;
    - `scale_lost`: points connect the sides, but hardly any of them have depth on both.

    Attributes:
        pairs: names of the images before and after each seam, in the order of time.
        num_points: int64 [n] points with views on both sides, of the same video and at most ten
            images apart; or fewer, see `_points_of_loose_stretches`.
        num_elsewhere: int64 [n] points with views on both sides, however far apart.
        num_scaled: int64 [n] points that carry the scale across. With k the image before the seam,
            they have depth both by the views of the video up to k and by those from k on. A place
            that is seen again more than ten images later counts as another point.
        num_deep: int64 [n] points that have depth by the views of the video up to k, or by those
            from k on, whichever are fewer.
    """

    pairs: tuple[tuple[str, str], ...]
    num_points: Ints
    num_elsewhere: Ints
    num_scaled: Ints
    num_deep: Ints

    @property
    def disconnected(self) -> list[int]:
        """Indices of seams with few points whose sides share few points elsewhere either."""
        if len(self.num_points) == 0:
            return []
        enough = _ELSEWHERE * float(np.median(self.num_points))
        return [i for i in self.few_points if self.num_elsewhere[i] < enough]

    @property
    def doubtful(self) -> list[int]:
        """Indices of seams with far fewer points than the others."""
        return self._below(_DOUBTFUL)

    @property
    def usual_scaled(self) -> float:
        """Usual number of points that carry the scale across a seam: the 90th percentile."""
        # Not the median: turns may be the larger part of a video.
        return float(np.quantile(self.num_scaled, 0.9)) if len(self.num_scaled) else 0.0

    @property
    def scale_lost(self) -> list[int]:
        """Indices of seams across which too few points carry the scale of the model."""
        least = min(_LOST * self.usual_scaled, _SCALED)
        return [int(i) for i in np.flatnonzero((self.num_scaled < least) & (self.num_deep > _DEEP))]

    @property
    def few_points(self) -> list[int]:
        """Indices of seams that few points connect, even if both sides share points elsewhere."""
        return self._below(_FEW, most=_ENOUGH)

    @property
    def worst_scale_lost(self) -> list[int]:
        """Indices of the worst seam in every run of consecutive seams that lose the scale."""
        return [
            min(run, key=lambda i: (int(self.num_scaled[i]), abs(2 * i - run[0] - run[-1])))
            for run in self._lost_runs()
        ]

    def _lost_runs(self) -> list[list[int]]:
        """The runs of consecutive seams that lose the scale, each a list of indices."""
        runs: list[list[int]] = []
        for seam in self.scale_lost:
            if runs and self._are_consecutive(runs[-1][-1], seam):
                runs[-1].append(seam)
            else:
                runs.append([seam])
        return runs

    def _are_consecutive(self, seam: int, other: int) -> bool:
        """Whether the image after a seam is the one before the other seam."""
        return self.pairs[seam][1] == self.pairs[other][0]

    def _below(self, share: float, most: float = math.inf) -> list[int]:
        if len(self.num_points) == 0:
            return []
        is_below = self.num_points < _share_of_median(self.num_points, share, most)
        return [int(i) for i in np.flatnonzero(is_below)]

    @property
    def warning(self) -> str | None:
        """Warning about disconnected seams, or else about seams that lose the scale."""
        return self.disconnected_warning or self._scale_warning

    @property
    def disconnected_warning(self) -> str | None:
        """Warning about disconnected seams."""
        if not self.disconnected:
            return None
        where = min(self.disconnected, key=lambda i: (int(self.num_elsewhere[i]), i))
        (first, second), count = self.pairs[where], int(self.num_elsewhere[where])
        more = len(self.disconnected) - 1
        others = f", and few at {more} more {'place' if more == 1 else 'places'}" if more else ""
        usual = int(np.median(self.num_points))
        return (
            f"only {count} points join '{first}' and earlier images to '{second}' and later ones, "
            f"where {usual} are usual{others}: scale and direction may change there; film it more "
            "slowly, or reconstruct the two parts separately"
        )

    @property
    def _scale_warning(self) -> str | None:
        """Warning about seams that lose the scale."""
        runs = self._lost_runs()
        if not runs:
            return None
        first, last = runs[0][0], runs[0][-1]
        others = ", and elsewhere" if len(runs) > 1 else ""
        return (
            f"hardly any points carry the scale from '{self.pairs[first][0]}' to "
            f"'{self.pairs[last][1]}'{others}: the camera turns there without moving sideways, "
            "so the parts before and after may differ in scale; keep walking while you turn, or "
            "reconstruct the two parts separately"
        )


def model_seams(
    model: PosedModel, all_images: Sequence[str], photos: Collection[str] = ()
) -> Seams:
    """Count the points at each seam of a model, see `Seams`.

    Args:
        model: the model, with points.
        all_images: names of the images that were mapped, in the order of time. Those that the model
            lacks count in the distance between two images.
        photos: names of photos, which have no neighbours in time.
    """
    images, neighbours = images_in_time(model.images, all_images)
    views, point, xyz = _seen_points(model, images)
    num_images, num_seams = len(images), max(len(images) - 1, 0)
    is_inside = np.isin(np.arange(num_seams), neighbours)
    sequence = np.cumsum(np.append(True, ~is_inside)) if num_images else np.empty(0, np.int64)
    is_held = _are_held_by_others(sequence, views, point)
    is_photo = [image.name in photos for image in images]
    seams = [k for k in neighbours if not (is_held[k] or is_photo[k] or is_photo[k + 1])]
    is_seam = np.isin(np.arange(num_seams), seams)
    is_near = (np.diff(point) == 0) & (np.diff(views) <= _REACH)
    near = np.flatnonzero(is_near & (np.diff(sequence[views]) == 0))
    first, last = (np.full(len(xyz), fill) for fill in (num_images, -1))
    np.minimum.at(first, point, views)
    np.maximum.at(last, point, views)
    # A place that is seen again carries no scale to the images in between, so each visit counts as
    # another point.
    starts = np.ones(len(point), np.bool_)
    starts[1 + near] = False
    visit = np.cumsum(starts) - 1
    begin = views[starts]
    end = views[np.append(starts[1:], True)] if len(views) else views
    # The first view of a visit with enough parallax to its first one, and the last view with enough
    # parallax to its last one.
    deep_from, deep_to = (np.full(len(begin), fill) for fill in (num_images, -1))
    least_angle = least_depth_angle(model.cameras[image.camera_id] for image in images)
    centres = camera_centres(np.array([image.cam_from_world for image in images]).reshape(-1, 3, 4))
    from_first = ray_angle(centres[views], centres[begin[visit]], xyz[point]) >= least_angle
    from_last = ray_angle(centres[views], centres[end[visit]], xyz[point]) >= least_angle
    np.minimum.at(deep_from, visit[from_first], views[from_first])
    np.maximum.at(deep_to, visit[from_last], views[from_last])

    def between(start: Ints, end: Ints) -> Ints:
        """Number of points at each seam. A point spans the seams from `start` to before `end`."""
        some = start < end
        change = np.bincount(start[some], minlength=num_images + 1)
        change -= np.bincount(end[some], minlength=num_images + 1)
        return np.cumsum(change)[:num_seams]

    crossing = between(views[near], views[near + 1])
    rank_of = {name: k for k, name in enumerate(all_images)}
    rank = np.array([rank_of[image.name] for image in images], np.int64)
    near = near[np.diff(rank[views])[near] <= _REACH]
    soon = between(views[near], views[near + 1])
    num_points = _points_of_loose_stretches(crossing, soon, is_seam, views, point)
    deep = deep_from < num_images
    of_visit = sequence[begin[deep]]
    before = between(deep_from[deep], np.searchsorted(sequence, of_visit, side="right"))
    after = between(np.searchsorted(sequence, of_visit), deep_to[deep] + 1)
    return Seams(
        tuple((images[k].name, images[k + 1].name) for k in seams),
        num_points=num_points[seams],
        num_elsewhere=between(first, last)[seams],
        num_scaled=between(deep_from, deep_to + 1)[seams],
        num_deep=np.minimum(before, after)[seams],
    )


def _are_held_by_others(sequence: Ints, views: Ints, point: Ints) -> Bools:
    """Whether most points near each seam are seen by images of other sequences, too.

    Args:
        sequence: int64 [num_images] sequence of each image, ascending.
        views: int64 [n] image of each view.
        point: int64 [n] its point.

    Returns:
        bool [num_images - 1]; false between images of different sequences.
    """
    num_images = len(sequence)
    seen = np.unique(np.column_stack([point, sequence[views]]), axis=0)[:, 0]
    is_shared = np.bincount(seen, minlength=int(point.max(initial=-1)) + 1)[point] > 1
    shared = np.bincount(views, is_shared, minlength=num_images)
    every = np.bincount(views, minlength=num_images)
    held = np.zeros(max(num_images - 1, 0), np.bool_)
    for own in np.split(np.arange(num_images), np.flatnonzero(np.diff(sequence)) + 1):
        beside = [sums_beside_gaps(n[own], _REACH) for n in (shared, every)]
        held[own[:-1]] = beside[0] > _SHARED * beside[1]
    return held


def images_in_time(
    images: Sequence[ModelImage], all_images: Sequence[str] = ()
) -> tuple[list[ModelImage], list[int]]:
    """The registered images of a model, in the order of time.

    Args:
        images: the images.
        all_images: names of these and maybe other images, in the order of time; empty: the natural
            order of the names is that of time.

    Returns:
        The images, and indices of those whose next one is a neighbour in time, see `videos_of`.
    """
    names = [image.name for image in images]
    by_name = dict(zip(names, images, strict=True))
    in_time = all_images or [names[k] for k in natural_order(names)]
    ordered = [by_name[name] for name in in_time if name in by_name]
    videos = videos_of([i.camera_id for i in ordered], [i.name for i in ordered])
    return ordered, [k for k, (own, other) in enumerate(pairwise(videos)) if own == other]


def _points_of_loose_stretches(
    crossing: Ints,
    soon: Ints,
    is_seam: Bools,
    views: Ints,
    point: Ints,
) -> Ints:
    """The number of points at each seam; where it is low, at most those of the stretch beside it.

    Where images between two parts of a video are not registered, views on either side of them count
    as near. Both parts may be held together by such points, but not the images between the parts
    that see none of them: those of a turn, if the camera then looks back where it came from.

    Args:
        crossing: int64 [num_images - 1] points with views on both sides of each seam that are at
            most ten registered images apart.
        soon: likewise, at most ten mapped images apart, registered or not.
        is_seam: bool [num_images - 1] whether the images of a seam are neighbours in time.
        views: int64 [m] image of each observation.
        point: int64 [m] its point.

    Returns:
        int64 [num_images - 1].
    """
    if not is_seam.any():
        return crossing
    least = _share_of_median(crossing[is_seam], _FEW, _ENOUGH)
    # A stretch is a run of images of one video between two seams with few near points.
    ends = ~is_seam | (soon < least)
    stretch = np.append(0, np.cumsum(ends))
    num_stretches = int(stretch[-1]) + 1
    # Each point once for each stretch that sees it.
    seen, seen_in = np.divmod(np.unique(point * num_stretches + stretch[views]), num_stretches)
    is_shared = (np.bincount(seen) > 1)[seen]
    joined = np.bincount(seen_in[is_shared], minlength=num_stretches)
    beside = np.minimum(joined[stretch[:-1]], joined[stretch[1:]])
    return np.where(is_seam & ends, np.minimum(crossing, beside), crossing)


def _share_of_median(num_points: Ints, share: float, most: float) -> float:
    """A share of the median number of points of all seams, or `most` if that is less."""
    return min(share * float(np.median(num_points)), most)


def _seen_points(model: PosedModel, images: Sequence[ModelImage]) -> tuple[Ints, Ints, Floats]:
    """The views of points with at least three of them, sorted by point and image.

    Args:
        model: the model, with points.
        images: its images, in the order in which they are counted.

    Returns:
        Index [m] of the image and index [m] of the point of each view, and the positions [n, 3] of
        the points.
    """
    index = {image.name: k for k, image in enumerate(images)}
    image = np.array([index[image.name] for image in model.images], np.int64)
    points = model.points
    point = points.point
    # A point may have several observations in an image.
    views = np.unique(np.column_stack([point, image[points.image]]), axis=0)
    enough = np.bincount(views[:, 0], minlength=len(points.xyz)) >= _FEWEST_VIEWS
    views = views[enough[views[:, 0]]]
    return views[:, 1], (np.cumsum(enough) - 1)[views[:, 0]], points.xyz[enough]


def least_depth_angle(cameras: Iterable[pycolmap.Camera]) -> float:
    """Smallest angle in degrees between two rays at which their point has depth.

    Args:
        cameras: the camera of each image.
    """
    focal = [camera.mean_focal_length() for camera in cameras]
    return float(np.degrees(_LEAST_PARALLAX / np.median(focal))) if focal else 0.0


def ray_angle(a: Floats, b: Floats, point: Floats) -> Floats:
    """Angle in degrees between the rays from two positions [n, 3] to each point [n, 3]."""
    rays = [(point - c) / np.linalg.norm(point - c, axis=1, keepdims=True) for c in (a, b)]
    half = np.linalg.norm(rays[0] - rays[1], axis=1) / 2
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(half, 1))))
