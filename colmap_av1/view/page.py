"""Write an HTML page of a model: points and cameras in 3D, key images, timelines and figures."""

from __future__ import annotations

import base64
import os
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError, writing
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.geometry.coverage import coverage
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.images.files import read_image
from colmap_av1.images.names import image_file
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.digests import package_version
from colmap_av1.util.files import check_new_file, output_of_model, whole_file
from colmap_av1.util.pages import render_page
from colmap_av1.util.spread import evenly_spread
from colmap_av1.view.scene import Scene, normalised, read_scene

if TYPE_CHECKING:  # slow to import
    from colmap_av1.matching.gaps import Gap
    from colmap_av1.reconstruct import ReconstructReport, VideoTimeline

Figures = Sequence[tuple[str, str]]

# Largest number of points on a page, evenly spaced in the order of the points; 22 bytes each.
_MOST_POINTS = 200_000
# Largest numbers of drawn cameras and of pictures in the strip, evenly spaced.
_MOST_CAMERAS = 300
_MOST_PICTURES = 24
# Height of these pictures in pixels, and their JPEG quality.
_PICTURE_HEIGHT = 150
_PICTURE_QUALITY = 80
# Points farther away are drawn on a sphere of this radius, in half diagonals of the scene.
_FARTHEST = 3.0
# Longer side of a drawn camera's image plane, in half diagonals of the scene.
_CAMERA_SIZE = 0.045
# Direction from the middle of the scene to the viewer: right, forward, up.
_EYE = (-0.3, -1.2, 0.6)
# Tangent of half the vertical field of view of plotly's camera, and the aspect ratio of its view.
_HALF_VIEW, _ASPECT = 0.414, 1.9
# Share of the points in the initial view; a few stray points would move the viewer far away.
_SEEN = 0.97
# Factor of the viewer's distance.
_MARGIN = 1.06
# Distance from a camera to the point that its view looks at, in half diagonals of the scene.
_AHEAD = 0.5
# Vertices of a drawn camera as lines: 0 to 3 are the corners of its image plane, 4 is its centre,
# and 5 is a NaN that ends a line.
_LINES = (0, 1, 2, 3, 0, 4, 2, 5, 1, 4, 3, 5)
_NUM_TIMES = 6


@dataclass(frozen=True)
class _Picture:
    """A picture of the strip, with plotly's view of the scene from its camera."""

    name: str
    uri: str
    size: tuple[int, int]
    caption: str
    camera: dict[str, Any]


@dataclass(frozen=True)
class _Mark:
    """An image, or a gap between two, on a timeline; positions are in per cent of its length."""

    kind: str
    begin: float
    end: float
    title: str


@dataclass(frozen=True)
class _Timeline:
    """The timeline of a video, with the labels of its time axis."""

    title: str
    marks: list[_Mark]
    times: list[str]


