"""Measure the verification of image pairs, compared with COLMAP on the same pairs and matches.

python examples/benchmarks/verification.py --cache benchmark_verification

`match` fills a database for each video. Then `verify_pairs` and pycolmap's `verify_matches` verify
it alternately, each in a separate process with all CPUs. COLMAP runs with two seeds, because its
agreement with itself is the best that another implementation can reach. CPU times exclude imports
and reading the database; COLMAP's include writing the rows. The rendered clip is always measured;
the other sequences are in ../shared.
"""

from __future__ import annotations

import argparse
import shutil
import sqlite3
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import render
from clips import ENCODING, EXAMPLES, SEQUENCES, camera_options, ffmpeg, ffmpeg_input, is_there
from numpy.typing import NDArray
from results import Value, add_results, read_rows, save
from sequences import read_sequence

from colmap_av1 import CameraOptions, ColmapAv1Error, MatchOptions, match
from colmap_av1.database.reading import image_ids_from_pair_id
from colmap_av1.evaluate import run_measured
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import DensityOptions, VerifyOptions

NAMES = ("scene", "street", "log_building", "ditch", "shelfbox")


@dataclass(frozen=True)
class Verified:
    """CPU seconds of a verification, and the config and inlier matches by pair id."""

    cpu_seconds: float
    geometries: dict[int, tuple[int, NDArray[np.uint32]]]


def main() -> int:
    """Fill missing databases, verify each alternately, and print a table."""
    parser = argparse.ArgumentParser(
        description="Measure verification, compared with COLMAP.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument(
        "--cache", type=Path, help="folder that keeps videos and databases [a temporary one]"
    )
    parser.add_argument("--repeats", type=int, default=2, help="number of runs of each")
    parser.add_argument(
        "--preset", choices=["sparse", "default", "dense"], default="dense", help="tracks to match"
    )
    parser.add_argument(
        "--sequences", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help=" ".join(NAMES)
    )
    add_results(parser, "verification")
    arguments = parser.parse_args()
    if arguments.repeats < 2:
        parser.error("--repeats starts at 2: COLMAP is compared with itself")
    failed = False
    with ExitStack() as stack:
        cache = arguments.cache or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cache.mkdir(parents=True, exist_ok=True)
        for name in arguments.sequences:
            if not is_there(name):
                print(f"{name}: not measured, {SEQUENCES / name} is absent", file=sys.stderr)
                continue
            try:
                database = fill_database(name, arguments.preset, cache)
                about: dict[str, Value] = {"clip": name, "preset": arguments.preset}
                row = {**about, **measure(database, arguments.repeats, cache)}
                save(arguments.results, [row], ("clip", "preset"))
            except ColmapAv1Error as error:
                print(f"error: {name}: {error}", file=sys.stderr)
                failed = True
    rows = read_rows(arguments.results)
    print(render.verification([row for row in rows if row["clip"] in arguments.sequences]), end="")
    return 1 if failed else 0


def fill_database(name: str, preset: Literal["sparse", "default", "dense"], cache: Path) -> Path:
    """The database of a clip, filled in the cache if it is missing."""
    database = cache / f"{name}_{preset}.db"
    if database.exists():
        return database
    video, camera = EXAMPLES / "scene.mp4", CameraOptions()
    if name != "scene":
        sequence = read_sequence(SEQUENCES / name)
        if sequence.camera is not None:
            camera = camera_options(sequence.camera)
        video = cache / f"{name}.mp4"
        if not video.exists():
            unfinished = video.with_suffix(".part.mp4")
            source = ffmpeg_input(sequence.source, sequence.fps)
            ffmpeg(*source, *ENCODING.split(), str(unfinished))
            unfinished.replace(video)
    options = MatchOptions(camera=camera, density=DensityOptions(preset=preset))
    match(database, video, options=options)
    return database


