"""Copy GPS positions and gravity from a video to the stream converted from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_av1.util.arrays import Floats
from colmap_av1.video.container import VideoFile, open_container, read_file
from colmap_av1.video.metadata.positions import Positions, read_positions

# Tags of Apple and Android begin with this. FFmpeg needs an option to write them to .mp4 files.
_KEYS = "com."
# The codec of subtitles in each output format that holds them.
_SUBTITLES = {"mp4": "mov_text", "matroska": "srt"}
# Equal times may differ by less than this many seconds because containers round them.
_SAME_TIME = 0.01


def carrying(
    video: VideoFile, found: Positions | None, output_format: str, *, ignores_edits: bool
) -> tuple[list[str], list[str]]:
    """FFmpeg's arguments that copy positions and gravity from a video.

    Args:
        video: the video, which is ffmpeg's first input.
        found: its positions and gravity.
        output_format: ffmpeg's name of the output format.
        ignores_edits: whether the edit list of the first input is ignored.

    Returns:
        Arguments for a second input, and for the output; empty if the format cannot hold them.
    """
    words = []
    if output_format == "mp4" and any(name.startswith(_KEYS) for name, _ in video.tags):
        words += ["-movflags", "use_metadata_tags"]
    if found is None or found.stream is None:
        return [], words
    with open_container(video.path) as container:
        kind = container.streams[found.stream].type
    if kind == "subtitle" and output_format in _SUBTITLES:
        is_alike = video.is_mp4 if output_format == "mp4" else video.is_matroska
        how = ["-c:s", "copy" if is_alike else _SUBTITLES[output_format]]
    elif kind == "data" and output_format == "mp4":
        how = ["-c:d", "copy", "-copy_unknown"]
    else:
        return [], words
    again = ["-i", f"file:{video}"]
    if ignores_edits or not video.is_mp4:
        # The stream begins with the first coded frame, whenever it is shown.
        again = ["-itsoffset", f"{-found.first_picture:.6f}", *again]
    return again, [*words, "-map", f"1:{found.stream}", *how]


def loss_of(video: VideoFile, found: Positions | None, stream: Path) -> str | None:
    """Describe which positions of its video a stream lacks; None if it lacks none."""
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
            f"{found.source} holds the positions of {video}, which the stream lacks: copy it to "
            f"{stream.with_suffix('.srt')}, too"
        )
    return (
        f"{stream} does not contain the positions of {video}: give an output that ends in .mp4, "
        "or give later commands the video itself"
    )


def _are_alike(times: Floats, others: Floats) -> bool:
    """Whether times are equal up to less than a frame."""
    return len(times) == len(others) and bool((np.abs(times - others) < _SAME_TIME).all())
