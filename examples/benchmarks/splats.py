"""Measure renderings of 3D Gaussians trained from the folders of `reconstruct` and of SIFT.

python examples/benchmarks/splats.py --cache benchmark_phone

For each clip, the folders of `reconstruct` and of SIFT by `phone_to_folder.py` are created in its
cache, and a model by `match`, `map` and `densify`. Gaussians are trained on half of the images of
each, from its poses and points, and rendered for the other half. For `reconstruct`, they are also
trained without densification, and from the Gaussians of `--gaussians`.

All pictures are undistorted by the code of `reconstruct`, because renderings score higher against
the slightly softer pictures of another program. The trainer is a small one for CPUs,
`../shared/tools/gs_cpu`: compare its figures only with each other, not with other trainers. Times
are those of training only.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import clips as ruler
import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import phone_to_folder
import pycolmap
import render
from phone_to_folder import Clip
from results import Value, add_results, clips_parser, read_rows, save
from rich.console import Console

import colmap_av1
from colmap_av1 import DensifyOptions, ImageOptions, MatchOptions, densify, map_database
from colmap_av1.geometry.colmap_model import model_points, posed_images, read_model, write_model
from colmap_av1.geometry.undistortion import on_pinholes, pinhole_camera, undistortion
from colmap_av1.splats.gaussians import write_model_gaussians
from colmap_av1.util.digests import file_digest
from colmap_av1.util.stages import run_stage_in

TRAINER = ruler.SEQUENCES.parent / "tools" / "gs_cpu"
FROM_GAUSSIANS = Path(__file__).with_name("train_from_gaussians.py")
SIFT, DROP_IN, _, NONE_ADDED, GAUSSIANS = render.SPLAT_WAYS
# Options of images, for clips where they differ from `phone_to_folder.py`.
IMAGES = {"kitchen": ImageOptions(every=4)}
WIDTH, ITERATIONS = 225, 3000
MILESTONES = (100, 200, 300, 400, 600, 800, 1000, 1250, 1500, 2000, 2500, ITERATIONS)
FIGURES = {"iter": "iterations", "cpu_s": "cpu_s", "gaussians": "gaussians"} | {
    name: name for name in ("psnr_y", "ssim_db", "vmaf")
}


def main() -> int:
    """Train on every clip in all ways, and save and print the table."""
    clips = ["log_building", "ditch", "holiday_display", "kitchen", "street"]
    parser = clips_parser(__doc__, clips, "sequences of ../shared")
    parser.add_argument("--ways", nargs="+", choices=list(render.SPLAT_WAYS), metavar="WAY")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N")
    add_results(parser, "splats")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    for name in arguments.clips:
        ours = name if name not in IMAGES else f"{name}_{IMAGES[name].every}"
        folder = arguments.cache.resolve() / ours
        clip = phone_to_folder.clip_of(name, folder)
        clip = replace(clip, images=IMAGES.get(name, clip.images))
        for way in arguments.ways or render.SPLAT_WAYS:
            console.print(f"{name}: {way}", markup=False)
            images, model = folder_of(clip, folder, way)
            for seed in arguments.seeds:
                rows = train(images, model, folder / "splats" / way.replace(" ", "_"), seed, way)
                about: dict[str, Value] = {"clip": name, "way": way, "seed": seed}
                key = ("clip", "way", "seed", "iterations")
                save(arguments.results, [about | row for row in rows], key)
    print(render.splats(read_rows(arguments.results)), end="")
    return 0


def folder_of(clip: Clip, folder: Path, way: str) -> tuple[Path, Path]:
    """The undistorted images and model of a clip by one way."""
    if way == DROP_IN:
        given: list[Any] = [file_digest(clip.video), clip.images, clip.camera]
        output = folder / "splats" / "match"
        return undistorted(output, given, lambda: match(clip, output))
    *_, output = phone_to_folder.folder_of(clip, folder / "reconstruct")
    if way != SIFT:
        return output / "images", output / "sparse" / "0"
    names = sorted(path.name for path in (output / "images").iterdir())

    def sift() -> tuple[Path, Path]:
        _steps, model, pictures = phone_to_folder.sift_of(clip, folder / "sift", names, mapped=True)
        if model is None:
            raise SystemExit(f"{clip.name}: SIFT made no model")
        return pictures, model

    given = [file_digest(clip.video), names, clip.camera, pycolmap.__version__]
    return undistorted(folder / "splats" / "sift", given, sift)


def match(clip: Clip, folder: Path) -> tuple[Path, Path]:
    """The images and model of a clip by `match`, `map` and `densify`."""
    database, images, mapped = folder / "a.db", folder / "distorted_images", folder / "mapped"
    options = MatchOptions(images=clip.images, camera=clip.camera)
    report = colmap_av1.match(database, clip.video, image_path=images, options=options)
    map_database(database, images, mapped, options=report.map_options)
    dense = folder / "dense"
    densify(mapped / "0", clip.video, dense, options=DensifyOptions(match=options))
    return images, dense


def undistorted(
    folder: Path, given: list[Any], make: Callable[[], tuple[Path, Path]]
) -> tuple[Path, Path]:
    """The undistorted images and model that `make` returns, made once for the same `given`."""
    images, model = folder / "images", folder / "model"

    def run() -> None:
        pictures, distorted = make()
        images.mkdir()
        undistort_images(distorted, pictures, images)
        undistort_model(distorted, model)

    run_stage_in(folder, given, None, run, products=[images, model])
    return images, model


def undistort_images(model: Path, images: Path, output: Path) -> None:
    """Write the undistorted images of a model with a single camera to a folder."""
    reconstruction = read_model(model)
    (camera,) = reconstruction.cameras.values()
    change = undistortion(camera, pinhole_camera(camera))
    for image in posed_images(reconstruction).values():
        picture = np.asarray(cv2.imread(str(images / image.name)), np.uint8)
        cv2.imwrite(str(output / image.name), picture if change is None else change(picture))


def undistort_model(model: Path, output: Path) -> None:
    """Write the undistorted version of a model with a single camera."""
    reconstruction = read_model(model)
    (camera,) = reconstruction.cameras.values()
    pinhole = pinhole_camera(camera)
    posed = list(posed_images(reconstruction).values())
    points = model_points(reconstruction, posed)
    rays = np.asarray(camera.cam_from_img(points.xy))[:, :2]
    on_image = on_pinholes(rays, np.zeros(len(rays), np.int64), [pinhole])
    output.mkdir()
    write_model(output, {camera.camera_id: pinhole}, posed, replace(points, xy=on_image))


def train(
    images: Path, model: Path, folder: Path, seed: int, way: str
) -> Iterator[dict[str, Value]]:
    """Train from a model's points, or from Gaussians made from them; yields a row per milestone."""
    cloud, output = folder / "cloud.npz", folder / f"seed_{seed}"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    run = [sys.executable, str(TRAINER / "colmap_to_npz.py"), str(model), str(cloud)]
    subprocess.run([*run, "--images", str(images)], check=True, capture_output=True)
    if way == GAUSSIANS:
        write_model_gaussians(folder / "init.ply", model)
        run = [sys.executable, str(FROM_GAUSSIANS), str(folder / "init.ply"), str(TRAINER)]
    else:
        run = [sys.executable, str(TRAINER / "gs_train.py")]
    run += [str(cloud), str(images), str(output)]
    run += ["--width", str(WIDTH), "--iters", str(ITERATIONS), "--reset-every", "0"]
    run += ["--threads", "1", "--seed", str(seed), "--milestones", ",".join(map(str, MILESTONES))]
    run += ["--no-densify"] if way == NONE_ADDED else []
    with (output / "log.txt").open("w") as log:
        subprocess.run(run, check=True, stdout=log, stderr=log)
    for line in (output / "log.jsonl").read_text().splitlines():
        entry = json.loads(line)
        if entry["kind"] == "eval":
            yield {ours: entry[name] for name, ours in FIGURES.items()}


if __name__ == "__main__":
    sys.exit(main())