def check_page(
    output: str | os.PathLike[str],
    inputs: Iterable[str | os.PathLike[str] | None] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Check that a page can and may be written, before anything is drawn.

    Args:
        output: the file.
        inputs: files that are read; None: not given.
        overwrite: replace an existing file.

    Raises:
        OptionError: plotly is not installed, or `output` does not end in .html, is an input, or
            exists and `overwrite` is not set.
    """
    _plotly()
    path = Path(output)
    if path.suffix.lower() != ".html":
        raise OptionError(f"{path}: give an output that ends in .html")
    check_new_file(path, inputs, overwrite=overwrite)


def write_model_page(
    model: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    figures: Figures = (),
    report: ReconstructReport | None = None,
    image_path: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a self-contained page of a COLMAP model, which needs no network.

    Args:
        model: folder of the model.
        output: the file, .html.
        figures: names and values that the page lists.
        report: report of the `reconstruct` run that created the model; if None, the page has no
            timeline.
        image_path: folder of the model's images; if None, the folder `images` next to the folder
            `sparse` with the model. If there is none, the page has no pictures.
        overwrite: replace an existing page.

    Raises:
        OptionError: see `check_page`.
        WriteError: the file cannot be written.
        ModelError: the folder has no model, or a model without poses.
        ImageError: an image is missing or unreadable.
    """
    check_page(output, overwrite=overwrite)
    folder = Path(model)
    is_placed = report is not None and "z up" in report.place.axes
    scene = read_scene(folder, up=np.array([0.0, 0.0, 1.0]) if is_placed else None)
    view = _View.of(scene)
    images = Path(image_path) if image_path is not None else _images_beside(folder)
    keys = {name for own in report.timelines for name in own.key_images} if report else set()
    listed = [image for image in scene.images if image.name in keys] or scene.images
    chosen = [listed[i] for i in evenly_spread(len(listed), _MOST_PICTURES)] if images else []
    shown = evenly_spread(len(scene.points), _MOST_POINTS)
    text = render_page(
        "model.html",
        title=_title(folder, report),
        num_images=len(scene.images),
        num_points=len(scene.points),
        num_shown=len(shown),
        num_assumed=int((~scene.observable).sum()),
        farthest=int(_FARTHEST),
        plot=_plot(view, np.array(shown, np.int64), keys),
        pictures=[_picture(view, image, images) for image in chosen] if images else [],
        num_listed=len(listed),
        are_keys=bool(keys),
        timelines=_timelines(scene, report) if report else [],
        gaps=[_gap_in_words(gap) for gap in report.links.gaps] if report else [],
        figures=figures,
        warnings=report.warnings if report else (),
        commands=_commands(folder),
        version=package_version(),
    )
    path = Path(output)
    with writing(path), whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="replace")


def _plotly() -> Any:
    try:
        import plotly.graph_objects  # noqa: PLC0415 - an optional dependency
        import plotly.io  # noqa: PLC0415
    except ImportError as error:
        raise OptionError(
            "a page needs plotly, which is not installed: pip install 'colmap-av1[viewer]'"
        ) from error
    return plotly


def _images_beside(model: Path) -> Path | None:
    folder = model.resolve().parent
    images = folder.with_name("images")
    return images if folder.name == "sparse" and images.is_dir() else None


def _title(model: Path, report: ReconstructReport | None) -> str:
    return model.resolve().parents[1].name if report else f"{model}"


@dataclass(frozen=True)
class _View:
    """A scene in the coordinates of the page: right, forward and up from its middle.

    Attributes:
        scene: the scene.
        axes: float64 [3, 3] unit vectors to the right, forward and up.
        middle: float64 [3] the middle of the scene along these axes.
        radius: half the diagonal of the framed box.
    """

    scene: Scene
    axes: Floats
    middle: Floats
    radius: float

    @staticmethod
    def of(scene: Scene) -> _View:
        right, up, back = scene.axes
        axes = np.stack([right, -back, up])
        low, high = scene.box(axes)
        # A single camera without points has no extent.
        radius = float(np.linalg.norm(high - low)) / 2 or 1.0
        return _View(scene, axes, (low + high) / 2, radius)

    def place(self, xyz: Floats) -> NDArray[np.float32]:
        """Page coordinates of points in half diagonals, limited to `_FARTHEST`, float32 [n, 3]."""
        at = (xyz @ self.axes.T - self.middle) / self.radius
        far = np.linalg.norm(at, axis=1, keepdims=True)
        return np.asarray(at * np.minimum(1.0, _FARTHEST / np.maximum(far, 1e-9)), np.float32)

    def eye(self) -> list[float]:
        """The position that has all cameras and nearly all observable points in view."""
        back = normalised(np.array(_EYE))
        right = normalised(np.cross([0.0, 0.0, 1.0], back))
        axes = np.stack([right, np.cross(back, right), back])
        scene = self.scene
        points, cameras = (
            np.abs(at[:, :2]) / (_HALF_VIEW * np.array([_ASPECT, 1.0])) + at[:, 2:]
            for at in (
                self.place(scene.points[scene.observable]) @ axes.T,
                self.place(scene.centres) @ axes.T,
            )
        )
        distance = cameras.max()
        if len(points):
            distance = max(distance, np.quantile(points.max(axis=1), _SEEN))
        return [float(x) for x in back * distance * _MARGIN]

    def camera(self, image: ModelImage) -> dict[str, Any]:
        """Plotly's view from the camera of an image."""
        (centre,) = camera_centres(image.cam_from_world[None])
        ahead = centre + _AHEAD * self.radius * image.cam_from_world[2, :3]
        eye, towards = self.place(np.stack([centre, ahead])).tolist()
        return {"eye": _xyz(eye), "center": _xyz(towards), "up": _xyz((0.0, 0.0, 1.0))}


