"""Paths, clips and fixtures that several tests use."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
import pytest
from dense_scene import made, truth  # noqa: F401 - fixtures
from hypothesis import settings
from numpy.typing import NDArray

from colmap_av1 import CameraOptions

PROJECT = Path(__file__).resolve().parents[1]
SHARED = PROJECT.parent / "shared"
# `sys.path` entries of processes that import modules of the tests.
TEST_PATHS = os.pathsep.join(str(p) for p in (PROJECT / "tests", *(PROJECT / "tests").glob("*/")))

AV1 = [
    *("-c:v", "libaom-av1", "-usage", "realtime", "-cpu-used", "6", "-lag-in-frames", "0"),
    *("-row-mt", "1", "-crf", "20", "-b:v", "0", "-g", "9999"),
]
# Takes a third of the time, for large pictures.
QUICK_AV1 = [word if word != "6" else "8" for word in AV1]

# Shells make background processes ignore interrupts, and Python inherits this. This program handles
# interrupts anyway.
HANDLE_INTERRUPTS = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from colmap_av1.cli import main
sys.exit(main())
"""

# On a busy machine, an example can exceed the default deadline.
settings.register_profile("tests", deadline=None)
settings.load_profile("tests")

Ffmpeg = Callable[..., Path]
Encode = Callable[..., Path]
Street = Callable[[int], Path]

# The camera of `street`.
STREET = CameraOptions("PINHOLE", "707.0912,707.0912,602.3873,183.6104")


def pytest_configure() -> None:
    # The test workers already use all cores, and further BLAS threads would wait in busy loops.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("shared") and not SHARED.is_dir():
        pytest.skip("needs the test data in ../shared")


@pytest.fixture
def tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for a test, whose path does not contain the test's name.

    Otherwise a message that contains a path in it would match words of the name.
    """
    return tmp_path_factory.mktemp("test")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of test data next to the checkout."""
    if not SHARED.is_dir():
        pytest.skip("needs the test data in ../shared")
    return SHARED


@pytest.fixture(scope="session")
def ffmpeg() -> Ffmpeg:
    """Run ffmpeg with arguments, the last of which is the output, and return the output."""

    def run(*words: str | Path, stdin: bytes | None = None) -> Path:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, words)]
        subprocess.run(command, input=stdin, check=True, capture_output=True)
        return Path(words[-1])

    return run


@pytest.fixture(scope="session")
def encode(ffmpeg: Ffmpeg) -> Encode:
    """Encode uint8 [n, height, width, 3] BGR frames, as AV1 by default."""

    def run(frames: NDArray[np.uint8], output: Path, *how: str) -> Path:
        height, width = frames.shape[1:3]
        source = f"-f rawvideo -pix_fmt bgr24 -s {width}x{height} -r 25 -i -".split()
        how = how or tuple(AV1)
        return ffmpeg(*source, *how, "-pix_fmt", "yuv420p", output, stdin=frames.tobytes())

    return run


@pytest.fixture(scope="session")
def street(shared: Path, encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Street:
    """Encode the first frames of a drive, by their number; `STREET` is its camera."""

    @cache
    def run(num_frames: int) -> Path:
        frames = sorted((shared / "sequences" / "street" / "frames").iterdir())[:num_frames]
        output = tmp_path_factory.mktemp("street") / "drive.mp4"
        return encode(np.stack([cv2.imread(str(frame)) for frame in frames]), output)

    return run


def make_frames(count: int, width: int = 192, height: int = 128) -> NDArray[np.uint8]:
    """Frames of a textured background with textured posts in front of it and a moving camera."""
    rng = np.random.default_rng(7)
    texture = rng.integers(0, 256, (height // 4 + 1, width // 2, 3), dtype=np.uint8)
    far = texture.repeat(4, axis=0).repeat(4, axis=1)[:height]
    near = np.roll(far[::-1], 50, axis=1)
    post = (np.arange(far.shape[1]) // 24) % 3 == 0
    frames = np.empty((count, height, width, 3), dtype=np.uint8)
    for i in range(count):
        back = np.roll(far, -2 * i, axis=1)[:, :width]
        front = np.roll(near, -4 * i, axis=1)[:, :width]
        frames[i] = np.where(np.roll(post, -4 * i)[None, :width, None], front, back)
    return frames


def encode_two_sizes(encode: Encode, output: Path, count: int) -> Path:
    """A stream of `count` frames of 192x128 and then `count` frames of 128x128."""
    parts = [output.with_name(f"{width}.obu") for width in (192, 128)]
    for width, part in zip((192, 128), parts, strict=True):
        encode(make_frames(count, width, 128), part)
    output.write_bytes(b"".join(part.read_bytes() for part in parts))
    return output


@pytest.fixture(scope="session")
def clip(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An AV1 clip of 16 frames, 192x128, in MP4."""
    return encode(make_frames(16), tmp_path_factory.mktemp("clip") / "clip.mp4")


@pytest.fixture(scope="session")
def clips(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 8 clips: 6 AV1 clips of 3 lengths, 1 damaged in its first frame, 1 text file."""
    folder = tmp_path_factory.mktemp("batch") / "clips"
    for part in ("a", "b"):
        (folder / part).mkdir(parents=True)
    lengths = [encode(make_frames(n), folder.parent / f"{n}.mp4") for n in (6, 7, 8)]
    for i in range(6):
        shutil.copyfile(lengths[i % 3], folder / "ab"[i % 2] / f"clip{i}.mp4")
    content = bytearray(lengths[0].read_bytes())
    start = content.index(b"mdat") + 4
    content[start : start + 100] = bytes(100)
    (folder / "a" / "damaged.mp4").write_bytes(content)
    (folder / "b" / "text.mp4").write_text("no video")
    return folder
