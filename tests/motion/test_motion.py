"""Threads read groups of frames that start at a key frame."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from colmap_av1 import BitstreamError, FrameMotion, ReadOptions, read_motion
from colmap_av1.motion import reading
from colmap_av1.video.container import open_stream

# A picture with much change, so that frames have more than a few bytes
SOURCE = "testsrc2=size=320x192:rate=25,noise=alls=12:allf=t"
ENCODERS = {
    # Low delay and hidden frames; a key frame every 8 or 7 frames, with a short last group
    "aom.mp4": "-c:v libaom-av1 -cpu-used 8 -usage realtime -lag-in-frames 0 -g 8 -frames:v 28",
    "hidden.mkv": "-c:v libaom-av1 -cpu-used 8 -lag-in-frames 8 -g 7 -keyint_min 7 -frames:v 25",
    "tiles.obu": "-c:v libaom-av1 -cpu-used 8 -usage realtime -tiles 2x1 -g 9 -frames:v 20",
    "svt.ivf": "-c:v libsvtav1 -preset 12 -g 8 -frames:v 30",
}


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("groups")
    for name, words in ENCODERS.items():
        ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "lavfi", "-i", SOURCE]
        subprocess.run([*ffmpeg, *words.split(), "-crf", "40", str(folder / name)], check=True)
    return {name: folder / name for name in ENCODERS}


def assert_same(found: FrameMotion, expected: FrameMotion) -> None:
    for field in dataclasses.fields(FrameMotion):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype, field.name
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        elif isinstance(b, dict):
            assert a.keys() == b.keys()
            for key in b:
                np.testing.assert_array_equal(a[key], b[key], err_msg=key)
        else:
            assert a == b, field.name


def read(video: Path, num_threads: int, strict: bool = False) -> tuple[list[FrameMotion], str]:
    """The frames, and the message of the warning or error at the end."""
    frames: list[FrameMotion] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            frames.extend(read_motion(video, ReadOptions(num_threads=num_threads, strict=strict)))
        except BitstreamError as error:
            return frames, f"{type(error).__name__}: {error}"
    return frames, "".join(str(w.message) for w in caught)


@pytest.mark.parametrize("name", ENCODERS)
@pytest.mark.parametrize("num_threads", [2, 3, 16])
def test_result_does_not_depend_on_threads(
    clips: dict[str, Path], name: str, num_threads: int
) -> None:
    expected, words = read(clips[name], 1)
    keys = [f for f in expected if f.header["frame_type"] == 0 and f.header["show_frame"]]
    assert len(keys) >= 3
    assert words == ""
    found, words = read(clips[name], num_threads)
    assert words == ""
    assert len(found) == len(expected) > 0
    for a, b in zip(found, expected, strict=True):
        assert_same(a, b)


def test_groups_are_read_by_several_threads(
    clips: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    used: set[threading.Thread] = set()  # their numbers are used again after they end
    parse = reading._parse

    def note_thread(*arguments: object) -> Iterator[object]:
        used.add(threading.current_thread())
        return parse(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(reading, "_parse", note_thread)
    list(read_motion(clips["aom.mp4"], ReadOptions(num_threads=3)))
    assert len(used) == 4  # a further thread reads the headers


def test_reader_waits_until_frames_are_used(
    clips: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, _ = read(clips["aom.mp4"], 1)
    monkeypatch.setattr(reading, "_READ_AHEAD", 0)
    found, _ = read(clips["aom.mp4"], 2)
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert_same(a, b)


@pytest.mark.parametrize("used", [0, 1, 9])
def test_threads_end_with_the_iterator(clips: dict[str, Path], used: int) -> None:
    before = threading.active_count()
    frames = read_motion(clips["aom.mp4"], ReadOptions(num_threads=2))
    for _ in range(used):
        next(frames)
    frames.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before


@pytest.mark.parametrize("damaged", [5, 8, 13, 27])
@pytest.mark.parametrize("strict", [False, True])
def test_damage_is_found_at_the_same_place_with_threads(
    clips: dict[str, Path], tmp_path: Path, damaged: int, strict: bool
) -> None:
    """Damages the blocks of a frame or a whole packet, in the first, middle and last group."""
    source = clips["aom.mp4"]
    data = bytearray(source.read_bytes())
    with open_stream(source) as stream:
        packet = bytes(list(stream.packets())[damaged].data)
    at = data.index(packet)
    for kind, where in {"blocks": slice(len(packet) // 2, None), "all": slice(0, None)}.items():
        broken = bytearray(packet)
        broken[where] = b"\xa5" * len(broken[where])
        data[at : at + len(packet)] = broken
        video = tmp_path / f"{kind}.mp4"
        video.write_bytes(data)
        expected, words = read(video, 1, strict)
        assert words
        assert len(expected) == damaged
        for num_threads in (2, 5):
            found, found_words = read(video, num_threads, strict)
            assert found_words == words
            assert len(found) == len(expected)
            for a, b in zip(found, expected, strict=True):
                assert_same(a, b)


# With thread stacks of 1 GB and less address space, no thread can be started.
_WITHOUT_THREADS = """
import resource, sys
from pathlib import Path
from colmap_av1 import _core
parser = _core.Parser(num_threads=4)
data = Path(sys.argv[1]).read_bytes()
used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 29), resource.RLIM_INFINITY))
num_frames = position = 0
while position < len(data):
    event, position = parser.parse(data, position)
    num_frames += event is not None
print(num_frames)
"""


@pytest.mark.skipif(
    sys.platform != "linux", reason="limits the address space, which works on Linux only"
)
def test_tiles_are_read_without_threads_if_none_can_be_started(tmp_path: Path) -> None:
    video = tmp_path / "tiles.obu"
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "lavfi", "-i", SOURCE]
    words = "-c:v libaom-av1 -cpu-used 8 -usage realtime -tiles 2x1 -crf 5 -frames:v 3"
    subprocess.run([*ffmpeg, *words.split(), str(video)], check=True)
    command = [sys.executable, "-c", _WITHOUT_THREADS, str(video)]
    limit = f'ulimit -S -s {1 << 20} && exec "$@"'
    run = subprocess.run(
        ["bash", "-c", limit, "bash", *command],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        cwd=Path(__file__).parent,
    )
    assert (run.returncode, run.stdout.strip()) == (0, "3"), run.stderr


@pytest.mark.parametrize("num_threads", [1, 4])
def test_script_may_exit_while_reading(clip: Path, num_threads: int) -> None:
    code = """
import sys
from colmap_av1 import ReadOptions, read_motion
left_open = read_motion(sys.argv[1], ReadOptions(num_threads=int(sys.argv[2])))
frame = next(left_open)
raise SystemExit(3)
"""
    words = [sys.executable, "-c", code, str(clip), str(num_threads)]
    for _ in range(5):  # one run in ten used to be killed by a signal
        done = subprocess.run(words, cwd=clip.parent, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (3, "")