def _xyz(values: Sequence[float]) -> dict[str, float]:
    return {axis: round(value, 5) for axis, value in zip("xyz", values, strict=True)}


def _plot(view: _View, shown: Ints, keys: set[str]) -> str:
    """The 3D view as HTML, including plotly's code; it needs no escaping."""
    plotly = _plotly()
    scene = view.scene
    observable = scene.observable[shown]
    drawn = evenly_spread(len(scene.images), _MOST_CAMERAS)
    images = [scene.images[i] for i in drawn]
    groups = {
        "cameras": [image for image in images if image.name not in keys],
        "key images": [image for image in images if image.name in keys],
    }
    traces = [
        *_points(view, "points", shown[observable], {"size": 1.2}),
        *_points(view, "sky and assumed depth", shown[~observable], {"size": 1, "opacity": 0.3}),
        {
            **_columns(view.place(scene.centres)),
            "type": "scatter3d",
            "mode": "lines+markers",
            "name": "camera path",
            "line": {"color": "#e64b1e", "width": 3},
            "marker": {"color": "#e64b1e", "size": 2},
            "text": [image.name for image in scene.images],
            "hovertemplate": "%{text}<extra></extra>",
        },
        *_cameras(view, "cameras", groups["cameras"], "#7fb2e8"),
        *_cameras(view, "key images", groups["key images"], "#f59e0b"),
    ]
    axis = {"visible": False, "range": [-_FARTHEST, _FARTHEST]}
    # This ratio makes one unit of plotly's camera coordinates one half diagonal.
    ratio = 2 * _FARTHEST
    layout = {
        "scene": {
            **{f"{name}axis": axis for name in "xyz"},
            "aspectmode": "manual",
            "aspectratio": _xyz((ratio, ratio, ratio)),
            "camera": {"eye": _xyz(view.eye()), "center": _xyz((0, 0, 0)), "up": _xyz((0, 0, 1))},
            "dragmode": "turntable",
        },
        "paper_bgcolor": "#121417",
        "font": {"color": "#e5e7eb"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0.01, "y": 0.99, "itemsizing": "constant", "bgcolor": "rgba(0,0,0,0.4)"},
    }
    figure = plotly.graph_objects.Figure(traces, layout)
    figure.layout.template = None  # saves two kilobytes of defaults for other plots
    return str(
        plotly.io.to_html(
            figure,
            config={"displaylogo": False, "scrollZoom": True, "responsive": True},
            include_plotlyjs=True,
            full_html=False,
            div_id="scene",
            default_height="640px",
        )
    )


