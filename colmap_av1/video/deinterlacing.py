"""Pictures of two fields, one taken after the other, as camcorders made them: the first field's.

Lines of the other are interpolated by FFmpeg's bwdif, in conversions and for images alike, so that
motion and pictures are of the same moment.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import Any

import av.error
import av.filter

from colmap_av1.errors import BitstreamError

_NAME, _OPTIONS = "bwdif", "mode=send_frame:deint=interlaced"
# ffmpeg's words for it; a picture of a single moment in between stays as it is.
DEINTERLACING = f"{_NAME}={_OPTIONS}"


def deinterlaced(frames: Generator[Any, None, None]) -> Generator[Any, None, None]:
    """Frames as they are stored (av.VideoFrame), each with the lines of its first field alone.

    Raises:
        BitstreamError: as `frames`; those before the damage have been given.
    """
    graph = damage = None
    with closing(frames):
        try:
            for frame in frames:
                graph = graph or _graph_for(frame)
                graph.push(frame)
                yield from _pulled(graph)
        except BitstreamError as error:
            damage = error
    if graph is not None:
        # It holds frames back, as their lines are taken from the next one, too.
        graph.push(None)
        yield from _pulled(graph)
    if damage is not None:
        raise damage


def _graph_for(frame: Any) -> Any:
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
    )
    deinterlacer, sink = graph.add(_NAME, _OPTIONS), graph.add("buffersink")
    source.link_to(deinterlacer)
    deinterlacer.link_to(sink)
    graph.configure()
    return graph


def _pulled(graph: Any) -> Generator[Any, None, None]:
    while True:
        try:
            yield graph.pull()
        except (av.error.BlockingIOError, av.error.EOFError):
            return
