"""Pictures of a comparison: bar charts, curves, and clouds from a common viewpoint."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from colmap_av1.evaluate.report.results import ALL_TRACKS, Cloud, Column, CompareReport
from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.observable import framed_box
from colmap_av1.util.arrays import Bools, Floats, Ints, Picture

# Colours by the family of front-ends, which is a prefix of their names.
_COLOURS = {
    "av1": ("#0b4f9e", "#3b82d0", "#7fb2e8", "#12355f", "#5aa0c8", "#a9cdf0"),
    "sift": ("#c2410c", "#f59e0b"),
    "": ("#15803d", "#65a30d", "#0f766e", "#7c3aed", "#6b7280"),
}
_BACKGROUND = 18
_PATH_COLOUR = (40, 70, 235)  # BGR
# Pictures are drawn larger by this factor and then reduced, for anti-aliasing.
_OVERSAMPLING = 2
# Distance of the viewpoint behind and above the camera, in median depths of the points, and its
# tilt in degrees.
_BEHIND, _ABOVE, _TILT = 0.25, 0.15, 5.0
# Brightness that points of assumed depth keep.
_FAINT = 0.35
_WIDTH = 640
_STYLE = {
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "colmap-av1",
}


@dataclass(frozen=True)
class View:
    """A viewpoint for drawing clouds.

    Attributes:
        cam_from_world: float64 [3, 4] pose.
        depth: median depth of the points.
        focal_length: focal length in pixels of the images.
    """

    cam_from_world: Floats
    depth: float
    focal_length: float


@dataclass(frozen=True)
class _Panel:
    """One bar chart; `values` has a number for each front-end, or None if it is missing."""

    title: str
    spelling: str
    values: list[Any]


def colours_of(names: Sequence[str]) -> dict[str, str]:
    """The colour of each front-end, similar within a family."""
    taken = dict.fromkeys(_COLOURS, 0)
    found = {}
    for name in names:
        family = next((f for f in _COLOURS if f and name.startswith(f)), "")
        shades = _COLOURS[family]
        found[name] = shades[taken[family] % len(shades)]
        taken[family] += 1
    return found


def bar_charts(report: CompareReport) -> bytes:
    """Bar charts of the main figures of every front-end, as SVG."""
    columns = report.columns
    colours = colours_of([c.name for c in columns])
    models = [(column.model, column.poses, column.cloud) for column in columns]
    panels: list[_Panel] = [
        _Panel("registered images", ",.0f", [m and m.num_registered for m, _, _ in models]),
        _Panel("points", ",.0f", [m and m.num_points for m, _, _ in models]),
        _Panel("mean track length", ".2f", [m and m.mean_track_length for m, _, _ in models]),
        _Panel("mean reprojection error, px", ".3f", [m and m.mean_error for m, _, _ in models]),
    ]
    if report.pose_reference:
        title = f"ATE, % of extent, against {_brief(report.pose_reference)}"
        panels.append(_Panel(title, ".3f", [p and 100 * p.ate / p.extent for _, p, _ in models]))
    if report.cloud_reference:
        title = f"Chamfer distance, % of extent, to {_brief(report.cloud_reference)}"
        shares = [c and 100 * c.chamfer / c.extent for _, _, c in models]
        panels.append(_Panel(title, ".2f", shares))
    with matplotlib.rc_context(_STYLE):
        rows = (len(panels) + 1) // 2
        figure = Figure(figsize=(10, rows * (0.7 + 0.27 * len(columns))), layout="constrained")
        axes: Any = figure.subplots(rows, 2, squeeze=False).ravel()
        for axis in axes[len(panels) :]:
            axis.set_axis_off()
        for axis, panel in zip(axes, panels, strict=False):
            _bars(axis, panel, colours)
        return _svg(figure)


def cost_chart(columns: Sequence[Column]) -> bytes:
    """Stacked bars of the CPU time of every front-end, as SVG."""
    shades = {
        "conversion": "#b45309",
        "matching": "#334155",
        "mapping": "#94a3b8",
        "all tracks": "#5aa0c8",
    }
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10, 0.9 + 0.27 * len(columns)), layout="constrained")
        axis: Any = figure.subplots()
        rows = np.arange(len(columns))
        start = np.zeros(len(columns))
        for stage, shade in shades.items():
            width = np.array([c.cpu_seconds.get(stage, 0.0) for c in columns])
            if width.any():
                axis.barh(rows, width, left=start, color=shade, label=stage, height=0.7)
            start += width
        for y, total in zip(rows, start, strict=True):
            axis.text(total, y, f" {total:,.0f} s" if total else " -", va="center", fontsize=8)
        axis.set_yticks(rows, [c.name for c in columns])
        axis.invert_yaxis()
        axis.margins(x=0.1)
        axis.set_title("CPU time, s", loc="left", fontsize=9)
        _add_legend(axis, loc="lower right", bbox_to_anchor=(1, 1), ncols=len(shades))
        return _svg(figure)


def length_chart(columns: Sequence[Column]) -> bytes:
    """Curves of the number of points with at least a given track length, as SVG."""
    colours = colours_of([c.name for c in columns])
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10, 3.4), layout="constrained")
        axis: Any = figure.subplots()
        for column in columns:
            if not column.track_lengths:
                continue
            lengths = np.array(sorted(column.track_lengths))
            counts = np.array([column.track_lengths[int(n)] for n in lengths])
            at_least = counts[::-1].cumsum()[::-1]
            dashes = "--" if column.name.endswith(ALL_TRACKS) else "-"
            axis.step(
                lengths,
                at_least,
                where="post",
                color=colours[column.name],
                linestyle=dashes,
                label=column.name,
            )
        axis.set_yscale("log")
        axis.set_xscale("log", base=2)
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:.0f}")
        axis.set_xlabel("images")
        axis.set_title("points observed by at least this many images", loc="left", fontsize=9)
        axis.grid(alpha=0.25)
        _add_legend(axis)
        return _svg(figure)


def _add_legend(axis: Any, **how: Any) -> None:
    if axis.get_legend_handles_labels()[0]:  # matplotlib warns about an empty legend.
        axis.legend(frameon=False, fontsize=8, **how)


def training_chart(columns: Sequence[Column]) -> bytes | None:
    """Curves of PSNR-Y and VMAF over training time, as SVG; None without milestones.

    If a trainer does not report times, the curves are over iterations.
    """
    colours = colours_of([c.name for c in columns])
    trained = [(c.name, c.training.states) for c in columns if c.training and c.training.states]
    if not trained:
        return None
    is_timed = all(math.isfinite(state.seconds) for _, states in trained for state in states)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(10, 3.4), layout="constrained")
        axes: Any = figure.subplots(1, 2)
        for axis, quality, label in zip(
            axes, ("psnr_y", "vmaf"), ("PSNR-Y of the test images, dB", "VMAF"), strict=True
        ):
            for name, states in trained:
                values = [state.mean(quality) for state in states]
                along = [state.seconds if is_timed else state.iteration for state in states]
                axis.plot(along, values, marker="o", color=colours[name], label=name)
            axis.set_xlabel("seconds of training" if is_timed else "iterations")
            axis.set_title(label, loc="left", fontsize=9)
            axis.grid(alpha=0.25)
        _add_legend(axes[1], loc="lower right")
        return _svg(figure)


def crop_window(reference: Picture) -> tuple[slice, slice]:
    """Rows and columns of the window with the strongest edges, a third of the picture's size."""
    grey = cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY).astype(np.float32)
    edges = cv2.magnitude(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1))
    height, width = (max(1, n // 3) for n in grey.shape)
    sums = cv2.integral(edges)
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width]
    inside += sums[:-height, :-width]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(int(row), int(row) + height), slice(int(column), int(column) + width)


def _bars(axis: Any, panel: _Panel, colours: Mapping[str, str]) -> None:
    rows = list(range(len(colours)))
    known = [value is not None and np.isfinite(value) for value in panel.values]
    lengths = [
        value if is_known else 0 for value, is_known in zip(panel.values, known, strict=True)
    ]
    axis.barh(rows, lengths, color=list(colours.values()), height=0.7)
    for y, length, is_known in zip(rows, lengths, known, strict=True):
        label = format(length, panel.spelling) if is_known else "-"
        axis.text(length, y, f" {label}", va="center", fontsize=8)
    axis.set_yticks(rows, list(colours))
    axis.invert_yaxis()
    axis.margins(x=0.18)
    axis.xaxis.set_visible(False)
    axis.spines["bottom"].set_visible(False)
    axis.set_title(panel.title, loc="left", fontsize=9)


def _brief(source: str) -> str:
    return source if len(source) <= 16 else "the given truth"


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def view_of(cloud: Cloud) -> View:
    """A viewpoint behind and above the middle camera of a cloud."""
    known = np.flatnonzero(np.isfinite(cloud.cam_from_world).all((1, 2)))
    pose = cloud.cam_from_world[known[len(known) // 2]]
    depth = cloud.points @ pose[2, :3] + pose[2, 3]
    middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    # Camera axes: right, down, forward.
    moved = pose.copy()
    moved[:, 3] += middle * np.array([0.0, _ABOVE, _BEHIND])
    turn = np.radians(_TILT)
    cos, sin = np.cos(turn), np.sin(turn)
    tilt = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return View(tilt @ moved, middle, cloud.focal_length)


def draw_perspective(cloud: Cloud, view: View, size: tuple[int, int]) -> Picture:
    """Points and camera path from a viewpoint: uint8 BGR with the aspect ratio of the images.

    Args:
        cloud: the cloud, in the coordinates of the viewpoint.
        view: the viewpoint.
        size: (width, height) of the images.
    """
    scale = _OVERSAMPLING * min(_WIDTH / size[0], _WIDTH / size[1])
    width, height = round(size[0] * scale), round(size[1] * scale)
    focal = view.focal_length * scale

    def project(points: Floats) -> tuple[Ints, Floats]:
        at = points @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        depth = np.maximum(at[:, 2], 1e-9)
        pixel = at[:, :2] / depth[:, None] * focal + (width / 2, height / 2)
        return np.floor(np.clip(pixel, -1e6, 1e6)).astype(np.int64), at[:, 2]

    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    pixel, depth = project(cloud.points)
    _splat(picture, pixel, depth, cloud, depth > 0.02 * view.depth)
    centres = camera_centres(cloud.cam_from_world)
    centres = centres[np.isfinite(centres).all(1)]
    pixel, depth = project(centres)
    _draw_path(picture, pixel[depth > 0.02 * view.depth])
    return _reduced(picture)


def draw_plan(cloud: Cloud, like: Cloud, size: tuple[int, int]) -> Picture:
    """Points and camera path from above: uint8 BGR.

    It frames the cameras and the points of observable depth; the others are dark.

    Args:
        cloud: the cloud.
        like: a cloud in the same coordinates, whose cameras and extent determine the up direction
            and the frame.
        size: (width, height) of the picture.
    """
    poses = like.cam_from_world[np.isfinite(like.cam_from_world).all((1, 2))]
    forward, down = poses[:, 2, :3].mean(0), poses[:, 1, :3].mean(0)
    down /= np.linalg.norm(down)
    forward -= down * (forward @ down)
    forward /= np.linalg.norm(forward)
    plane = np.stack([np.cross(down, forward), -forward])
    width, height = size[0] * _OVERSAMPLING, size[1] * _OVERSAMPLING
    low, high = framed_box(like.points @ plane.T, like.observable, camera_centres(poses) @ plane.T)
    scale = 0.94 * float(np.min((width, height) / np.maximum(high - low, 1e-9)))
    origin = np.array([width, height]) / 2 - scale * (low + high) / 2
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    pixel = np.floor(cloud.points @ plane.T * scale + origin).astype(np.int64)
    _splat(picture, pixel, cloud.points @ down, cloud, np.ones(len(pixel), dtype=bool))
    centres = camera_centres(cloud.cam_from_world)
    centres = centres[np.isfinite(centres).all(1)]
    _draw_path(picture, np.floor(centres @ plane.T * scale + origin).astype(np.int64))
    return _reduced(picture)


def _splat(
    picture: Picture,
    pixel: Ints,
    depth: Floats,
    cloud: Cloud,
    shown: Bools,
) -> None:
    """Draw points as squares, near over far; those of assumed depth under all others."""
    height, width = picture.shape[:2]
    side = _OVERSAMPLING + 2
    shown = shown & (pixel >= 0).all(1) & (pixel < (width - side, height - side)).all(1)
    order = np.flatnonzero(shown)[np.lexsort((-depth[shown], cloud.observable[shown]))]
    brightness = np.where(cloud.observable[order], 1.0, _FAINT)[:, None]
    colours = (cloud.colours[order, ::-1] * brightness).astype(np.uint8)
    offsets = np.mgrid[:side, :side].reshape(2, -1).T
    # NumPy assigns in order, so the last and nearest point of a pixel remains.
    x, y = (pixel[order][:, None] + offsets).reshape(-1, 2).T
    picture[y, x] = colours.repeat(len(offsets), axis=0)


def _draw_path(picture: Picture, pixel: Ints) -> None:
    line = pixel.astype(np.int32)
    cv2.polylines(picture, [line.reshape(-1, 1, 2)], False, _PATH_COLOUR, 3, cv2.LINE_AA)
    for point in line:
        cv2.circle(picture, point.tolist(), 4, _PATH_COLOUR, -1, cv2.LINE_AA)


def _reduced(picture: Picture) -> Picture:
    size = (picture.shape[1] // _OVERSAMPLING, picture.shape[0] // _OVERSAMPLING)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
