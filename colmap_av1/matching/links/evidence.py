"""What the links show: gaps whose motion is wrong, connected videos, and videos given twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.features.sift import Features
from colmap_av1.matching.gaps import Gap, GapReason, SuspectGaps
from colmap_av1.matching.links.matching import Links
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.matched_images import MatchedImages, connected_images
from colmap_av1.matching.verify import agreeing_matches
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.graphs import connected_components

# Two videos are the same if this number and this share of the examined pictures have their features
# at the same positions, to within this many pixels. Videos of two cameras have one or two such
# pictures at most.
_FEWEST_SAME = 3
_SAME_SHARE = 0.3
_SAME_PLACE = 1.0
# The motion across a gap is kept if this share of its matches agrees with the two-view geometry of
# the pictures to within this many pixels: 98 to 100 % of true motion does, but at most three
# quarters of vectors that merely compress well.
_MIN_AGREEING = 0.85
_MAX_ERROR = 3.0
# Mappers need 30 points to register an image, and only a part of the matches of two images become
# points. With this number of inliers across a gap they always succeed.
_SURE_INLIERS = 100
# Motion that the pictures confirm is kept with this share of the usual inliers of neighbours.
_ENOUGH_OF_USUAL = 0.3
# If the pictures contradict this many probed gaps of a video, all its motion is wrong.
_NUM_WRONG_PROBES = 2


def contradicted_gaps(
    gaps: Ints,
    links: Links,
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
) -> list[int]:
    """Find the gaps whose motion the pictures contradict or do not confirm."""
    of_pair = {pair: k for k, pair in enumerate(map(tuple, matched.pairs.tolist()))}
    contradicted = []
    for gap in gaps.tolist():
        num_matches = num_agreeing = 0
        crossing = np.flatnonzero((links.pairs[:, 0] <= gap) & (links.pairs[:, 1] > gap))
        for k in crossing.tolist():
            i, j = links.pairs[k].tolist()
            if (i, j) not in of_pair:
                continue
            matches = matched.matches[of_pair[i, j]]
            num_matches += len(matches)
            agrees = agreeing_matches(
                links.geometries[k],
                matched.keypoints[i].xy[matches[:, 0]],
                matched.keypoints[j].xy[matches[:, 1]],
                (cameras[i], cameras[j]),
                max_error=_MAX_ERROR,
            )
            num_agreeing += int(np.count_nonzero(agrees))
        if num_agreeing < _MIN_AGREEING * num_matches or num_matches == 0:
            contradicted.append(gap)
    return contradicted


def unbridged_gaps(
    contradicted: Sequence[int], suspect: SuspectGaps, matched: MatchedImages, image_set: ImageSet
) -> Bools:
    """Find suspect gaps whose motion the pictures contradict, or that few tracks cross.

    If several probes of a video are contradicted, all its gaps are included.

    Args:
        contradicted: the gaps whose motion the pictures contradict, see `contradicted_gaps`.
        suspect: the gaps that were examined.
        matched: the images, matched along tracks.
        image_set: the images.

    Returns:
        bool [num_images - 1].
    """
    is_wrong = np.zeros(len(suspect.maybe), np.bool_)
    is_wrong[list(contradicted)] = True
    across = np.zeros(len(suspect.maybe))
    first, second = matched.pairs.T
    neighbours = second == first + 1
    across[first[neighbours]] = matched.num_inliers[neighbours]
    in_video = across[np.diff(image_set.sequence) == 0]
    usual = float(np.median(in_video)) if len(in_video) else 0.0
    enough = max(_SURE_INLIERS, _ENOUGH_OF_USUAL * usual)
    found = suspect.maybe & (is_wrong | (across < enough))
    wrong_probes = [int(image_set.sequence[gap]) for gap in suspect.probes if is_wrong[gap]]
    for sequence, count in enumerate(
        np.bincount(wrong_probes, minlength=image_set.num_sequences).tolist()
    ):
        if count >= _NUM_WRONG_PROBES:
            images = image_set.images_of(sequence)
            found[images.start : images.stop - 1] = True
    return found


def gaps_after_linking(
    gaps: Ints, contradicted: Sequence[int], merged: MatchedImages, image_set: ImageSet
) -> tuple[Gap, ...]:
    """List the gaps of a plan with their reasons."""
    group = connected_images(merged)
    sequence = image_set.sequence[merged.pairs]
    found = []
    for gap in gaps.tolist():
        reasons: list[GapReason] = ["doubtful motion"]
        crossing = (merged.pairs[:, 0] <= gap) & (merged.pairs[:, 1] > gap)
        crossing &= sequence[:, 0] == sequence[:, 1]
        inliers = [len(merged.geometries[k].inlier_matches) for k in np.flatnonzero(crossing)]
        if max(inliers, default=0) < _SURE_INLIERS:
            reasons.append("few tracks")
        if gap in contradicted:
            reasons.append("contradicted")
        if group[gap] != group[gap + 1]:
            reasons.append("no overlap")
        names, frames = image_set.images.names, image_set.images.frames
        between = int(frames[gap]), int(frames[gap + 1])
        found.append(Gap(names[gap], names[gap + 1], tuple(reasons), between))
    return tuple(found)


def same_videos(
    links: Links,
    features: dict[int, Features],
    cameras: Sequence[pycolmap.Camera],
    image_set: ImageSet,
) -> tuple[tuple[str, str], ...]:
    """Find pairs of videos that show the same pictures, like two encodings of one video."""
    alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True):
        pair = int(image_set.sequence[i]), int(image_set.sequence[j])
        if pair[0] == pair[1] or max(pair) >= len(image_set.videos):
            continue
        a, b = geometry.inlier_matches.T
        scale = cameras[i].width / cameras[j].width
        apart = np.hypot(*(features[i].xy[a] - features[j].xy[b] * scale).T)
        if np.median(apart) <= _SAME_PLACE:
            alike.setdefault(pair, []).append((i, j))
    num_examined = np.bincount(
        image_set.sequence[sorted(features)], minlength=image_set.num_sequences
    )
    found = []
    for pair, images in sorted(alike.items()):
        num_same = [len(set(own)) for own in zip(*images, strict=True)]
        share = max(
            same / num_examined[sequence] for same, sequence in zip(num_same, pair, strict=True)
        )
        if min(num_same) >= _FEWEST_SAME and share >= _SAME_SHARE:
            found.append((image_set.videos[pair[0]], image_set.videos[pair[1]]))
    return tuple(found)


def with_parts(report: LinkReport, merged: MatchedImages, image_set: ImageSet) -> LinkReport:
    """Add the connected groups of several videos and photos to the report."""
    if image_set.num_sequences == 1:
        return report
    num_videos = len(image_set.videos)
    groups = _connected_sequences(merged, image_set)
    parts = [
        tuple(image_set.videos[sequence] for sequence in g if sequence < num_videos) for g in groups
    ]
    parts = [part for part in parts if part]
    alone = sorted(sequence for g in groups if min(g) >= num_videos for sequence in g)
    first = image_set.first_frame.tolist()
    return replace(
        report,
        videos=tuple(zip(image_set.videos, first, strict=False)) if num_videos > 1 else (),
        parts=tuple(parts) if len(parts) > 1 else (),
        unlinked_photos=tuple(
            image_set.images.names[image_set.images_of(sequence).start] for sequence in alone
        ),
    )


def _connected_sequences(matched: MatchedImages, image_set: ImageSet) -> list[list[int]]:
    """Group videos and photos that image pairs connect, the group with the most images first."""
    count = image_set.num_sequences
    # A sequence and a component of images are connected if they have an image in common.
    edges = np.column_stack([image_set.sequence, count + connected_images(matched)])
    label = connected_components(count + len(image_set.sequence), edges)[:count]
    parts = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    size = np.bincount(image_set.sequence, minlength=count)
    return sorted(parts, key=lambda part: (-int(size[part].sum()), part))
