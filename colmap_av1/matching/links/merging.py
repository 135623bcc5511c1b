"""Merge the links with the matches of tracks, or convert them to tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.matching.features.sift import Features
from colmap_av1.matching.links.matching import Links
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints, next_track
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Ints
from colmap_av1.util.graphs import connected_components

# A feature this close to a track's keypoint, in pixels, is the same keypoint.
_JOIN_DISTANCE = 1.0
# Expected error of a feature in pixels.
_SIGMA = 0.5


def merge_links(
    matched: MatchedImages,
    links: Links,
    features: dict[int, Features],
    dropped: Sequence[int],
) -> MatchedImages:
    """Add linked features and their matches, and drop motion across the gaps `dropped`."""
    used: dict[int, set[int]] = {}
    for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True):
        used.setdefault(i, set()).update(geometry.inlier_matches[:, 0].tolist())
        used.setdefault(j, set()).update(geometry.inlier_matches[:, 1].tolist())
    num_tracks = next_track(matched.keypoints)
    keypoints = list(matched.keypoints)
    keypoint: dict[int, Ints] = {}
    for image, indices in used.items():
        keypoints[image], keypoint[image] = _with_features(
            keypoints[image], features[image].xy, sorted(indices), num_tracks
        )
        num_tracks += len(indices)
    rows: dict[tuple[int, int], tuple[NDArray[np.uint32], TwoViewGeometry]] = {}
    gap = np.array(dropped, dtype=np.int64)
    for k, (i, j) in enumerate(matched.pairs.tolist()):
        if not np.any((i <= gap) & (gap < j)):
            rows[i, j] = matched.matches[k], matched.geometries[k]
    for k, (i, j) in enumerate(links.pairs.tolist()):
        geometry = links.geometries[k]
        inliers = np.column_stack(
            [keypoint[i][geometry.inlier_matches[:, 0]], keypoint[j][geometry.inlier_matches[:, 1]]]
        ).astype(np.uint32)
        own = replace(geometry, inlier_matches=inliers)
        if (i, j) in rows:
            rows[i, j] = _joined_matches(*rows[i, j], inliers, own)
        else:
            rows[i, j] = inliers, own
    order = sorted(rows)
    return replace(
        matched,
        keypoints=keypoints,
        pairs=np.array(order, dtype=np.int32).reshape(-1, 2),
        matches=[rows[pair][0] for pair in order],
        geometries=[rows[pair][1] for pair in order],
    )


def _with_features(
    keypoints: ImageKeypoints, xy: NDArray[np.float32], indices: list[int], first_track: int
) -> tuple[ImageKeypoints, Ints]:
    """Add some features to keypoints; also return the index of each feature, -1 if not added.

    A feature that lies on a track's keypoint joins it; if there are several, the nearest does.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    keypoint = np.full(len(xy), -1, dtype=np.int64)
    taken: dict[int, tuple[float, int]] = {}
    if len(keypoints.xy):
        distance, nearest = cKDTree(keypoints.xy).query(xy[indices])
        for index, d, k in zip(indices, distance.tolist(), nearest.tolist(), strict=True):
            if d <= _JOIN_DISTANCE and d < taken.get(k, (np.inf, 0))[0]:
                taken[k] = d, index
    for k, (_, index) in taken.items():
        keypoint[index] = k
    new = [index for index in indices if keypoint[index] < 0]
    keypoint[new] = len(keypoints.xy) + np.arange(len(new))
    return (
        replace(
            keypoints,
            xy=np.concatenate([keypoints.xy, xy[new]]).astype(np.float32),
            track=np.concatenate([keypoints.track, first_track + np.arange(len(new))]),
        ),
        keypoint,
    )


def _joined_matches(
    matches: NDArray[np.uint32],
    geometry: TwoViewGeometry,
    link_matches: NDArray[np.uint32],
    link: TwoViewGeometry,
) -> tuple[NDArray[np.uint32], TwoViewGeometry]:
    """Join the matches of tracks and of a link; keep the geometry that has more inliers.

    A keypoint has one match per image. Inliers take precedence, and tracks before links.
    """

    def joined(a: NDArray[np.uint32], b: NDArray[np.uint32]) -> NDArray[np.uint32]:
        free = ~np.isin(b[:, 0], a[:, 0]) & ~np.isin(b[:, 1], a[:, 1])
        return np.concatenate([a, b[free]])

    leading = geometry if len(geometry.inlier_matches) >= len(link.inlier_matches) else link
    if geometry.config == TwoViewConfig.DEGENERATE:
        leading = link
    inliers = joined(geometry.inlier_matches, link.inlier_matches)
    every = joined(joined(inliers, matches), link_matches)
    return every, replace(leading, inlier_matches=inliers)


def links_as_tracks(
    links: Links,
    features: dict[int, Features],
    frames: NDArray[np.int32],
    num_frames: int,
    size: tuple[int, int],
) -> Tracks:
    """Convert links to tracks of connected features; drop tracks with two features in a frame."""
    images = sorted(features)
    counts = [len(features[i].xy) for i in images]
    first = dict(zip(images, np.concatenate([[0], np.cumsum(counts)])[:-1].tolist(), strict=True))
    total = int(sum(counts))
    ends = [
        geometry.inlier_matches.astype(np.int64) + np.array([first[i], first[j]])
        for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True)
    ]
    if not ends:
        return Tracks.empty(num_frames, size)
    label = connected_components(total, np.concatenate(ends))
    frame = np.repeat(frames[images], counts)
    order = np.lexsort((frame, label))
    twice = (np.diff(label[order]) == 0) & (np.diff(frame[order]) == 0)
    clear = ~np.isin(label, label[order][1:][twice])
    xy = np.concatenate([features[i].xy for i in images])
    return Tracks.from_observations(
        num_frames,
        size,
        track=label[clear],
        frame=frame[clear],
        xy=xy[clear],
        sigma=_SIGMA,
        min_length=2,
    )
