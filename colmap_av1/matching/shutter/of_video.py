"""The read-out time of a video's shutter, by its tracks."""

from __future__ import annotations

import os
from dataclasses import dataclass

from colmap_av1.images.camera import is_square
from colmap_av1.matching.shutter.correct import rows_down
from colmap_av1.matching.shutter.estimate import estimate_read_out
from colmap_av1.options import MatchOptions, ReadOptions
from colmap_av1.tracks.video_tracks import VideoSource, track_video
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.video.facts import read_video


@dataclass(frozen=True)
class VideoReadOut:
    """The time in which the shutter of a video reads the rows of a picture.

    Attributes:
        milliseconds: from the first row to the last, below 0 where rows are read from the bottom.
        error: half the difference in milliseconds of what two halves of the video say.
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
    how = MatchOptions(read=options if options is not None else ReadOptions())
    tracks = track_video(
        VideoSource(opened, opened),
        how,
        one_size=True,
        clock=Clock(),
        progress=progress if progress is not None else no_progress,
    ).tracks
    down = rows_down(opened.display, (tracks.width, tracks.height))
    found = estimate_read_out(tracks, down, None, how.run.seed)
    if isinstance(found, str):
        return found
    period = 1000 / opened.frame_rate
    return VideoReadOut(found.frames * period, found.error * period)
