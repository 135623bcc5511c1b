"""The tracks that a joint estimate uses, and the masks of dynamic objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from colmap_av1.geometry.masks import Mask
from colmap_av1.tracks.tracks import Tracks


@dataclass(frozen=True)
class EstimateTracks:
    """The tracks that a joint estimate uses, and the masks of dynamic objects.

    Attributes:
        motion: the motion tracks of all videos, cut at gaps that links replace and at seams of
            splits, without dynamic pixels.
        link_tracks: SIFT links as tracks, without dynamic pixels.
        has_picture_positions: whether tracks have positions in the pictures; false if they were
            corrected for a rolling shutter. Pictures are not used then.
        dynamic_masks: masks that exclude dynamic pixels, by image name; empty if these are not
            looked for yet, or not at all.
        masks_digest: digest of the stage that found them; None if there are none.
    """

    motion: Tracks
    link_tracks: Tracks
    has_picture_positions: bool
    dynamic_masks: Mapping[str, Mask] = field(default_factory=dict)
    masks_digest: str | None = None
