"""Where a video was taken, carried over to a stream that is made of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.video.container import VideoFile, open_container, read_file
from colmap_av1.video.metadata.positions import Positions, read_positions

# Apple's and Android's names of tags, which FFmpeg writes to .mp4 files only when told to.
_KEYS = "com."
# FFmpeg's words for subtitles, by the formats that hold them, and containers of the same kind.
_SUBTITLES = {"mp4": ("mov_text", "mov"), "matroska": ("srt", "matroska")}
# Seconds by which times may differ that are the same: containers round them.
_SAME_TIME = 0.01


def carrying(
    video: VideoFile, found: Positions | None, output_format: str
) -> tuple[list[str], list[str]]:
    """FFmpeg's words that take positions and gravity over from a video.

    Args:
        video: the video, which is the first input without regard to edits of its frames.
        found: what it says.
        output_format: FFmpeg's name of the stream's format.

    Returns:
        Words of a second input, and of the output; none of what the format cannot hold.
    """
    words = []
    if output_format == "mp4" and any(name.startswith(_KEYS) for name, _ in video.tags):
        words += ["-movflags", "use_metadata_tags"]
    if found is None or found.stream is None:
        return [], words
    with open_container(video.path) as container:
        kind = container.streams[found.stream].type
    if kind == "subtitle" and output_format in _SUBTITLES:
        codec, alike = _SUBTITLES[output_format]
        how = ["-c:s", "copy" if alike in video.container else codec]
    elif kind == "data" and output_format == "mp4":
        how = ["-c:d", "copy", "-copy_unknown"]
    else:
        return [], words
    # Edits place telemetry beside the frames, of which the stream has those, too, that they hide.
    again = ["-itsoffset", f"{-found.first_picture:.6f}", "-i", f"file:{video}"]
    return again, [*words, "-map", f"1:{found.stream}", *how]


def loss_of(video: VideoFile, found: Positions | None, stream: Path) -> str | None:
    """What a stream lacks of where its video was taken, in words; None where it lacks nothing."""
    if found is None:
        return None
    kept = read_positions(read_file(stream))
    if (
        kept is not None
        and _are_alike(kept.times, found.times)
        and _are_alike(kept.gravity_times, found.gravity_times)
        and (kept.place is not None or found.place is None)
    ):
        return None
    if found.stream is None and len(found.times):
        return (
            f"{found.source} says where {video} was taken, and belongs to that: copy it to "
            f"{stream.with_suffix('.srt')}, too"
        )
    return (
        f"{stream} does not hold where {video} was taken: give an output that ends in .mp4, or "
        "give later commands the video itself"
    )


def _are_alike(times: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Whether times are the same, but for less than a frame."""
    return len(times) == len(others) and bool((np.abs(times - others) < _SAME_TIME).all())
