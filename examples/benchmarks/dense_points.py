"""Measure the number of points of dense models and the errors of their depths.

python examples/benchmarks/dense_points.py
python examples/benchmarks/dense_points.py --model sift_model --video OUT.mp4

Without arguments, the rendered clip is densified on its true poses, and its surfaces are the ground
truth. With arguments, depths are compared with nearby points of the given model: few points, but
from another front-end. Each row adds an option that gives more or more accurate points.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
import render
from clips import EXAMPLES, load_render_scene
from numpy.typing import NDArray
from results import Value, add_results, read_rows, save
from scipy.spatial import KDTree

from colmap_av1 import DensifyOptions, MatchOptions, TrackOptions, densify
from colmap_av1.evaluate import run_measured
from colmap_av1.geometry.colmap_model import ModelImage, point_positions, read_model, write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.options import TriangulateOptions

# Smallest track length of a reference point, and number of nearby reference points to consider.
REFERENCE_LENGTH = 4
NEAREST = 3


@dataclass(frozen=True)
class Tracking:
    """A row of the table: options of tracks and points."""

    name: str
    tracks: TrackOptions
    max_depth_error: float | None = None


TRACKINGS = (
    Tracking("4 frames and more, one in a 4x4 unit", TrackOptions(min_length=4, cell=4)),
    Tracking("3 frames and more", TrackOptions(cell=4)),
    Tracking("continued where two meet", TrackOptions()),
    Tracking("accurate depth: the defaults", TrackOptions(), TriangulateOptions.max_depth_error),
    Tracking("`--seeding 2`", TrackOptions(seeding=2), TriangulateOptions.max_depth_error),
)


def main() -> int:
    """Densify with each set of options, and print a table."""
    parser = argparse.ArgumentParser(description="Measure the points of dense models.")
    parser.add_argument("--model", type=Path, help="COLMAP model of the video's frames")
    parser.add_argument("--video", type=Path, help="AV1 video")
    parser.add_argument("--name", help="name of the clip [name of the video]")
    add_results(parser, "dense_points")
    arguments = parser.parse_args()
    if (arguments.model is None) != (arguments.video is None):
        parser.error("give --model and --video, or neither")
    rows = []
    clip = arguments.name or (arguments.video.stem if arguments.video else "scene")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        script = scene = None
        model, video = arguments.model, arguments.video
        if model is None:
            script = load_render_scene()
            scene = script.build_scene()
            model, video = true_model(scene, folder / "truth"), EXAMPLES / "scene.mp4"
        for number, tracking in enumerate(TRACKINGS):
            output = folder / str(number)
            options = DensifyOptions(
                match=MatchOptions(tracks=tracking.tracks),
                triangulate=TriangulateOptions(
                    points="survey", max_depth_error=tracking.max_depth_error
                ),
            )
            measured = run_measured(make, model, video, output, options, log=folder / "log.txt")
            dense, reference = read_model(output), read_model(model)
            if script is None:
                off, given = depth_differences(dense, reference), reference.num_points3D()
            else:
                off, given = surface_errors(dense, script, scene), None
            about = {"sequence": clip, "tracks": tracking.name}
            rows.append({**about, **figures(dense, off, given), "cpu_s": measured.cpu_seconds})
    save(arguments.results, rows, ("sequence", "tracks"))
    mine = [row for row in read_rows(arguments.results) if row["sequence"] == clip]
    print(render.dense_points(mine), end="")
    return 0


def make(model: Path, video: Path, output: Path, options: DensifyOptions) -> None:
    """Densify; called in a separate process."""
    densify(model, video, output, options=options)


def figures(dense: Any, off: NDArray[np.float64], given: int | None) -> dict[str, Value]:
    """Figures of a model, given the relative errors of its depths."""
    checked = off[np.isfinite(off)]
    return {
        "points": dense.num_points3D(),
        "points_of_model": given,
        "observations_per_point": dense.compute_mean_track_length(),
        "error_px": float(np.mean([p.error for p in dense.points3D.values()])),
        "depth_error": float(np.median(checked)),
        "above_5_percent": float(np.mean(checked > 0.05)),
        "above_10_percent": float(np.mean(checked > 0.1)),
        "checked": len(checked),
    }


def surface_errors(dense: Any, script: Any, scene: Any) -> NDArray[np.float64]:
    """Distances of points to the nearest surface, relative to those from the first camera."""
    xyz = point_positions(dense)
    first = [
        min(e.image_id for e in dense.points3D[i].track.elements) for i in sorted(dense.points3D)
    ]
    centre = np.array([dense.images[i].projection_center() for i in first])
    off = script.surface_distance(scene, xyz)
    return np.asarray(off / np.linalg.norm(xyz - centre, axis=1))


def true_model(scene: Any, folder: Path) -> Path:
    """A model with the true poses of the rendered clip, without points."""
    folder.mkdir()
    size = {"width": scene.width, "height": scene.height}
    params = [scene.fx, scene.fy, scene.cx, scene.cy]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", params=params, **size)
    images = [
        ModelImage(frame + 1, f"{frame:04d}.png", 1, pose)
        for frame, pose in enumerate(scene.cam_from_world)
    ]
    write_model(folder, {1: camera}, images, ModelPoints.empty())
    return folder


def depth_differences(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction, *, pixels: float = 5.0
) -> NDArray[np.float64]:
    """Relative differences between a model's depths and those of nearby reference points.

    Each point is projected into the middle image of its track and compared with the three nearest
    reference points there that have four or more observations. The one with the most similar depth
    counts, because others may lie on the background at an occlusion boundary.

    Args:
        model: a pycolmap.Reconstruction.
        reference: another model with the same poses and image ids.
        pixels: largest distance in the image to a reference point, in pixels.

    Returns:
        float64 [num_points], in the order of the point ids: the difference divided by the
        reference's depth; NaN if no reference point is near.
    """
    ids = sorted(model.points3D)
    xyz = point_positions(model)
    middle = np.array([_middle_image(model.points3D[i].track) for i in ids], np.int64)
    difference = np.full(len(ids), np.nan)
    for image_id in np.unique(middle):
        seen = [
            (p.xy, reference.points3D[p.point3D_id].xyz)
            for p in reference.images[image_id].points2D
            if p.has_point3D()
            and reference.points3D[p.point3D_id].track.length() >= REFERENCE_LENGTH
        ]
        if not seen:
            continue
        image = model.images[image_id]
        pose = np.asarray(image.cam_from_world().matrix())
        own = np.flatnonzero(middle == image_id)
        in_camera = xyz[own] @ pose[:, :3].T + pose[:, 3]
        own, in_camera = own[in_camera[:, 2] > 0], in_camera[in_camera[:, 2] > 0]
        xy, there = (np.array(column) for column in zip(*seen, strict=True))
        depth = np.append(there @ pose[2, :3] + pose[2, 3], np.nan)
        projected = np.asarray(model.cameras[image.camera_id].img_from_cam(in_camera))
        # KDTree returns len(xy) for a missing neighbour, whose depth here is NaN.
        _, near = KDTree(xy).query(projected, k=NEAREST, distance_upper_bound=pixels)
        off = np.abs(in_camera[:, 2:] / depth[near] - 1)
        difference[own] = np.fmin.reduce(off, axis=1)
    return difference


def _middle_image(track: pycolmap.Track) -> int:
    image_ids = sorted(int(element.image_id) for element in track.elements)
    return image_ids[len(image_ids) // 2]


if __name__ == "__main__":
    raise SystemExit(main())
