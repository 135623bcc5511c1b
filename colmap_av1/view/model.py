"""Show the points and camera path of a model, as a picture or in the browser."""

from __future__ import annotations

import os
from typing import Any

import cv2
import numpy as np
import pycolmap

from colmap_av1.errors import OptionError
from colmap_av1.util.arrays import Floats, Picture
from colmap_av1.view.scene import Scene, normalised, read_scene, vertical_view
from colmap_av1.view.video import SHIFT, fixed_point

_BACKGROUND = 24
# Brightness factor of points with assumed depth.
_FAINT = 0.35
_PATH_COLOUR = (30, 60, 230)  # BGR
_LAST_PORT = 65535
_PANEL_SIZE = (800, 600)  # (width, height) of each of the four views


def view_model(model: str | os.PathLike[str]) -> Picture:
    """Draw the points and the camera path of a COLMAP model from three sides and obliquely.

    The views frame the cameras and the points with observable depth; other points are dark.

    Args:
        model: folder of the model (cameras, images, points3D; .bin or .txt).

    Returns:
        uint8 [height, width, 3] BGR.

    Raises:
        ModelError: the folder has no model, or a model without poses.
    """
    scene = read_scene(model)
    right, up, back = scene.axes
    oblique = normalised(back - 0.5 * right + 0.7 * up)
    oblique_right = normalised(np.cross(up, oblique))
    views = [
        ("from behind and above", oblique_right, np.cross(oblique, oblique_right)),
        ("top", right, -back),
        ("front", right, up),
        ("side", -back, up),
    ]
    panels = [_draw_scene(scene, title, x, y, _PANEL_SIZE) for title, x, y in views]
    rows = [np.concatenate(panels[i : i + 2], axis=1) for i in (0, 2)]
    return np.concatenate(rows, axis=0)


def serve_model(model: str | os.PathLike[str], *, port: int = 8080) -> Any:
    """Show a COLMAP model in the browser: points, cameras and their path.

    Args:
        model: folder of the model.
        port: TCP port, open to this computer only.

    Returns:
        The running server; its method `stop()` ends it.

    Raises:
        ModelError: the folder has no model, or a model without poses.
        OptionError: the viewer's package is not installed, or the port is invalid or taken.
    """
    if not 0 < port <= _LAST_PORT:
        raise OptionError(f"port is {port}: give 1 to {_LAST_PORT}")
    scene = read_scene(model)
    try:
        import viser  # noqa: PLC0415 - an optional dependency
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
    for name, shown in (("points", scene.observable), ("assumed_depth", ~scene.observable)):
        server.scene.add_point_cloud(
            f"/{name}", scene.points[shown], scene.colours[shown], point_size=extent / 1000
        )
    fov, aspect = vertical_view(scene)
    for i, (image, centre) in enumerate(zip(scene.images, scene.centres, strict=True)):
        rotation = pycolmap.Rotation3d(image.cam_from_world[:, :3]).inverse()
        server.scene.add_camera_frustum(
            f"/cameras/{i:06d}",
            fov=fov,
            aspect=aspect,
            scale=extent / 60,
            wxyz=np.roll(rotation.quat, 1),
            position=centre,
        )
    if len(scene.centres) > 1:
        path = np.stack([scene.centres[:-1], scene.centres[1:]], axis=1)
        server.scene.add_line_segments("/path", path, colors=(230, 60, 30))
    return server


def _draw_scene(
    scene: Scene,
    title: str,
    right: Floats,
    up: Floats,
    size: tuple[int, int],
) -> Picture:
    """Draw an orthographic view with near points over far ones, and the camera path."""
    width, height = size
    towards = np.cross(right, up)
    plane = np.stack([right, -up])
    flat = scene.points @ plane.T
    path = scene.centres @ plane.T
    low, high = scene.box(plane)
    scale = 0.9 * float(np.min(np.array(size) / np.maximum(high - low, 1e-9)))
    origin = np.array(size) / 2 - scale * (low + high) / 2
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    # Far points are drawn first. Points with assumed depth are drawn before all others, so that
    # they hide none.
    order = np.lexsort((scene.points @ towards, scene.observable))
    x, y = np.floor(flat[order] * scale + origin).astype(np.int64).T
    brightness = np.where(scene.observable[order], 1.0, _FAINT)[:, None]
    colours = (scene.colours[order, ::-1] * brightness).astype(np.uint8)
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
