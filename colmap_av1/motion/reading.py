"""Motion of a video, read from the AV1 bitstream without decoding pixels."""

from __future__ import annotations

import atexit
import os
import queue
import threading
import warnings
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import BitstreamError, LimitError, OptionError
from colmap_av1.motion.frame_motion import BLOCK, FrameMotion
from colmap_av1.options import ReadOptions
from colmap_av1.util.arrays import Floats
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.video.container import check_process, open_stream

# Limit in bytes of the block data that all threads together read ahead.
_READ_AHEAD = 1 << 28
# Bytes per unit in the worst case: 4 for its index and a share of the 60 of its block. In most
# videos, they are 8.
_BYTES_PER_UNIT = 24
_SMALL_AHEAD = 4  # number of frames


@dataclass(frozen=True)
class _Group:
    """Packets from a shown key frame to the next, which refer to no packet before them.

    Threads can therefore read groups independently.

    Attributes:
        first_packet: index of the first packet.
        start: state of the parser before it; None at the start of the stream.
    """

    first_packet: int
    start: _core.RestartPoint | None


@dataclass(frozen=True)
class _Index:
    """Facts from the headers of a stream.

    Attributes:
        shown: for each shown frame, in output order, the event that decoded it.
        times: the presentation time of each shown frame in seconds; None if the container gives
            none.
        groups: the groups in bitstream order.
        num_units: number of units of the largest frame.
    """

    shown: list[int]
    times: list[float | None]
    groups: list[_Group]
    num_units: int


def read_motion(
    video: str | PathLike[str], options: ReadOptions = ReadOptions()
) -> Iterator[FrameMotion]:
    """Read the motion of every coded frame of an AV1 video, in bitstream order.

    No pixel is decoded. The headers are read in a first pass to find the display order, because
    a later header determines when a hidden frame is shown. Memory grows with the length of the
    video by only a few bytes per frame.

    Args:
        video: a file that `colmap_av1.video.container.open_stream` can open.
        options: how the bitstream is read.

    Yields:
        One FrameMotion per coded frame. From a damaged stream the frames before the damage are
        yielded, with a warning; see Raises. Some encoders end tiles with other bits than the
        specification requires; these tiles are read as decoders read them, with a warning.

    Raises:
        BitstreamError: the stream is damaged before its first frame is complete; with
            `options.strict`, it is damaged anywhere or a tile does not end as specified.
        LimitError: a frame is larger than `options.max_frame_size`.
        OptionError: the stream does not have `options.operating_point`.
        VideoError: the file cannot be read as a video, or is not AV1 (NotAv1Error).

    Examples:
        >>> from colmap_av1 import read_motion
        >>> inter_units = [int(frame.is_inter.sum()) for frame in read_motion("video.mp4")]
        >>> len(inter_units), inter_units[0]  # the first frame is a key frame
        (60, 0)
    """
    index = _read_index(video, options)
    display_index: dict[int, int] = {}
    for number, decode_index in enumerate(index.shown):
        display_index.setdefault(decode_index, number)
    count = num_wrong = 0
    try:
        for event in _read_events(video, options, index):
            if event.is_repeated:
                continue
            num_wrong += event.num_wrong_trailing_bits > 0
            yield _frame_motion(event, display_index)
            count += 1
    except BitstreamError as error:
        if options.strict:
            raise
        if count == 0:
            raise BitstreamError(f"{error}: no frame can be read: give another copy") from error
        warnings.warn(f"{error}; the {count} frames before the damage are used", stacklevel=2)
    if num_wrong:
        warnings.warn(
            f"{video}: {num_wrong} of {count} frames have tiles that do not end with the bits "
            "the specification requires; they are read as decoders read them",
            stacklevel=2,
        )


def first_showings(video: str | PathLike[str], options: ReadOptions) -> NDArray[np.int32]:
    """For each picture that the headers of a stream show, the display index of its first showing.

    A stream may show a picture several times. Such pictures are not among those of `read_motion`.

    Returns:
        int32 [num_shown], up to the first damage of the headers.

    Raises:
        LimitError, OptionError, VideoError: as `read_motion`.
    """
    shown = np.array(_read_index(video, options).shown, dtype=np.int64)
    _, first, number = np.unique(shown, return_index=True, return_inverse=True)
    return first[number].astype(np.int32)