def _columns(at: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    return {axis: np.ascontiguousarray(at[:, i]) for i, axis in enumerate("xyz")}


def _points(view: _View, name: str, rows: Ints, marker: dict[str, float]) -> list[dict[str, Any]]:
    if len(rows) == 0:
        return []
    red, green, blue = view.scene.colours[rows].astype(np.int64).T
    colours = [f"#{colour:06x}" for colour in (red << 16 | green << 8 | blue).tolist()]
    trace = {
        **_columns(view.place(view.scene.points[rows])),
        "type": "scatter3d",
        "mode": "markers",
        "legendgroup": name,
        "showlegend": False,
        "marker": {"color": colours, **marker},
        "hoverinfo": "skip",
    }
    # A separate trace for the legend, which would otherwise show the colour of the first point.
    in_legend = {
        **_columns(np.full((1, 3), np.nan, np.float32)),
        "type": "scatter3d",
        "mode": "markers",
        "name": name,
        "legendgroup": name,
        "marker": {"color": "#e5e7eb", "opacity": marker.get("opacity", 1)},
    }
    return [trace, in_legend]


def _cameras(
    view: _View, name: str, images: Sequence[ModelImage], colour: str
) -> list[dict[str, Any]]:
    if not images:
        return []
    parts = []
    for image in images:
        corners = view.scene.corners(image, _CAMERA_SIZE * view.radius)
        (centre,) = camera_centres(image.cam_from_world[None])
        at = view.place(np.vstack([corners, centre]))
        parts.append(np.vstack([at, np.full(3, np.nan, np.float32)])[list(_LINES)])
    trace = {
        **_columns(np.concatenate(parts)),
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": 2},
        "hoverinfo": "skip",
    }
    return [trace]


def _picture(view: _View, image: ModelImage, folder: Path) -> _Picture:
    picture = read_image(image_file(folder, image.name))
    height, width = picture.shape[:2]
    size = (round(width * _PICTURE_HEIGHT / height), _PICTURE_HEIGHT)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE_QUALITY])
    scene = view.scene
    covered = coverage([PosedCamera(scene.camera_of(image), image.cam_from_world)], scene.points)
    return _Picture(
        name=image.name,
        uri=f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode()}",
        size=size,
        caption=f"coverage {covered:.0%}",
        camera=view.camera(image),
    )


def _timelines(scene: Scene, report: ReconstructReport) -> list[_Timeline]:
    registered = {image.name for image in scene.images}
    return [_timeline(own, registered, report.links.gaps) for own in report.timelines if own.images]


def _timeline(own: VideoTimeline, registered: set[str], gaps: Sequence[Gap]) -> _Timeline:
    frame_of = dict(zip(own.images, own.frames, strict=True))
    keys, left = set(own.key_images), set(own.not_registered)

    def at(frame: int) -> float:
        return 100.0 * (frame + 0.5) / own.num_frames

    marks = [
        _Mark("gap", at(frame_of[gap.before]), at(frame_of[gap.after]), _gap_in_words(gap))
        for gap in gaps
        if gap.before in frame_of and gap.after in frame_of
    ]
    for name, frame in frame_of.items():
        if name in left:
            kind = "not registered"
        elif name not in registered:
            kind = "in another model"
        else:
            kind = "key image" if name in keys else "registered"
        title = f"{name}, frame {frame}, {_time(own, frame)}: {kind}"
        marks.append(_Mark(kind, at(frame), at(frame), title))
    ends = np.linspace(0, own.num_frames, _NUM_TIMES)
    return _Timeline(own.name, marks, [_time(own, int(frame)) for frame in ends])


def _time(own: VideoTimeline, frame: int) -> str:
    if own.frame_rate is None:
        return f"frame {frame}"
    minutes, seconds = divmod(frame / own.frame_rate, 60)
    return f"{int(minutes)}:{seconds:04.1f}"


def _gap_in_words(gap: Gap) -> str:
    return f"gap between {gap.before} and {gap.after}: {', '.join(gap.reasons)}"


def _commands(model: Path) -> list[tuple[str, str]]:
    """Suggestions for the next step: a description and a command each."""
    if output_of_model(model) is None:
        command = ["colmap-av1", "densify", "--model", str(model), "--video", "VIDEO"]
        return [("Add dense points from the video", shlex.join([*command, "--output", "OUTPUT"]))]
    folder = shlex.quote(str(model.resolve().parents[1]))
    return [
        ("Train with Brush", f"brush {folder} --with-viewer"),
        (
            "Train with nerfstudio",
            f"ns-train splatfacto --data {folder} colmap --colmap-path sparse/0",
        ),
    ]
