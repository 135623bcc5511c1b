"""Measure the points of a dense model: how many, and how far their depths are from the truth.

python examples/benchmarks/dense_points.py
python examples/benchmarks/dense_points.py --model sift_model --video OUT.mp4

Without arguments the rendered clip is densified on its true poses, and its surfaces are the truth.
Else it is the points of the model that lie near others in an image: not many, but from another
front-end. The rows add, one after the other, what makes points more and surer.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray
from tracks import load_render_scene

from colmap_av1 import DensifyOptions, MatchOptions, TrackOptions, densify
from colmap_av1.evaluate import run_measured
from colmap_av1.evaluate.metrics.clouds import depth_differences, point_cloud
from colmap_av1.model.colmap_model import ModelImage, no_points, read_model, write_model
from colmap_av1.options import TriangulateOptions

EXAMPLES = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Way:
    """What makes the points."""

    name: str
    tracks: TrackOptions
    max_depth_error: float | None = None


WAYS = (
    Way("tracks of 4 frames, 1 to a unit", TrackOptions(min_length=4, cell=4)),
    Way("tracks of 3 frames, too", TrackOptions(cell=4)),
    Way("tracks that meet go on", TrackOptions()),
    Way(
        "distances that are sure: the defaults", TrackOptions(), TriangulateOptions.max_depth_error
    ),
    Way("--seeding 2", TrackOptions(seeding=2), TriangulateOptions.max_depth_error),
)


def main() -> int:
    """Densify in every way and print a table."""
    parser = argparse.ArgumentParser(description="Measure the points of dense models.")
    parser.add_argument("--model", type=Path, help="COLMAP model of the video's frames")
    parser.add_argument("--video", type=Path, help="AV1 video")
    arguments = parser.parse_args()
    if (arguments.model is None) != (arguments.video is None):
        parser.error("give --model and --video, or neither")
    print(
        "| points from | points | observations each | error px | depth off by, median "
        "| > 5 % | > 10 % | checked | CPU s |\n|---|" + "---:|" * 8
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        script = scene = None
        model, video = arguments.model, arguments.video
        if model is None:
            script = load_render_scene()
            scene = script.build_scene()
            model, video = true_model(scene, folder / "truth"), EXAMPLES / "scene.mp4"
        for number, way in enumerate(WAYS):
            output = folder / str(number)
            options = DensifyOptions(
                match=MatchOptions(tracks=way.tracks),
                triangulate=TriangulateOptions(max_depth_error=way.max_depth_error),
            )
            measured = run_measured(make, model, video, output, options, log=folder / "log.txt")
            dense, reference = read_model(output), read_model(model)
            if script is None:
                off, times = depth_differences(dense, reference), reference.num_points3D()
            else:
                off, times = surface_errors(dense, script, scene), None
            print_row(way, dense, off, times, measured.cpu_seconds)
    return 0


def make(model: Path, video: Path, output: Path, options: DensifyOptions) -> None:
    """Densify, in a process of its own."""
    densify(model, video, output, options=options)


def print_row(
    way: Way, dense: Any, off: NDArray[np.float64], given: int | None, cpu_seconds: float
) -> None:
    """One row of the table; `given` is the number of the given model's points."""
    checked = off[np.isfinite(off)]
    num_points = dense.num_points3D()
    more = f", {num_points / given:.1f}x" if given else ""
    cells = [
        way.name,
        f"{num_points:,}{more}",
        f"{dense.compute_mean_track_length():.1f}",
        f"{np.mean([p.error for p in dense.points3D.values()]):.3f}",
        f"{np.median(checked):.2%}",
        f"{np.mean(checked > 0.05):.1%}",
        f"{np.mean(checked > 0.1):.1%}",
        f"{len(checked):,}",
        f"{cpu_seconds:.1f}",
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


def surface_errors(dense: Any, script: Any, scene: Any) -> NDArray[np.float64]:
    """Distances of points to the nearest surface, as shares of those from the first camera."""
    xyz = point_cloud(dense)
    first = [
        min(e.image_id for e in dense.points3D[i].track.elements) for i in sorted(dense.points3D)
    ]
    centre = np.array([dense.images[i].projection_center() for i in first])
    off = script.surface_distance(scene, xyz)
    return np.asarray(off / np.linalg.norm(xyz - centre, axis=1))


def true_model(scene: Any, folder: Path) -> Path:
    """A model without points that has the rendered clip's poses."""
    folder.mkdir()
    size = {"width": scene.width, "height": scene.height}
    params = [scene.fx, scene.fy, scene.cx, scene.cy]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", params=params, **size)
    images = [
        ModelImage(frame + 1, f"{frame:04d}.png", 1, pose)
        for frame, pose in enumerate(scene.cam_from_world)
    ]
    write_model(folder, {1: camera}, images, no_points())
    return folder


if __name__ == "__main__":
    raise SystemExit(main())
