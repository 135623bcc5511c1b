"""Writes the seeds of `readers`: small files of each kind in the formats of other programs.

    python tests/fuzzing/make_seeds.py

It wrote the committed seeds in tests/data/seeds.
"""

from __future__ import annotations

import sqlite3
import struct
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import h5py
import imageio_ffmpeg
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import subprocess  # noqa: E402

from readers import joined  # noqa: E402

SEEDS = HERE.parent / "data" / "seeds"
_ENCODE = "-c:v libaom-av1 -usage realtime -cpu-used 8 -crf 50 -b:v 0 -g 2 -pix_fmt yuv420p"


def containers(folder: Path) -> dict[str, bytes]:
    """A tiny clip in all containers that support AV1."""
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y"]
    source = ["-f", "lavfi", "-i", "testsrc2=size=64x48:rate=5", "-frames:v", "4"]
    source += ["-fflags", "+bitexact"]
    found = {}
    for name in ("clip.mp4", "clip.ivf", "clip.obu", "clip.mkv", "clip.avif"):
        path = folder / name
        subprocess.run([*ffmpeg, *source, *_ENCODE.split(), path], check=True)
        found[name] = path.read_bytes()
    found["annexb.obu"] = annex_b(found["clip.ivf"])
    return found


def annex_b(ivf: bytes) -> bytes:
    """The stream of an IVF file in the length-delimited format (AV1 specification, Annex B)."""
    units, position = b"", 32
    while position < len(ivf):
        (size,) = struct.unpack_from("<I", ivf, position)
        unit, position = ivf[position + 12 : position + 12 + size], position + 12 + size
        obus, start = b"", 0
        while start < len(unit):
            length, header = 0, start + 1
            while True:
                length |= (unit[header] & 127) << 7 * (header - start - 1)
                header += 1
                if unit[header - 1] < 128:
                    break
            obus += leb128(header - start + length) + unit[start : header + length]
            start = header + length
        frame = leb128(len(obus)) + obus
        units += leb128(len(frame)) + frame
    return units


def leb128(value: int) -> bytes:
    """A number in the leb128 format (4.10.5)."""
    data = b""
    while value > 127:
        data, value = data + bytes([value & 127 | 128]), value >> 7
    return data + bytes([value])


def hdf5(folder: Path) -> bytes:
    """Features and matches of two images."""
    paths = [folder / "features.h5", folder / "matches.h5"]
    with (
        h5py.File(paths[0], "w", libver="latest") as features,
        h5py.File(paths[1], "w", libver="latest") as matches,
    ):
        for name in ("a.png", "b.png"):
            features[f"{name}/keypoints"] = np.arange(10, dtype=np.float16).reshape(5, 2)
            features[f"{name}/image_size"] = np.array([64, 48])
        matches["a.png/b.png/matches0"] = np.array([0, 1, -1, 2, -1], dtype=np.int16)
        matches["a.png/b.png/matching_scores0"] = np.ones(5, dtype=np.float16)
    return joined([path.read_bytes() for path in paths])


def model() -> bytes:
    """A model of two images that observe a point."""
    image = [
        struct.pack("<I7dI", i, 1, 0, 0, 0, i, 0, 0, 1)
        + f"{i}.png".encode()
        + b"\0"
        + struct.pack("<Q2dq", 1, 32, 24, 1)
        for i in (1, 2)
    ]
    frames = [
        struct.pack("<II7d", i, 1, 1, 0, 0, 0, i, 0, 0) + struct.pack("<IiIQ", 1, 0, 1, i)
        for i in (1, 2)
    ]
    return joined(
        [
            struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24),
            struct.pack("<Q", 2) + b"".join(image),
            struct.pack("<QQ3d3BdQ4I", 1, 1, 0, 0, 5, 1, 2, 3, 0.5, 2, 1, 0, 2, 0),
            struct.pack("<QIIiI", 1, 1, 1, 0, 1),
            struct.pack("<Q", 2) + b"".join(frames),
        ]
    )


def databases(folder: Path) -> dict[str, bytes]:
    """Databases of two images in the oldest and the newest layout, in small pages."""
    found = {}
    for layout in ("3.8", "4.2"):
        path = folder / f"{layout}.db"
        script = (HERE.parent / "data" / "schemas" / f"colmap-{layout}.sql").read_text()
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("PRAGMA page_size = 512")
            connection.executescript(script)
            params = np.array([60.0, 32.0, 24.0]).tobytes()
            connection.execute(
                "INSERT INTO cameras (camera_id, model, width, height, params, "
                "prior_focal_length) VALUES (1, 0, 64, 48, ?, 1)",
                (params,),
            )
            matches = np.repeat(np.arange(20, dtype=np.uint32), 2).tobytes()
            for i in (1, 2):
                xy = np.random.default_rng(i).uniform(0, 48, (20, 2)).astype(np.float32)
                connection.execute(
                    "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, 1)",
                    (i, f"{i}.png"),
                )
                connection.execute("INSERT INTO keypoints VALUES (?, 20, 2, ?)", (i, xy.tobytes()))
            pair = 2147483647 + 2
            connection.execute("INSERT INTO matches VALUES (?, 20, 2, ?)", (pair, matches))
            connection.execute(
                "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config, E) "
                "VALUES (?, 20, 2, ?, 2, ?)",
                (pair, matches, np.eye(3).tobytes()),
            )
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")
        found[f"{layout}.db"] = path.read_bytes()
    return found


def main() -> None:
    """Write all seeds."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        seeds = {
            "container": containers(folder),
            "hdf5": {"two_images": hdf5(folder)},
            "model": {"two_images": model()},
            "database": databases(folder),
        }
    for target, files in seeds.items():
        (SEEDS / target).mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            (SEEDS / target / name).write_bytes(data)


if __name__ == "__main__":
    main()
