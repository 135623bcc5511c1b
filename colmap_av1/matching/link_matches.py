"""Features of pictures matched between images, and what they say of the motion across gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask
from colmap_av1.images.takes import Pictures, Takes
from colmap_av1.matching.features.sift import (
    FeatureExtractor,
    Features,
    masked_features,
    match_features,
)
from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.matching.verify import agreeing_matches, verify_pairs
from colmap_av1.options import LinkOptions, RunOptions, VerifyOptions
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.progress import Progress

# Inliers of a pair across a gap, and of a place seen again, which must be surer: nothing says that
# the camera was there.
_MIN_GAP_INLIERS = 20
_MIN_REVISIT_INLIERS = 25
# Links of a place seen again come in groups: key images beside each other see it, too.
_SUPPORT_REACH = 2
# Two videos are the same that show so many of the pictures looked at, and this share of those of
# either, in the same place, to pixels: another camera comes this near for one or two.
_FEWEST_SAME = 3
_SAME_SHARE = 0.3
_SAME_PLACE = 1.0
# The motion across a gap is believed where this share of its matches agrees with the pictures'
# geometry, to this many pixels: 98 to 100 % of true motion does, of what only compresses well no
# more than three quarters.
_MIN_AGREEING = 0.85
_MAX_ERROR = 3.0


@dataclass(frozen=True)
class Links:
    """Verified matches of features.

    Attributes:
        pairs: int32 [m, 2] indices of images, first < second, ascending.
        geometries: for each pair, its two-view geometry; its inliers are indices of features.
    """

    pairs: NDArray[np.int32]
    geometries: list[TwoViewGeometry]

    def joined(self, other: Links) -> Links:
        """These and others, of other pairs."""
        pairs = np.concatenate([self.pairs, other.pairs])
        geometries = [*self.geometries, *other.geometries]
        order = np.lexsort((pairs[:, 1], pairs[:, 0])).tolist()
        return Links(pairs[order], [geometries[k] for k in order])


def extract_features(
    wanted: list[int],
    pictures: Pictures,
    cameras: Sequence[Any],
    masks: Sequence[Mask | None],
    options: LinkOptions,
    *,
    effort: Literal["light", "full"],
    progress: Progress,
) -> dict[int, Features]:
    """Features of the pictures of images where masks leave them, in pixels of the images."""
    extractor = FeatureExtractor(options.max_link_features, effort)
    found: dict[int, Features] = {}
    for image, picture in pictures(wanted):
        features = masked_features(extractor.extract(picture), picture, masks[image])
        width, height = int(cameras[image].width), int(cameras[image].height)
        scale = np.array([width / picture.shape[1], height / picture.shape[0]], np.float32)
        found[image] = replace(features, xy=features.xy * scale)
        progress("links", len(found), len(wanted))
    return found


def match_pairs(
    pairs: NDArray[np.int32],
    features: dict[int, Features],
    *,
    cameras: Sequence[Any],
    verify: VerifyOptions,
    run: RunOptions,
    progress: Progress,
) -> Links:
    """Match the features of pairs of images and keep what agrees with a rigid scene.

    Pairs of images of which one has no features are left out.
    """
    nothing = np.empty((0, 2), np.float32)
    xy = [features[i].xy if i in features else nothing for i in range(len(cameras))]
    # Verification asks neither for frames nor for tracks.
    views = [ImageKeypoints(0, own, np.arange(len(own), dtype=np.int64)) for own in xy]
    there = [i in features and j in features for i, j in pairs.tolist()]
    pairs = pairs[np.array(there, dtype=np.bool_)]
    matches = []
    with one_blas_thread():
        for i, j in pairs.tolist():
            matches.append(match_features(features[i], features[j]))
            progress("link matches", len(matches), len(pairs))
    options = replace(verify, min_num_inliers=max(verify.min_num_inliers, _MIN_GAP_INLIERS))
    geometries = verify_pairs(views, pairs, matches, cameras, options, run=run)
    kept = [k for k, g in enumerate(geometries) if len(g.inlier_matches) > 0]
    return Links(pairs[kept], [geometries[k] for k in kept])


def supported_links(
    links: Links, revisits: set[tuple[int, int]], place: dict[int, int], lone: set[int]
) -> Links:
    """The links without places seen again that nothing beside them confirms.

    Args:
        links: the links.
        revisits: pairs of images that see a place again, or may.
        place: of key images in a row; those near each other in it see nearly the same.
        lone: images that have none beside them: what confirms theirs may be a third image that is
            linked to both.
    """
    pairs = [(i, j) for i, j in links.pairs.tolist()]
    sure = {
        (i, j)
        for (i, j), g in zip(pairs, links.geometries, strict=True)
        if (i, j) in revisits and len(g.inlier_matches) >= _MIN_REVISIT_INLIERS
    }
    places = {(place[i], place[j]) for i, j in sure}
    around = range(-_SUPPORT_REACH, _SUPPORT_REACH + 1)
    linked: dict[int, set[int]] = {}
    for i, j in sure:
        linked.setdefault(i, set()).add(j)
        linked.setdefault(j, set()).add(i)

    def is_supported(i: int, j: int) -> bool:
        a, b = place[i], place[j]
        beside = ((a + da, b + db) in places for da in around for db in around if da or db)
        return any(beside) or bool({i, j} & lone and linked[i] & linked[j])

    supported = {pair for pair in sure if is_supported(*pair)}
    kept = [k for k, pair in enumerate(pairs) if pair not in revisits or pair in supported]
    return Links(links.pairs[kept], [links.geometries[k] for k in kept])


def same_videos(
    links: Links, features: dict[int, Features], cameras: Sequence[Any], takes: Takes
) -> list[tuple[int, int]]:
    """Pairs of takes that show the same pictures, as encodings of one video do, first < second."""
    alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True):
        pair = int(takes.take[i]), int(takes.take[j])
        if pair[0] == pair[1] or max(pair) >= len(takes.videos):
            continue
        a, b = geometry.inlier_matches.T
        scale = cameras[i].width / cameras[j].width
        apart = np.hypot(*(features[i].xy[a] - features[j].xy[b] * scale).T)
        if np.median(apart) <= _SAME_PLACE:
            alike.setdefault(pair, []).append((i, j))
    looked_at = np.bincount(takes.take[sorted(features)], minlength=takes.num_takes)
    found = []
    for pair, images in sorted(alike.items()):
        num_same = [len(set(own)) for own in zip(*images, strict=True)]
        share = max(same / looked_at[take] for same, take in zip(num_same, pair, strict=True))
        if min(num_same) >= _FEWEST_SAME and share >= _SAME_SHARE:
            found.append(pair)
    return found


def broken_gaps(
    gaps: NDArray[np.int64], links: Links, matched: MatchedImages, cameras: Sequence[Any]
) -> list[int]:
    """Gaps whose motion the pictures contradict, or do not confirm: it is not believed."""
    of_pair = {pair: k for k, pair in enumerate(map(tuple, matched.pairs.tolist()))}
    broken = []
    for gap in gaps.tolist():
        num_matches = num_agreeing = 0
        crossing = np.flatnonzero((links.pairs[:, 0] <= gap) & (links.pairs[:, 1] > gap))
        for k in crossing.tolist():
            i, j = links.pairs[k].tolist()
            if (i, j) not in of_pair:
                continue
            matches = matched.matches[of_pair[i, j]]
            num_matches += len(matches)
            xy = matched.keypoints[i].xy[matches[:, 0]], matched.keypoints[j].xy[matches[:, 1]]
            agrees = agreeing_matches(
                links.geometries[k], *xy, (cameras[i], cameras[j]), max_error=_MAX_ERROR
            )
            num_agreeing += int(np.count_nonzero(agrees))
        if num_agreeing < _MIN_AGREEING * num_matches or num_matches == 0:
            broken.append(gap)
    return broken
