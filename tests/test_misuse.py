"""Wrong calls of the Python API give an error that names the argument, and do not hang."""

from __future__ import annotations

import dataclasses
import gc
import os
import signal
import struct
import weakref
from pathlib import Path
from typing import Any

import pytest
from conftest import PROJECT

from colmap_av1 import ReadOptions, TrackOptions, build_tracks, read_motion
from colmap_av1.errors import BitstreamError, OptionError, VideoError
from colmap_av1.motion import reading
from colmap_av1.video.container import open_stream

VIDEO = PROJECT / "tests" / "data" / "conformance" / "svt4_p6.ivf"


def test_invalid_motion_is_refused() -> None:
    for value in ("text", b"bytes", [1]):
        with pytest.raises(TypeError, match="motion"):
            build_tracks(value)


@pytest.mark.parametrize("number", [1 << 31, 1 << 40, 1 << 80, -(1 << 31) - 1])
def test_integers_beyond_32_bits_are_refused(number: int) -> None:
    with pytest.raises(OptionError, match="operating_point"):
        ReadOptions(operating_point=number)
    with pytest.raises(OptionError, match="num_threads"):
        ReadOptions(num_threads=number)
    with pytest.raises(OptionError, match="min_length"):
        TrackOptions(min_length=number)
    frame = next(iter(read_motion(VIDEO)))
    for field in ("decode_index", "display_index", "width", "height"):
        with pytest.raises(TypeError, match=field):
            build_tracks([dataclasses.replace(frame, **{field: number})])


def test_arrays_of_wrong_shape_are_refused() -> None:
    frame = next(iter(read_motion(VIDEO)))
    for field in ("mv", "ref_frame", "mi_size", "warp_index", "ref_size"):
        values = getattr(frame, field)
        for wrong in (values[..., :0], values[None], None, "text", 5):
            with pytest.raises((TypeError, ValueError), match=field):
                build_tracks([dataclasses.replace(frame, **{field: wrong})])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs the processes of a Unix system")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("num_threads", [1, 4])
def test_fork_while_reading_is_an_error_in_the_child(num_threads: int) -> None:
    """The child gets an error, and the parent continues to read."""
    wanted = [frame.decode_index for frame in read_motion(VIDEO)]
    frames = read_motion(VIDEO, ReadOptions(num_threads=num_threads))
    found = [next(frames).decode_index]
    child = os.fork()
    if child == 0:
        signal.alarm(30)
        status = 1
        try:
            list(frames)
        except VideoError as error:
            status = 0 if "forked" in str(error) else 2
        finally:
            del frames
            gc.collect()
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert found + [frame.decode_index for frame in frames] == wanted


@pytest.mark.parametrize("num_threads", [1, 4])
def test_failed_reader_is_freed_with_its_error(
    num_threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failed reader has no reference cycles, so the garbage collector is not needed."""
    data = bytearray(VIDEO.read_bytes())
    (size,) = struct.unpack_from("<I", data, 32)
    data[44 + size // 2 : 44 + size] = bytes(size - size // 2)  # a hole
    (tmp_path / "a.ivf").write_bytes(data)
    alive: list[weakref.ref[object]] = []

    def opened(video: Any) -> Any:
        stream = open_stream(video)
        alive.append(weakref.ref(stream))
        return stream

    monkeypatch.setattr(reading, "open_stream", opened)
    gc.collect()
    gc.disable()
    try:
        for _ in range(2):
            with pytest.raises(BitstreamError) as caught:
                list(read_motion(tmp_path / "a.ivf", ReadOptions(num_threads=num_threads)))
            del caught
        assert len(alive) >= 4
        assert [reference() for reference in alive] == [None] * len(alive)
    finally:
        gc.enable()
