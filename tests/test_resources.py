"""Small input that declares or requests more memory than exists is refused at once."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import Encode, make_frames

from colmap_av1.errors import ColmapAv1Error, HlocError, ImageError, ModelError, OptionError
from colmap_av1.geometry.binary_files import are_whole
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.images.choosing import check_frame_list
from colmap_av1.images.files import read_image
from colmap_av1.images.names import frames_of_images, natural_order
from colmap_av1.interop.hloc import read_hloc
from colmap_av1.options import ImageOptions

resource = pytest.importorskip("resource")
_ALLOWED = 1 << 30  # bytes more than are in use


@contextmanager
def little_memory() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _ALLOWED, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def refused(run: Callable[[], object], kind: type[ColmapAv1Error], text: str) -> None:
    with little_memory(), pytest.raises(kind, match=text) as caught:
        run()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "pattern",
    ["%99999999999d.png", "%021d.png", f"{'x' * 200}%d.png", "a\0%d.png", f"%{'0' * 5000}9d.png"],
)
def test_invalid_image_name_pattern_is_refused(pattern: str) -> None:
    refused(lambda: ImageOptions(image_name=pattern), OptionError, "image_name")


def test_endless_list_is_refused(tmp_path: Path) -> None:
    refused(
        lambda: check_frame_list(ImageOptions(frame_list="/dev/zero")),
        ImageError,
        "regular",
    )
    large = tmp_path / "large.txt"
    with large.open("wb") as file:
        file.truncate(1 << 40)
    refused(lambda: check_frame_list(ImageOptions(frame_list=large)), ImageError, "large")


def test_numbers_with_thousands_of_digits_are_accepted(tmp_path: Path) -> None:
    listing = tmp_path / "frames.txt"
    listing.write_text("1" * 5000 + "\n")
    check_frame_list(ImageOptions(frame_list=listing, image_name="%d.png"))
    names = ["²", "9" * 5000 + ".png", "10.png", "9.png"]
    assert natural_order(names) == [3, 2, 1, 0]
    with pytest.raises(ImageError):
        frames_of_images(names[1:], 7)


def test_long_list_is_checked_in_linear_time(tmp_path: Path) -> None:
    listing = tmp_path / "frames.txt"
    listing.write_text("".join(f"{i}\n" for i in range(100_000)))
    check_frame_list(ImageOptions(frame_list=listing))


def hloc_files(folder: Path, damage: Callable[[h5py.File, h5py.File], None]) -> list[Path]:
    paths = [folder / "features.h5", folder / "matches.h5"]
    with h5py.File(paths[0], "w") as features, h5py.File(paths[1], "w") as matches:
        for name in "ab":
            features[f"{name}/keypoints"] = np.ones((9, 2), np.float32)
            features[f"{name}/image_size"] = np.array([64, 48])
        matches["a/b/matches0"] = np.arange(9, dtype=np.int16)
        matches["a/b/matching_scores0"] = np.ones(9, np.float16)
        damage(features, matches)
    return paths


def declared(file: h5py.File, name: str, shape: tuple[int, ...], kind: str) -> None:
    del file[name]
    file.create_dataset(name, shape, kind, chunks=tuple(min(n, 64) for n in shape))


def linked(features: h5py.File, name: str, target: object) -> None:
    del features[name]
    features[name] = target


HDF5 = {
    "keypoints": (
        lambda f, m: declared(f, "a/keypoints", (3_000_000_000, 2), "f4"),
        "24000000000 bytes",
    ),
    "size": (
        lambda f, m: declared(f, "a/image_size", (3_000_000_000,), "i8"),
        "24000000000 bytes",
    ),
    "matches": (
        lambda f, m: declared(m, "a/b/matches0", (3_000_000_000,), "i4"),
        "12000000000 bytes",
    ),
    "scores": (
        lambda f, m: declared(m, "a/b/matching_scores0", (3_000_000_000,), "f4"),
        "12000000000 bytes",
    ),
    "scores of others": (
        lambda f, m: linked(m, "a/b/matching_scores0", np.ones(5, np.float32)),
        "scores",
    ),
    "size of three": (
        lambda f, m: linked(f, "a/image_size", np.array([1, 2, 3])),
        "width",
    ),
    "size in words": (lambda f, m: linked(f, "a/image_size", "64x48"), "numeric"),
    "size not a number": (
        lambda f, m: linked(f, "a/image_size", np.array([np.nan, 3])),
        "width",
    ),
    "size that is a group": (
        lambda f, m: linked(f, "a/image_size", h5py.SoftLink("/b")),
        "numeric",
    ),
    "size that is nowhere": (
        lambda f, m: linked(f, "a/image_size", h5py.ExternalLink("none.h5", "/x")),
        "damaged",
    ),
    "no numbers": (
        lambda f, m: linked(f, "a/keypoints", np.full((9, 2), np.nan, np.float32)),
        "keypoints",
    ),
}


@pytest.mark.parametrize(("damage", "text"), HDF5.values(), ids=HDF5.keys())
def test_damaged_hdf5_file_is_refused(
    tmp_path: Path, damage: Callable[[h5py.File, h5py.File], None], text: str
) -> None:
    paths = hloc_files(tmp_path, damage)
    assert max(path.stat().st_size for path in paths) < 40_000
    refused(lambda: read_hloc(*paths), HlocError, text)


def test_compressed_hdf5_file_is_read(tmp_path: Path) -> None:
    """Zeros compress by a factor of 1000, so a small file may contain large arrays."""

    def compress(features: h5py.File, _: h5py.File) -> None:
        del features["a/keypoints"]
        zeros = np.zeros((9, 200_000), np.float32)
        features.create_dataset("a/keypoints", data=zeros, compression="gzip", compression_opts=9)

    assert len(read_hloc(*hloc_files(tmp_path, compress)).keypoints[0]) == 9


def model_files(counts: dict[str, int]) -> dict[str, bytes]:
    """A model of one image and one point, with the given counts in place of the true ones."""

    def count(name: str, kind: str = "<Q", honest: int = 1) -> bytes:
        return struct.pack(kind, counts.get(name, honest))

    image = struct.pack("<I7dI", 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0"
    return {
        "cameras.bin": count("cameras")
        + struct.pack("<IiQQ4d", 1, 1, 640, 480, 500, 500, 320, 240),
        "images.bin": count("images")
        + image
        + count("keypoints", honest=2)
        + struct.pack("<2dq", 1, 2, 1) * 2,
        "points3D.bin": count("points")
        + struct.pack("<Q3d3Bd", 1, 0, 0, 5, 1, 2, 3, 0.5)
        + count("track", honest=2)
        + struct.pack("<IIII", 1, 0, 1, 1),
        "rigs.bin": count("rigs")
        + struct.pack("<I", 1)
        + count("sensors", "<I")
        + struct.pack("<iI", 0, 1),
        "frames.bin": count("frames")
        + struct.pack("<II7d", 1, 1, 1, 0, 0, 0, 0, 0, 0)
        + count("data_ids", "<I")
        + struct.pack("<iIQ", 0, 1, 1),
    }


@pytest.mark.parametrize("number", [1 << 31, 1 << 33, 1 << 60, (1 << 64) - 1])
@pytest.mark.parametrize(
    "field",
    ["cameras", "images", "keypoints", "points", "track", "rigs", "sensors", "frames", "data_ids"],
)
def test_model_with_too_large_counts_is_refused(tmp_path: Path, field: str, number: int) -> None:
    honest = model_files({})
    for name, data in honest.items():
        (tmp_path / name).write_bytes(data)
    assert are_whole(tmp_path)
    assert read_model(tmp_path).num_reg_images() == 1
    short = field in ("sensors", "data_ids")
    counts = {field: number & 0xFFFFFFFF or 1 << 31} if short else {field: number}
    for name, data in model_files(counts).items():
        (tmp_path / name).write_bytes(data)
    refused(lambda: read_model(tmp_path), ModelError, "cannot be read")


def test_truncated_model_is_refused(tmp_path: Path) -> None:
    for name, data in model_files({}).items():
        (tmp_path / name).write_bytes(data)
    for name, data in model_files({}).items():
        for length in range(len(data)):
            (tmp_path / name).write_bytes(data[:length])
            with pytest.raises(ModelError):
                read_model(tmp_path)
        (tmp_path / name).write_bytes(data)


@pytest.mark.parametrize(
    ("name", "text"),
    [(b"\xff.png", "UTF-8"), (b"../a.png", "outside"), (b"", "name")],
)
def test_model_with_an_invalid_image_name_is_refused(
    tmp_path: Path, name: bytes, text: str
) -> None:
    for file, data in model_files({}).items():
        (tmp_path / file).write_bytes(data.replace(b"a.png", name))
    refused(lambda: read_model(tmp_path), ModelError, text)


def test_model_with_nan_is_refused(tmp_path: Path) -> None:
    # Offsets of the first camera parameter, and of the pose in both files that contain it.
    for places, text in (
        ({"cameras.bin": 32}, "parameters"),
        ({"images.bin": 44, "frames.bin": 48}, "pose"),
    ):
        for name, data in model_files({}).items():
            changed = bytearray(data)
            if name in places:
                struct.pack_into("<d", changed, places[name], np.nan)
            (tmp_path / name).write_bytes(changed)
        refused(lambda: read_model(tmp_path), ModelError, text)


@pytest.mark.parametrize("side", [60_000, 20_000])
def test_picture_with_too_many_pixels_is_refused(tmp_path: Path, side: int) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    path = tmp_path / "a.png"
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )
    with pytest.raises(ImageError, match=re.escape(str(path))) as caught:
        read_image(path)
    assert "\n" not in str(caught.value)


_WITH_LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
from colmap_av1.cli import main
assert main(["info", "--video", sys.argv[1]]) == 0
used = resource.getpagesize() * int(Path("/proc/self/statm").read_text().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (used + (4 << 20), resource.RLIM_INFINITY))
sys.exit(main(["info", "--video", sys.argv[2]]))
"""


@pytest.mark.skipif(
    sys.platform != "linux", reason="limits the address space, which works on Linux only"
)
def test_out_of_memory_gives_one_line(encode: Encode, clip: Path, tmp_path: Path) -> None:
    large = encode(make_frames(2, 3840, 2160), tmp_path / "large.mp4")
    words = [sys.executable, "-c", _WITH_LITTLE_MEMORY, str(clip), str(large)]
    run = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    (line,) = run.stderr.splitlines()
    assert "out of memory" in line
    assert run.returncode == 2
