"""Find gaps: neighbouring images of a video whose motion is doubtful, before they are matched.

A low share of inter-coded units shows that the encoder found no motion. After matching,
`few_matches` finds further gaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.options import LinkOptions
from colmap_av1.util.arrays import Bools
from colmap_av1.util.spread import evenly_spread

# Number of frames on either side that a frame is compared with.
_NEIGHBOURS = 8
# A frame has a low inter share if it is below the first value, or below the second value times the
# median of its neighbours. If the camera jerks or a picture is blurred, the encoder finds no motion
# and codes the picture anew: 2 to 24 % inter units where the neighbours have 45 to 95 %, or half of
# their share if it uses vectors that merely compress well. Nearly all ordinary frames have more.
# Nearly no ordinary frame is below the third value times the median.
_LEAST_INTER_SHARE = 0.25
_LEAST_OF_NEIGHBOURS = 0.55
_CERTAINLY_LESS = 0.4
# With this median share of inter units, motion is trusted. 85 % is usual; a drive has 50 to 60 %.
_HIGH_INTER_SHARE = 0.6
# Number of gaps to probe if the share is lower.
_NUM_PROBES = 6
# The motion of a video needs no probes if neighbouring images have this many matches and this share
# of inliers (medians). A drive has 2,000 and 99.8 %. A camera that is too fast for the encoder's
# motion search gives 20 matches, or 150 with 90 % inliers.
_RIGID_MATCHES = 300
_RIGID_SHARE = 0.98

GapReason = Literal["doubtful motion", "few tracks", "contradicted", "no overlap"]


@dataclass(frozen=True)
class Gap:
    """Two neighbouring images of a video that motion connects badly.

    Attributes:
        before: name of the last image before the gap.
        after: name of the first image after it.
        reasons: why. doubtful motion: the encoder found little, or a model or other gaps contradict
            it. contradicted: the pictures contradict the motion or do not confirm it, so its
            matches are left out. few tracks: a mapper may split the images there. no overlap:
            nothing connects the two images.
        frames: the frames of both images, counted through all videos; None if not known.
        share: matches across the gap over the usual number nearby; 1 if not measured.
    """

    before: str
    after: str
    reasons: tuple[GapReason, ...]
    frames: tuple[int, int] | None = None
    share: float = 1.0


def low_inter_frames(inter_share: NDArray[np.float32], *, certain: bool = False) -> Bools:
    """Find frames whose motion is doubtful because few units are inter coded.

    Args:
        inter_share: float32 [num_frames] share of inter units of each shown frame, in display
            order.
        certain: leave out frames that may be ordinary.

    Returns:
        bool [num_frames]; False for the first frame, which has no motion.
    """
    low = np.zeros(len(inter_share), dtype=np.bool_)
    if len(low) < 2:
        return low
    share = _CERTAINLY_LESS if certain else _LEAST_OF_NEIGHBOURS
    own = inter_share[1:]
    around = sliding_window_view(
        np.pad(own, _NEIGHBOURS, constant_values=np.nan), 2 * _NEIGHBOURS + 1
    )
    usual = np.nanmedian(around, axis=1).astype(np.float64)
    low[1:] = own < np.maximum(_LEAST_INTER_SHARE, share * usual).astype(own.dtype)
    return low


def low_inter_gaps(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], *, certain: bool = False
) -> Bools:
    """Find gaps between images that contain a frame with a low inter share.

    Args:
        inter_share: as for `low_inter_frames`.
        frames: int32 [num_images] frame number of each image, ascending.
        certain: as for `low_inter_frames`.

    Returns:
        bool [num_images - 1] for the gap between image i and image i + 1.
    """
    so_far = np.concatenate([[0], np.cumsum(low_inter_frames(inter_share, certain=certain))])
    return np.asarray(so_far[frames[1:] + 1] > so_far[frames[:-1] + 1])


def probed_gaps(inter_share: NDArray[np.float32], low: Bools, options: LinkOptions) -> list[int]:
    """Choose gaps at which to compare motion with the pictures, to decide whether to trust it.

    Empty if most units are inter-coded. If the camera is too fast for the encoder's motion search,
    the encoder uses whatever vectors compress well, which need not be motion.
    """
    if options.links == "none" or len(inter_share) < 2:
        return []
    if float(np.median(inter_share[1:])) >= _HIGH_INTER_SHARE:
        return []
    others = np.flatnonzero(~low)
    return [int(gap) for gap in others[evenly_spread(len(others), _NUM_PROBES, rounded=True)]]


@dataclass(frozen=True)
class SuspectGaps:
    """Gaps between images of all videos whose motion may be wrong.

    Attributes:
        certain: bool [num_images - 1] gaps with a low inter share.
        maybe: bool [num_images - 1] gaps with a lowered inter share that may be ordinary.
        probes: other gaps, a sample of all gaps of their video.
    """

    certain: Bools
    maybe: Bools
    probes: list[int]


def suspect_gaps(
    image_set: ImageSet,
    matched: MatchedImages,
    inter_share: NDArray[np.float32],
    options: LinkOptions,
) -> SuspectGaps:
    """Find the gaps whose motion may be wrong; the gap between two videos is never one of them."""
    certain = np.zeros(max(len(image_set.sequence) - 1, 0), dtype=np.bool_)
    maybe, probes = np.zeros_like(certain), list[int]()
    for video in range(len(image_set.videos)):
        share = inter_share[image_set.first_frame[video] : image_set.first_frame[video + 1]]
        images, frames = image_set.images_of(video), image_set.of_video(video).frames
        low, own = low_inter_gaps(share, frames), slice(images.start, images.stop - 1)
        certain[own] = low_inter_gaps(share, frames, certain=True)
        maybe[own] = low & ~certain[own]
        if not _is_rigid(matched, images):
            probes += [images.start + gap for gap in probed_gaps(share, low, options)]
    return SuspectGaps(certain, maybe, probes)


def _is_rigid(matched: MatchedImages, images: range) -> bool:
    """Whether the motion between neighbouring images of a video is that of a rigid scene."""
    counts = [
        (len(matches), len(geometry.inlier_matches))
        for (i, j), matches, geometry in zip(
            matched.pairs.tolist(), matched.matches, matched.geometries, strict=True
        )
        if i in images and j == i + 1
    ]
    if 2 * len(counts) < len(images):
        return False
    num_matches, num_inliers = np.array(counts).T
    share = np.median(num_inliers / np.maximum(num_matches, 1))
    return bool(np.median(num_matches) >= _RIGID_MATCHES and share >= _RIGID_SHARE)