def measure(database: Path, repeats: int, cache: Path) -> dict[str, Value]:
    """Verify a database repeatedly; returns the figures."""
    log = cache / "log.txt"
    ours, theirs = [], []
    for turn in range(repeats):
        ours.append(run_measured(verify_here, database, log=log).result)
        theirs.append(run_measured(verify_with_colmap, database, turn % 2, log=log).result)
    with sqlite3.connect(database) as connection:
        pairs, matches = connection.execute("SELECT COUNT(*), SUM(rows) FROM matches").fetchone()
    same, inliers, inliers_of_98 = agreement(ours[0], theirs[0])
    colmap_same, colmap_inliers, colmap_inliers_of_98 = agreement(theirs[1], theirs[0])
    return {
        "pairs": pairs,
        "matches": matches,
        "cpu_s": statistics.median(run.cpu_seconds for run in ours),
        "colmap_cpu_s": statistics.median(run.cpu_seconds for run in theirs),
        "same_config": same,
        "inliers": inliers,
        "inliers_of_98": inliers_of_98,
        "colmap_same_config": colmap_same,
        "colmap_inliers": colmap_inliers,
        "colmap_inliers_of_98": colmap_inliers_of_98,
    }


def verify_here(database: Path) -> Verified:
    """Verify the matches of a database with `verify_pairs`; writes nothing."""
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.image_id)
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        keypoints = []
        for image in images:
            xy = np.asarray(db.read_keypoints(image.image_id), dtype=np.float32)[:, :2]
            keypoints.append(ImageKeypoints(np.ascontiguousarray(xy), np.arange(len(xy))))
        pair_ids, matches = db.read_all_matches()
    index = {image.image_id: k for k, image in enumerate(images)}
    pairs = np.array(
        [[index[i] for i in image_ids_from_pair_id(int(pair_id))] for pair_id in pair_ids], np.int32
    )
    each = [cameras[image.camera_id] for image in images]
    start = time.process_time()
    geometries = verify_pairs(keypoints, pairs, matches, each, VerifyOptions())
    used = time.process_time() - start
    found = {
        int(pair_id): (int(g.config), g.inlier_matches)
        for pair_id, g in zip(pair_ids, geometries, strict=True)
    }
    return Verified(used, found)


def verify_with_colmap(database: Path, seed: int) -> Verified:
    """Verify the matches of a copy of a database with pycolmap's `verify_matches`."""
    with tempfile.TemporaryDirectory() as folder:
        copy, list_of_pairs = Path(folder, "copy.db"), Path(folder, "pairs.txt")
        shutil.copy(database, copy)
        with sqlite3.connect(copy) as connection:
            connection.execute("DELETE FROM two_view_geometries")
            names = dict(connection.execute("SELECT image_id, name FROM images"))
            pair_ids = [row[0] for row in connection.execute("SELECT pair_id FROM matches")]
        named = [[names[i] for i in image_ids_from_pair_id(pair_id)] for pair_id in pair_ids]
        list_of_pairs.write_text("".join(f"{a} {b}\n" for a, b in named))
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        start = time.process_time()
        pycolmap.verify_matches(copy, list_of_pairs, options)
        used = time.process_time() - start
        with sqlite3.connect(copy) as connection:
            rows = connection.execute("SELECT pair_id, config, data FROM two_view_geometries")
            found = {
                pair_id: (config, np.frombuffer(data or b"", "<u4").reshape(-1, 2))
                for pair_id, config, data in rows
            }
    return Verified(used, found)


def agreement(a: Verified, b: Verified) -> tuple[float, float, float]:
    """Share of pairs with equal config, mean Jaccard index of inliers, and its share >= 0.98."""
    same, overlap = [], []
    for pair_id, (config, inliers) in b.geometries.items():
        other_config, other = a.geometries[pair_id]
        same.append(config == other_config)
        keys, other_keys = (x[:, 0].astype(np.uint64) << 32 | x[:, 1] for x in (inliers, other))
        common = len(np.intersect1d(keys, other_keys))
        union = len(keys) + len(other_keys) - common
        overlap.append(common / union if union else 1.0)
    return float(np.mean(same)), float(np.mean(overlap)), float(np.mean(np.array(overlap) >= 0.98))


if __name__ == "__main__":
    sys.exit(main())
