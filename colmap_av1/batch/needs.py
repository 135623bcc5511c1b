"""What a video takes of a machine, estimated from the facts of its file."""

from __future__ import annotations

import math

from colmap_av1.batch.jobs import Needs, Work
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.video.container import VideoFile

_GIB = 1 << 30
# The package itself, and what a short clip takes.
_LEAST_MEMORY = _GIB // 2
# Bytes for a pixel of every frame, and for a pixel of a picture.
_OF_VIDEO = {"info": 0.0, "match": 2.0, "densify": 6.0, "reconstruct": 6.0}
_OF_PICTURE = 200
_UNKNOWN_FRAMES = 1000
# Machines for hire have 4 GB of memory a core, or twice as much: a video that takes more
# memory gets the cores that would otherwise stand idle beside it.
_MEMORY_OF_CORE = 4 * _GIB


def least_needs(work: Work) -> Needs:
    """What is reserved for a video of which nothing is known."""
    return Needs(work.cores or 1, work.memory or _LEAST_MEMORY)


def estimated_needs(work: Work, file: VideoFile) -> Needs:
    """What a video takes by its size and length, unless the batch says it."""
    pixels = math.prod(file.stored_size)
    frames = file.likely_num_packets or _UNKNOWN_FRAMES
    of_frames = _OF_VIDEO[work.task] * pixels * frames
    memory = work.memory or int(_LEAST_MEMORY + of_frames + _OF_PICTURE * pixels)
    cores = work.cores or min(threads_or_cpus(None), math.ceil(memory / _MEMORY_OF_CORE))
    return Needs(cores, memory)


def fits(needs: Needs, reserved: Needs) -> bool:
    """Whether what was reserved is enough."""
    return needs.cores <= reserved.cores and needs.memory <= reserved.memory