def frame_times(video: str | PathLike[str], options: ReadOptions = ReadOptions()) -> Floats | None:
    """Presentation times of the frames that the headers of a stream show, in output order.

    Returns:
        float64 [num_shown] seconds, strictly ascending, up to the first damage of the headers; None
        if the container gives no times or times that do not ascend.

    Raises:
        LimitError, OptionError, VideoError: as `read_motion`.
    """
    times = np.array(_read_index(video, options).times, dtype=np.float64)  # NaN for None
    return times if np.isfinite(times).all() and (np.diff(times) > 0).all() else None


def count_with_repeats(first: NDArray[np.int32], num_shown: int) -> int:
    """Number of shown frames, including repeats of earlier frames at the end.

    Args:
        first: see `first_showings`.
        num_shown: number of frames up to the last one that `read_motion` has read.
    """
    new = np.flatnonzero(first[num_shown:] >= num_shown)
    return num_shown + int(new[0]) if len(new) else max(num_shown, len(first))


def _read_index(video: str | PathLike[str], options: ReadOptions) -> _Index:
    """Read the headers of a video up to the first damage.

    A temporal unit with several spatial layers outputs only the highest one (7.18.1).
    """
    shown: list[int] = []
    times: list[float | None] = []
    groups = [_Group(0, None)]
    num_units = 0
    last_unit = -1
    parser = _core.Parser(
        operating_point=options.operating_point,
        headers_only=True,
        max_frame_size=options.max_frame_size,
    )
    try:
        with open_stream(video) as stream:
            if stream.configuration:
                list(_parse(parser, stream.configuration, video, options))
            for packet in stream.packets():
                start = _restart_point(parser)
                for i, event in enumerate(_parse(parser, packet.data, video, options)):
                    if i == 0 and event.is_shown_key_frame and start and packet.index > 0:
                        groups.append(_Group(packet.index, start))
                    if not event.is_repeated:
                        num_units = max(num_units, event.num_units)
                    if not event.is_shown:
                        continue
                    decoded = event.shown_decode_index if event.is_repeated else event.decode_index
                    if event.temporal_unit == last_unit and shown:
                        shown.pop()
                        times.pop()
                    last_unit = event.temporal_unit
                    shown.append(decoded)
                    times.append(packet.pts)
    except BitstreamError:
        pass
    sequence = parser.sequence_header()
    if sequence is not None:
        point, last = options.operating_point, sequence["operating_points_cnt_minus_1"]
        if point > last:
            points = f"points 0 to {last}" if last else "only point 0"
            raise OptionError(f"{video}: has no operating_point {point}: the stream has {points}")
    return _Index(shown, times, groups, num_units)


def _restart_point(parser: _core.Parser) -> _core.RestartPoint | None:
    try:
        return parser.restart_point()
    except _core.BitstreamError:  # the parser is inside a frame
        return None


def _parse(
    parser: _core.Parser,
    data: bytes | memoryview,
    video: str | PathLike[str],
    options: ReadOptions,
) -> Iterator[_core.Event]:
    """Parse a packet; each event is yielded before the next frame is parsed."""
    position = 0
    while position < len(data):
        try:
            event, position = parser.parse(data, position)
        except _core.BitstreamError as error:
            raise BitstreamError(f"{video}: {error}") from error
        except _core.LimitError as error:
            raise LimitError(
                f"{video}: {error} of {options.max_frame_size} samples: allow more with "
                "max_frame_size"
            ) from error
        if event is not None:
            yield event


