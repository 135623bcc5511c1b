"""Collect the keypoints of images and choose the image pairs to match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.options import PairOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.grouping import groups, indices_in

# Spans below twice this many images are paired at every image. Longer spans are paired at every
# n-th image only, n being the span divided by this number, so the number of pairs stays linear in
# the number of images even if tracks last for the whole video.
_UNTHINNED_SPAN = 64
# Distances in images at which all pairs that share enough tracks are kept.
_NEAR = tuple(range(1, 11))
# Largest mean number of pairs per image, unless the pairs at near distances alone are more.
_MOST_PAIRS = 30


@dataclass(frozen=True)
class ImageKeypoints:
    """Keypoints of one image, one for each track that it observes.

    Attributes:
        xy: float32 [n, 2] position in pixels, (x right, y down), origin at the top-left
            corner of the image: the first pixel's centre is (0.5, 0.5).
        track: int64 [n] track of each keypoint, strictly ascending.
    """

    xy: NDArray[np.float32]
    track: Ints


def next_track(keypoints: Sequence[ImageKeypoints]) -> int:
    """The first number that is higher than those of all tracks."""
    return max((int(own.track.max()) + 1 for own in keypoints if own.track.size), default=0)


def image_keypoints(tracks: Tracks, frames: Sequence[int]) -> list[ImageKeypoints]:
    """Collect the track observations of the frames that become images.

    Tracks with fewer than two observations in these frames are left out.

    Args:
        tracks: tracks of the whole video.
        frames: frame number of each image, strictly ascending.

    Returns:
        One entry per frame, in the same order.

    Raises:
        ImageError: a frame is outside the video, or frames are not ascending.
    """
    chosen = np.asarray(frames, dtype=np.int64).reshape(-1)
    if chosen.size and (chosen.min() < 0 or chosen.max() >= tracks.num_frames):
        raise ImageError(
            f"the images are frames {chosen.min()} to {chosen.max()}, but the video has "
            f"{tracks.num_frames} frames: give images of this video only"
        )
    if np.any(np.diff(chosen) <= 0):
        raise ImageError(
            "two images are the same frame or are not in display order: give one image per frame, "
            "in display order"
        )

    image = indices_in(chosen, tracks.num_frames)[tracks.frame]
    num_tracks = tracks.num_tracks
    track = tracks.track
    seen = image >= 0
    often_enough = np.bincount(track[seen], minlength=num_tracks) >= 2
    kept = np.flatnonzero(seen & often_enough[track])

    # Observations are ordered by track, so a stable sort by image keeps tracks ascending.
    return [
        ImageKeypoints(
            xy=np.ascontiguousarray(tracks.xy[kept[own]], dtype=np.float32),
            track=track[kept[own]],
        )
        for own in groups(image[kept], chosen.size)
    ]


def covisible_pairs(
    keypoints: Sequence[ImageKeypoints],
    min_matches: int,
    *,
    near: Sequence[int] = _NEAR,
    most_pairs: int = _MOST_PAIRS,
) -> NDArray[np.int32]:
    """Choose image pairs that share tracks, at any distance, including revisited places.

    If there are too many pairs, similar pairs are grouped and only the pair that shares the most
    tracks is kept of each group.

    Args:
        keypoints: the keypoints of the images, in display order.
        min_matches: fewest tracks that the images of a pair share.
        near: distances in images at which all pairs are kept.
        most_pairs: largest mean number of pairs per image, unless the pairs at the distances
            `near` alone are more.

    Returns:
        int32 [m, 2] indices into `keypoints`, first < second, in ascending order.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415 - slow to import

    image = np.repeat(np.arange(len(keypoints)), [len(k.track) for k in keypoints])
    track = np.concatenate([k.track for k in keypoints])
    shape = (len(keypoints), int(track.max(initial=-1)) + 1)
    seen = csr_array((np.ones(len(track), np.int32), (image, track)), shape=shape)
    shared = (seen @ seen.T).tocoo()
    first, second = shared.coords
    kept = (first < second) & (shared.data >= min_matches)
    first, second, count = first[kept], second[kept], shared.data[kept]
    always = np.isin(second - first, near)
    most = max(most_pairs * len(keypoints), np.count_nonzero(always) + len(keypoints))
    step = 1
    while True:
        # Divide the pairs (first, second) into squares, and keep the best pair of each.
        square = (first // step) * (len(keypoints) + 1) + second // step
        order = np.lexsort((second, first, -count, square))
        best = np.zeros(len(first), np.bool_)
        best[order[np.unique(square[order], return_index=True)[1]]] = True
        chosen = always | best
        if np.count_nonzero(chosen) <= most or step > len(keypoints):
            break
        step += 1
    pairs = np.column_stack([first[chosen], second[chosen]])
    return pairs[np.lexsort(pairs.T[::-1])].astype(np.int32)


def pair_matches(a: ImageKeypoints, b: ImageKeypoints) -> NDArray[np.uint32]:
    """Match the keypoints of two images that belong to the same track.

    Returns:
        uint32 [n, 2] keypoint indices (in a, in b), ascending in both columns.
    """
    index, is_shared = _same_tracks(a, b)
    in_a = np.flatnonzero(is_shared)
    return np.column_stack([in_a, index[in_a]]).astype(np.uint32)


def schedule_pairs(
    keypoints: Sequence[ImageKeypoints], options: PairOptions = PairOptions()
) -> NDArray[np.int32]:
    """Choose the image pairs to write: every distance for near images, growing distances for far.

    Long spans have the parallax that an incremental mapper needs to start; the last one is the
    longest at which two images still share enough tracks. The triangulator follows written pairs
    only, so short spans are paired at every image. The number of pairs is linear in the number of
    images.

    Args:
        keypoints: the images' keypoints, in display order.
        options: offsets and thresholds.

    Returns:
        int32 [m, 2] indices into `keypoints`, first < second, in ascending order; each pair
        shares at least `options.min_matches` tracks.
    """
    limit = _longest_track_span(keypoints)
    if options.max_span is not None:
        limit = min(limit, options.max_span)

    def pairs_at(span: int) -> list[tuple[int, int]]:
        step = max(1, span // _UNTHINNED_SPAN)
        return [
            (i, i + span)
            for i in range(0, len(keypoints) - span, step)
            if _count_shared(keypoints[i], keypoints[i + span]) >= options.min_matches
        ]

    pairs: list[tuple[int, int]] = []
    reached, failed = 0, limit + 1
    for span in sorted({offset for offset in options.offsets if offset <= limit}):
        found = pairs_at(span)
        pairs += found
        if found:
            reached, failed = span, limit + 1
        else:
            failed = min(failed, span)
    if options.growth > 1:
        while failed > limit > reached:
            span = min(limit, max(reached + 1, round(reached * options.growth)))
            found = pairs_at(span)
            pairs += found
            if found:
                reached = span
            else:
                failed = span
        # Tracks have few gaps, so images share tracks up to the longest span and not beyond it.
        longest: list[tuple[int, int]] = []
        while failed - reached > 1:
            span = (reached + failed) // 2
            found = pairs_at(span)
            if found:
                longest, reached = found, span
            else:
                failed = span
        pairs += longest
    return np.array(sorted(pairs), dtype=np.int32).reshape(-1, 2)


def _count_shared(a: ImageKeypoints, b: ImageKeypoints) -> int:
    return int(np.count_nonzero(_same_tracks(a, b)[1]))


def _same_tracks(own: ImageKeypoints, other: ImageKeypoints) -> tuple[Ints, Bools]:
    """Where another image observes the tracks of an image.

    Returns:
        int64 [n] keypoint of the other image for each of this one, and bool [n] whether it has one;
        without it the index means nothing.
    """
    if other.track.size == 0:
        return np.zeros(own.track.size, np.int64), np.zeros(own.track.size, np.bool_)
    index = np.minimum(np.searchsorted(other.track, own.track), other.track.size - 1)
    return index, other.track[index] == own.track


def _longest_track_span(keypoints: Sequence[ImageKeypoints]) -> int:
    """Largest distance, in images, between the first and the last image of a track."""
    if not keypoints:
        return 0
    track = np.concatenate([k.track for k in keypoints])
    if track.size == 0:
        return 0
    image = np.repeat(np.arange(len(keypoints)), [k.track.size for k in keypoints])
    # Images ascend, so the last write wins for `last`, and in reverse order for `first`.
    first = np.zeros(int(track.max()) + 1, dtype=np.int64)
    last = np.zeros_like(first)
    first[track[::-1]] = image[::-1]
    last[track] = image
    return int((last - first).max())
