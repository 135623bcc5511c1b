"""Estimate the read-out time of a video's rolling shutter from its tracks."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

from colmap_av1.geometry.cameras import is_square
from colmap_av1.matching.shutter.correct import rows_down
from colmap_av1.matching.shutter.estimate import estimate_read_out
from colmap_av1.options import ReadOptions, TrackingOptions
from colmap_av1.tracks.video_tracks import VideoSource, track_video
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.facts import read_video

# Systematic error as a share of the read-out time. Velocities are averages, so estimates are a
# tenth too short on rendered clips with 15 and 30 ms.
_SYSTEMATIC_ERROR = 0.12


@dataclass(frozen=True)
class VideoReadOut:
    """The time in which the shutter of a video reads the rows of a picture.

    Attributes:
        milliseconds: from the first row to the last; negative if rows are read from the bottom.
        error: uncertainty in milliseconds: half the difference of the estimates from even and from
            odd pairs of frames, combined with a systematic error.
    """

    milliseconds: float
    error: float


def estimate_video_read_out(
    video: str | os.PathLike[str],
    *,
    options: ReadOptions = ReadOptions(),
    progress: Progress = no_progress,
) -> VideoReadOut | str:
    """Estimate the time in which the shutter of an AV1 video reads the rows of a picture.

    The focal length is estimated as well. `--rolling_shutter estimate` corrects keypoints for this
    time.

    Args:
        video: the AV1 video.
        options: how its bitstream is read.
        progress: called with the stage "motion" and the number of frames so far.

    Returns:
        The time, or the reason why it is not observable.

    Raises:
        VideoError: the video cannot be read, or shows no frame.
        NotAv1Error: the video has another codec.
        BitstreamError: the stream is damaged, and `strict` is set or fewer than two frames precede
            the damage.
        ImageError: the frame size changes.
    """
    opened = read_video(video)
    if opened.frame_rate is None:
        return "the container has no frame rate"
    if not is_square(opened.display.pixel_aspect):
        return "pixels are not square"
    context = RunContext(progress=progress)
    tracks = track_video(
        VideoSource(opened, opened),
        TrackingOptions(options),
        one_size=True,
        context=context,
    ).tracks
    down = rows_down(opened.display, (tracks.width, tracks.height))
    found = estimate_read_out(tracks, down, None, context.seed)
    if isinstance(found, str):
        return found
    period = 1000 / opened.frame_rate
    error = math.hypot(found.error, _SYSTEMATIC_ERROR * found.frames)
    return VideoReadOut(found.frames * period, error * period)
