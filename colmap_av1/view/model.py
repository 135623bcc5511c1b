"""Points and camera path of a model, as a picture or in the browser."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.view.pictures import Image
from colmap_av1.view.video import SHIFT, fixed_point

_BACKGROUND = 24
# Quantiles between which points are shown.
_SHOWN = (0.02, 0.98)
_NO_COLOUR = 190
_PATH_COLOUR = (30, 60, 230)  # BGR
_LAST_PORT = 65535


def view_model(model: str | os.PathLike[str], *, size: tuple[int, int] = (1600, 1200)) -> Image:
    """Draw the points and the camera path of a COLMAP model from three sides and obliquely.

    Args:
        model: folder of the model (cameras, images, points3D; .bin or .txt).
        size: (width, height) of the picture in pixels.

    Returns:
        uint8 [height, width, 3] BGR.

    Raises:
        ModelError: the folder holds no model, or one without poses.
    """
    scene = _read_scene(model)
    width, height = size[0] // 2, size[1] // 2
    right, up, back = scene.axes
    oblique = _normalised(back - 0.5 * right + 0.7 * up)
    oblique_right = _normalised(np.cross(up, oblique))
    views = [
        ("from behind and above", oblique_right, np.cross(oblique, oblique_right)),
        ("top", right, -back),
        ("front", right, up),
        ("side", -back, up),
    ]
    panels = [_draw_scene(scene, title, x, y, (width, height)) for title, x, y in views]
    rows = [np.concatenate(panels[i : i + 2], axis=1) for i in (0, 2)]
    return np.concatenate(rows, axis=0)


def serve_model(model: str | os.PathLike[str], *, port: int = 8080) -> Any:
    """Show a COLMAP model in the browser: points, cameras and their path.

    Args:
        model: folder of the model.
        port: TCP port on this computer only.

    Returns:
        The running server; `stop()` ends it.

    Raises:
        ModelError: the folder holds no model, or one without poses.
        OptionError: the viewer's package is not installed, or the port is none or taken.
    """
    if not 0 < port <= _LAST_PORT:
        raise OptionError(f"port is {port}: give 1 to {_LAST_PORT}")
    scene = _read_scene(model)
    try:
        import viser  # noqa: PLC0415 - an extra that only this function needs
    except ImportError as error:
        raise OptionError(
            "the interactive viewer is not installed: pip install 'colmap-av1[viewer]', or give "
            "--output for a picture"
        ) from error
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    if server.get_port() != port:
        taken_instead = server.get_port()
        server.stop()
        raise OptionError(f"port {port} is taken: give another --port, such as {taken_instead}")
    server.scene.set_up_direction(tuple(scene.axes[1]))
    extent = scene.extent
    server.scene.add_point_cloud("/points", scene.points, scene.colours, point_size=extent / 1000)
    for i, (centre, qvec) in enumerate(zip(scene.centres, scene.qvecs, strict=True)):
        server.scene.add_camera_frustum(
            f"/cameras/{i:06d}",
            fov=scene.fov,
            aspect=scene.aspect,
            scale=extent / 60,
            wxyz=qvec,
            position=centre,
        )
    if len(scene.centres) > 1:
        path = np.stack([scene.centres[:-1], scene.centres[1:]], axis=1)
        server.scene.add_line_segments("/path", path, colors=(230, 60, 30))
    return server


@dataclass(frozen=True)
class _Scene:
    """A model as it is drawn.

    Attributes:
        points: float32 [n, 3].
        colours: uint8 [n, 3] RGB.
        centres: float64 [m, 3] of the registered cameras, in the order of the images' names.
        qvecs: float64 [m, 4] (w, x, y, z) rotations from camera to world.
        axes: float64 [3, 3] unit vectors to the right, up and back as most cameras see them.
        extent: length of the diagonal of most of the scene.
        fov: vertical field of view of the first camera in radians.
        aspect: its width by its height.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    centres: NDArray[np.float64]
    qvecs: NDArray[np.float64]
    axes: NDArray[np.float64]
    extent: float
    fov: float
    aspect: float


def _read_scene(model: str | os.PathLike[str]) -> _Scene:
    reconstruction = read_model(model)
    points = list(reconstruction.points3D.values())
    images = sorted(
        (reconstruction.images[i] for i in reconstruction.reg_image_ids()), key=lambda i: i.name
    )
    rotations = np.array([i.cam_from_world().rotation.matrix().T for i in images])
    # Cameras look along their third axis with the second pointing down.
    back = _normalised(-rotations[:, :, 2].mean(axis=0))
    up = -rotations[:, :, 1].mean(axis=0)
    up = _normalised(up - back * (up @ back))
    xyz = np.array([p.xyz for p in points], dtype=np.float32).reshape(-1, 3)
    centres = np.array([i.projection_center() for i in images])
    low, high = np.quantile(np.concatenate([xyz, centres]), _SHOWN, axis=0)
    colours = np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3)
    if not colours.any():  # mapped without images
        colours[:] = _NO_COLOUR
    camera = images[0].camera
    assert camera is not None
    return _Scene(
        points=xyz,
        colours=colours,
        centres=centres,
        qvecs=np.array([np.roll(i.cam_from_world().inverse().rotation.quat, 1) for i in images]),
        axes=np.stack([np.cross(up, back), up, back]),
        extent=float(np.linalg.norm(high - low)),
        fov=2 * math.atan2(camera.height / 2, camera.mean_focal_length()),
        aspect=camera.width / camera.height,
    )


def _draw_scene(
    scene: _Scene,
    title: str,
    right: NDArray[np.float64],
    up: NDArray[np.float64],
    size: tuple[int, int],
) -> Image:
    """An orthographic view, near points over far ones, and the camera path."""
    width, height = size
    towards = np.cross(right, up)
    plane = np.stack([right, -up])
    flat = scene.points @ plane.T
    path = scene.centres @ plane.T
    # All cameras, and most points: a few lie far away.
    low, high = np.quantile(flat, _SHOWN, axis=0) if len(flat) else (path[0], path[0])
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    scale = 0.9 * float(np.min(np.array(size) / np.maximum(high - low, 1e-9)))
    origin = np.array(size) / 2 - scale * (low + high) / 2
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    far_first = np.argsort(scene.points @ towards, kind="stable")
    x, y = np.floor(flat[far_first] * scale + origin).astype(np.int64).T
    colours = scene.colours[far_first, ::-1]
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[y[inside] + dy, x[inside] + dx] = colours[inside]
    line = fixed_point(np.asarray(path * scale + origin, dtype=np.float32))
    cv2.polylines(picture, [line], False, _PATH_COLOUR, 2, cv2.LINE_AA, SHIFT)
    for centre in line:
        cv2.circle(picture, centre.tolist(), 2 << SHIFT, _PATH_COLOUR, -1, cv2.LINE_AA, SHIFT)
    text = f"{title}: {len(flat)} points, {len(path)} cameras"
    cv2.putText(picture, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,) * 3, 1, cv2.LINE_AA)
    return picture


def _normalised(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
