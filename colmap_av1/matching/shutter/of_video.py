"""The read-out time of a video's shutter, by its tracks."""

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

# Share of the time by which it may be off in all parts of a video: velocities are means, so it
# comes out a tenth too short on rendered clips of 15 and 30 ms.
_OFF_ALIKE = 0.12


@dataclass(frozen=True)
class VideoReadOut:
    """The time in which the shutter of a video reads the rows of a picture.

    Attributes:
        milliseconds: from the first row to the last, below 0 where rows are read from the bottom.
        error: what it may be off by in milliseconds: half the difference of what every second
            pair of frames says and the others do, and a share of it.
    """

    milliseconds: float
    error: float


def estimate_video_read_out(
    video: str | os.PathLike[str],
    options: ReadOptions | None = None,
    progress: Progress | None = None,
) -> VideoReadOut | str:
    """Estimate the time in which the shutter of an AV1 video reads the rows of a picture.

    Its motion is chained into tracks; the focal length comes from these, too. This is what
    `--rolling_shutter estimate` corrects keypoints for.

    Args:
        video: the AV1 video.
        options: how its bitstream is read.
        progress: called with the stage "motion" and the number of frames so far.

    Returns:
        The time; in words why it cannot be told.

    Raises:
        VideoError: the video cannot be read, or shows no frame.
        NotAv1Error: it is of another codec.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: the frames change their size.
    """
    opened = read_video(video)
    if opened.frame_rate is None:
        return "the container says no frame rate"
    if not is_square(opened.display.pixel_aspect):
        return "pixels are not square"
    context = RunContext(progress=progress if progress is not None else no_progress)
    tracks = track_video(
        VideoSource(opened, opened),
        TrackingOptions(options if options is not None else ReadOptions()),
        one_size=True,
        context=context,
    ).tracks
    down = rows_down(opened.display, (tracks.width, tracks.height))
    found = estimate_read_out(tracks, down, None, context.seed)
    if isinstance(found, str):
        return found
    period = 1000 / opened.frame_rate
    error = math.hypot(found.error, _OFF_ALIKE * found.frames)
    return VideoReadOut(found.frames * period, error * period)
