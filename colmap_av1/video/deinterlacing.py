"""Deinterlace pictures, whose two fields camcorders took one after the other.

The first field is kept, and FFmpeg's filter bwdif interpolates the lines of the second. The same
filter is used in conversions and for images, so that motion and images show the same moment.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from typing import Any

import av.error
import av.filter

from colmap_av1.errors import BitstreamError

_NAME, _OPTIONS = "bwdif", "mode=send_frame:deint=interlaced"
# The filter as ffmpeg spells it. Progressive pictures in between are not changed.
DEINTERLACING = f"{_NAME}={_OPTIONS}"


def deinterlaced(frames: Generator[Any, None, None]) -> Generator[Any, None, None]:
    """Deinterlace stored frames (av.VideoFrame), keeping the first field of each.

    Frames may change their size.

    Raises:
        BitstreamError: as `frames`; the frames before the damage have been yielded.
    """
    graph = shape = damage = None
    with closing(frames):
        try:
            for frame in frames:
                own = frame.width, frame.height, frame.format.name
                if graph is not None and own != shape:
                    yield from _flushed(graph)
                    graph = None
                if graph is None:
                    graph, shape = _graph_for(frame), own
                graph.push(frame)
                yield from _pulled(graph)
        except BitstreamError as error:
            damage = error
    if graph is not None:
        yield from _flushed(graph)
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


def _flushed(graph: Any) -> Generator[Any, None, None]:
    """The frames that the filter delays because it also interpolates from the next one."""
    graph.push(None)
    yield from _pulled(graph)


def _pulled(graph: Any) -> Generator[Any, None, None]:
    while True:
        try:
            yield graph.pull()
        except (av.error.BlockingIOError, av.error.EOFError):
            return