def _read_events(
    video: str | PathLike[str], options: ReadOptions, index: _Index
) -> Generator[_core.Event, None, None]:
    """Events of the parser in bitstream order; those before an error are yielded first."""
    num_threads = threads_or_cpus(options.num_threads)
    if num_threads == 1:
        for _, event in _read_groups(video, options, index.groups, num_threads=num_threads):
            if event is not None:
                yield event
        return
    num_readers = min(num_threads, len(index.groups))
    depth = _SMALL_AHEAD  # enough for one reader to work while the caller uses the frames
    if num_readers > 1:
        depth = max(2, _READ_AHEAD // (num_readers * _BYTES_PER_UNIT * max(1, index.num_units)))
    stop = threading.Event()
    ahead: list[queue.Queue[tuple[int, Any]]] = [queue.Queue(depth) for _ in range(num_readers)]

    def work(reader: int) -> None:
        items = _read_groups(
            video,
            options,
            index.groups,
            reader=reader,
            num_readers=num_readers,
            num_threads=num_threads // num_readers,
        )
        try:
            for item in items:
                ahead[reader].put(item)
                if stop.is_set():
                    return
        except Exception as error:  # raised again in the caller's thread
            ahead[reader].put((-1, error))
        finally:
            items.close()

    def end() -> None:
        stop.set()
        for thread, waiting in zip(readers, ahead, strict=True):
            while thread.is_alive():
                while not waiting.empty():
                    waiting.get_nowait()
                thread.join(0.01)

    process = os.getpid()
    readers = [threading.Thread(target=work, args=(i,), daemon=True) for i in range(num_readers)]
    # If the generator is left open, its threads still run when the interpreter exits. It would
    # unwind them, which C++ treats as an unknown exception, so they are ended before.
    atexit.register(end)
    try:
        for thread in readers:
            thread.start()
        for group in range(len(index.groups)):
            while True:
                check_process(video, process)
                number, item = ahead[group % num_readers].get()
                if number != group:
                    try:
                        raise item
                    finally:
                        del item  # breaks the reference cycle of the exception and this frame
                if item is None:
                    break
                yield item
    finally:
        end()
        atexit.unregister(end)


def _read_groups(
    video: str | PathLike[str],
    options: ReadOptions,
    groups: list[_Group],
    *,
    reader: int = 0,
    num_readers: int = 1,
    num_threads: int,
) -> Generator[tuple[int, _core.Event | None], None, None]:
    """Read every `num_readers`-th group from number `reader` on.

    Each reader demuxes the whole file, which takes about a hundredth of the time of parsing it.

    Yields:
        (index of the group, event); at the end of a group the event is None.
    """
    parser = _core.Parser(
        operating_point=options.operating_point,
        num_threads=num_threads,
        strict=options.strict,
        max_frame_size=options.max_frame_size,
    )
    first_packets = [group.first_packet for group in groups]
    group = 0
    try:
        with open_stream(video) as stream:
            if reader == 0 and stream.configuration:
                for event in _parse(parser, stream.configuration, video, options):
                    yield 0, event
            for packet in stream.packets():
                if group + 1 < len(groups) and packet.index == first_packets[group + 1]:
                    if group % num_readers == reader:
                        yield group, None
                    group += 1
                    start = groups[group].start
                    if num_readers > 1 and start is not None:
                        parser.restart(start)
                if group % num_readers == reader:
                    for event in _parse(parser, packet.data, video, options):
                        yield group, event
                elif group + (reader - group) % num_readers >= len(groups):
                    return  # this reader has read its last group
    except BitstreamError:
        # Damage in the group of another reader is reported by that reader.
        if group % num_readers == reader:
            raise
        return
    if group % num_readers != reader:
        return
    try:
        parser.finish()
    except _core.BitstreamError as error:
        raise BitstreamError(f"{video}: {error}") from error
    yield group, None


def _frame_motion(event: _core.Event, display_index: dict[int, int]) -> FrameMotion:
    def displayed(indices: NDArray[np.int32]) -> NDArray[np.int32]:
        return np.array([display_index.get(int(i), -1) for i in indices], dtype=np.int32)

    header = event.header()
    ref_decode_index = event.ref_decode_index()
    blocks, block_index, local_warp_params = event.take_blocks()
    return FrameMotion(
        decode_index=event.decode_index,
        display_index=display_index.get(event.decode_index, -1),
        width=header["upscaled_width"],
        height=header["frame_height"],
        header=header,
        ref_decode_index=ref_decode_index,
        ref_display_index=displayed(ref_decode_index),
        ref_size=event.ref_size(),
        slot_decode_index=event.slot_decode_index(),
        blocks=blocks.view(BLOCK),
        block_index=block_index,
        local_warp_params=local_warp_params,
    )
