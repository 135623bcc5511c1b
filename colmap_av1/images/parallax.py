"""The parallax between the frames of a video."""

from __future__ import annotations

import numpy as np

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats
from colmap_av1.util.grouping import groups

# Focal length assumed for fitting the camera's rotation, in units of the longer side. The remaining
# motion depends little on it.
_FOCAL_LENGTH = 1.2
_IRLS_ITERATIONS = 10
# Largest number of tracks, spread over the picture, that the rotation is fitted to.
_MAX_STEPS = 1000
# Share of the whole motion that is added to parallax: in a flat scene, a rotation explains much of
# the motion.
_MOTION_SHARE = 0.1


def parallax(tracks: Tracks) -> Floats:
    """Parallax between consecutive pictures: motion that the camera's rotation does not explain.

    The motion field of a rotation (Longuet-Higgins and Prazdny 1980, for a focal length of 1.2
    times the longer side) is fitted robustly to each pair of neighbouring frames. The parallax is
    the median of the remaining motion. A tenth of the whole motion is added, since in a flat scene
    the rotation explains part of the parallax.

    Returns:
        float64 [num_frames - 1] pixels from each frame to the next, all above 0.
    """
    focal = _FOCAL_LENGTH * max(tracks.width, tracks.height)
    number = tracks.track
    step = np.flatnonzero((np.diff(number) == 0) & (np.diff(tracks.frame) == 1))
    by_frame = groups(tracks.frame[step], tracks.num_frames)
    centre = np.array([tracks.width, tracks.height]) / 2
    found = np.full(max(tracks.num_frames - 1, 0), np.nan)
    for frame in range(len(found)):
        steps = step[by_frame[frame]]
        if len(steps) < 3:
            continue
        steps = steps[:: -(-len(steps) // _MAX_STEPS)]
        motion = (tracks.xy[steps + 1] - tracks.xy[steps]).astype(np.float64)
        remains = motion - _rotation_field(tracks.xy[steps] - centre, motion, focal)
        whole = np.median(np.hypot(motion[:, 0], motion[:, 1]))
        found[frame] = np.median(np.hypot(remains[:, 0], remains[:, 1])) + _MOTION_SHARE * whole
    known = np.isfinite(found)
    # Assume a typical step where no track connects two frames.
    typical = float(np.median(found[known])) if known.any() else 1.0
    return np.maximum(np.where(known, found, typical), 1e-6)


def _rotation_field(xy: Floats, motion: Floats, focal: float) -> Floats:
    """Motion [n, 2] of the best-fitting rotation at positions [n, 2] from the picture's centre."""
    x, y = xy[:, 0] / focal, xy[:, 1] / focal
    columns = np.empty((len(xy), 2, 3))
    columns[:, 0] = focal * np.stack([x * y, -(1 + x * x), y], axis=1)
    columns[:, 1] = focal * np.stack([1 + y * y, -x * y, -x], axis=1)
    weight = np.ones(len(xy))
    field = np.zeros_like(motion)
    for _ in range(_IRLS_ITERATIONS):
        scale = np.sqrt(weight)[:, None]
        rows = (columns * scale[:, :, None]).reshape(-1, 3)
        turn = np.linalg.lstsq(rows, (motion * scale).reshape(-1), rcond=None)[0]
        field = columns @ turn
        # Weights for least absolute residuals, which are robust to other motion.
        weight = 1 / np.maximum(np.hypot(*(motion - field).T), 1e-3)
    return np.asarray(field)
