"""Sets of images and tracks given by lists of frames."""

from __future__ import annotations

import numpy as np

from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import ImageSet, number_images
from colmap_av1.tracks.tracks import Tracks


def images(*counts: int) -> ImageSet:
    """Images of videos named a, b and so on."""
    chosen = [
        ChosenImages([f"{k:03}.png" for k in range(count)], np.arange(count, dtype=np.int32))
        for count in counts
    ]
    return number_images("abcd"[: len(counts)], chosen, counts)


def tracks_from(spans: list[list[int]], num_frames: int = 10) -> Tracks:
    """Track t is observed in the frames spans[t], at (100 t + frame, t)."""
    frame = np.array([f for span in spans for f in span], dtype=np.int32)
    track = np.repeat(np.arange(len(spans)), [len(s) for s in spans])
    offsets = np.concatenate([[0], np.cumsum([len(s) for s in spans])]).astype(np.int64)
    xy = np.stack([100 * track + frame, track], axis=1).astype(np.float32).reshape(-1, 2)
    sigma = np.zeros(len(frame), np.float32)
    confirmed = np.zeros(len(frame), bool)
    return Tracks(num_frames, 640, 480, offsets, frame, xy, sigma, confirmed)
