"""Render the example clip, a static courtyard filmed by a hand-held camera, with ground truth.

``python examples/render_scene.py`` writes ``scene.mp4`` (AV1) and ``scene_truth.npz`` next to this
file. The scene is procedural and seeded: planes, boxes, spheres and a cylinder, with textures,
bumps, leaves and lighting baked into them. Light does not depend on the viewpoint, so a surface
point keeps its colour over the whole clip.

Because the surfaces are analytic, the ground truth is exact at any sub-pixel position. Import this
file and call :func:`surface_points`, :func:`project` and :func:`transfer` on :func:`build_scene`.

Conventions: the world is in metres, z up. Cameras look along +z with x right and y down. Image
positions are COLMAP's: the image's top-left corner is (0, 0), the first pixel's centre (0.5, 0.5).
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[Any]
Dot = Callable[[FloatArray], Any]

WIDTH, HEIGHT = 640, 360
FOCAL = 520.0
FRAMES, FPS = 60, 25
CRF = 22
SUPERSAMPLE = 4
DEPTH_STEP = 8
_SEED = 20240229
_SUN = np.array([-0.50, -0.66, 0.78]) / np.linalg.norm([-0.50, -0.66, 0.78])
_SUN_COLOUR = np.array([1.95, 1.66, 1.26], np.float32)
_SKY_COLOUR = np.array([0.33, 0.39, 0.49], np.float32)


# ---------------------------------------------------------------------------------------------
# Geometry


@dataclass(frozen=True)
class Surface:
    """One analytic piece of the scene.

    Attributes:
        kind: "quad", "disc" (the ellipse inscribed in a quad), "sphere" or "cylinder" (its side).
        origin: [3] quad and disc: the corner u = v = 0; sphere: centre; cylinder: base centre.
        edge_u: [3] quad and disc: from u = 0 to u = 1. Sphere and cylinder: (radius, 0, 0),
            u = 0.5 faces -y.
        edge_v: [3] quad and disc: from v = 0 to v = 1. Cylinder: the axis, base to top. Sphere:
            (0, 0, radius).
        material: name of the function that paints it.
        texels: texels per metre of its texture.
        casts: whether it casts a shadow.
    """

    kind: str
    origin: FloatArray
    edge_u: FloatArray
    edge_v: FloatArray
    material: str
    texels: float
    casts: bool = True

    @property
    def normal(self) -> FloatArray:
        """[3] unit normal of a quad or disc, on the side from which u runs right and v down."""
        n = np.cross(self.edge_v, self.edge_u)
        return np.asarray(n / np.linalg.norm(n))

    @property
    def radius(self) -> float:
        """Radius of a sphere or cylinder in metres."""
        return float(np.linalg.norm(self.edge_u))

    @property
    def size(self) -> tuple[float, float]:
        """Extent along u and v in metres (at the equator for a sphere)."""
        if self.kind == "sphere":
            return 2 * math.pi * self.radius, math.pi * self.radius
        if self.kind == "cylinder":
            return 2 * math.pi * self.radius, float(np.linalg.norm(self.edge_v))
        return float(np.linalg.norm(self.edge_u)), float(np.linalg.norm(self.edge_v))


@dataclass(frozen=True)
class Scene:
    """Surfaces, cameras and intrinsics.

    Attributes:
        surfaces: all surfaces; every ray of every frame hits one.
        cam_from_world: [frames, 3, 4] float64, x_cam = R x_world + t.
        width: image width in pixels.
        height: image height in pixels.
        fx: focal length along x in pixels.
        fy: focal length along y in pixels.
        cx: principal point x, COLMAP's convention.
        cy: principal point y.
    """

    surfaces: tuple[Surface, ...]
    cam_from_world: FloatArray
    width: int = WIDTH
    height: int = HEIGHT
    fx: float = FOCAL
    fy: float = FOCAL
    cx: float = WIDTH / 2
    cy: float = HEIGHT / 2


def _rotate(degrees: float) -> FloatArray:
    a = math.radians(degrees)
    return np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1.0]])


def _box(
    centre: tuple[float, float],
    size: tuple[float, float, float],
    yaw: float,
    material: str,
    *,
    base: float = 0.0,
    texels: float = 230.0,
) -> list[Surface]:
    """The four sides and the top of a box standing at height ``base``."""
    sx, sy, sz = size
    turn = _rotate(yaw)
    up = np.array([0, 0, sz])
    foot = np.array([*centre, base])
    corners = [foot + turn @ np.array([x * sx / 2, y * sy / 2, 0]) for x, y in _CORNERS]
    faces = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        # v points down the side, so that textures are upright.
        faces.append(Surface("quad", a + up, b - a, -up, material, texels))
    along, across = corners[1] - corners[0], corners[3] - corners[0]
    faces.append(Surface("quad", corners[3] + up, along, -across, material, texels))
    return [_outward(f, foot + up / 2) for f in faces]


_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _outward(face: Surface, inside: FloatArray) -> Surface:
    """Mirror u where the normal points to ``inside``, so that all faces look outward."""
    middle = face.origin + (face.edge_u + face.edge_v) / 2
    if face.normal @ (middle - inside) > 0:
        return face
    return Surface(
        face.kind, face.origin + face.edge_u, -face.edge_u, face.edge_v, face.material, face.texels
    )


def _wall(
    start: tuple[float, float], end: tuple[float, float], height: float, material: str
) -> Surface:
    """A vertical wall from ``start`` (left, as seen from its front) to ``end``."""
    a = np.array([*start, height])
    b = np.array([*end, height])
    # Extend beyond the neighbouring wall and into the ground, so that no ray slips through by
    # rounding.
    margin = 0.04 * (b - a) / np.linalg.norm(b - a)
    a, b = a - margin, b + margin
    down = np.array([0, 0, -height - 0.04])
    wall = Surface("quad", a, b - a, down, material, 150.0, casts=False)
    return _outward(wall, np.array([0.0, 50.0, 0.0]) if abs(start[0]) < 6 else 3 * a)


def build_scene() -> Scene:
    """The geometry and cameras of the example; fast, because nothing is painted."""
    ground = Surface(
        "quad",
        np.array([-9.0, 6.0, 0.0]),
        np.array([17.0, 0.0, 0.0]),
        np.array([0.0, -10.0, 0.0]),
        "flagstones",
        190.0,
        casts=False,
    )
    surfaces = [
        _outward(ground, np.array([0.0, 0.0, -1.0])),
        _wall((-8.6, -3.0), (-5.2, 2.7), 4.8, "rubble"),
        _wall((-5.2, 2.7), (1.9, 4.3), 4.8, "plastered_brick"),
        _wall((1.9, 4.3), (7.6, -1.6), 4.8, "ivy"),
        *_box((-3.1, 2.75), (0.55, 0.55, 4.8), 12.5, "rubble", texels=150),
        *_box((-0.95, 0.55), (0.95, 0.95, 0.85), 24, "crate"),
        *_box((-0.90, 0.60), (0.52, 0.52, 0.50), -14, "crate_small", base=0.85),
        *_box((0.45, 1.75), (0.85, 0.75, 1.10), 52, "crate_tall", texels=190),
        *_box((1.25, -0.25), (1.05, 1.05, 0.16), -18, "plinth"),
        Surface(
            "sphere",
            np.array([1.25, -0.25, 0.16 + 0.43]),
            np.array([0.43, 0, 0]),
            np.array([0, 0, 0.43]),
            "marble",
            300.0,
        ),
        *_box((-2.35, -0.65), (1.35, 0.50, 0.42), -16, "planter", texels=260),
        Surface(
            "sphere",
            np.array([-2.05, -0.72, 0.42 + 0.19]),
            np.array([0.19, 0, 0]),
            np.array([0, 0, 0.19]),
            "terracotta",
            330.0,
        ),
        Surface(
            "cylinder",
            np.array([2.55, 1.35, 0.0]),
            np.array([0.42, 0, 0]),
            np.array([0, 0, 1.05]),
            "barrel",
            210.0,
        ),
        Surface(
            "disc",
            np.array([2.13, 1.77, 1.05]),
            np.array([0.84, 0, 0]),
            np.array([0, -0.84, 0]),
            "barrel_top",
            210.0,
        ),
        *_box((2.10, -0.75), (0.20, 0.20, 2.9), 31, "post", texels=250),
        *_box((0.05, -1.45), (0.62, 0.34, 0.20), 38, "planter", texels=280),
    ]
    surfaces = [
        _outward(s, s.origin - np.array([0, 0, 1.0])) if s.kind == "disc" else s for s in surfaces
    ]
    return Scene(tuple(surfaces), _camera_path())


def unsteady(seconds: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Motion by steps and hand tremor at the given times, of amplitude about 1 and at most 1.6."""
    total = np.zeros_like(seconds)
    # Higher frequencies have smaller amplitudes, as in real hand-held footage.
    for hertz, share in ((0.7, 1.0), (1.7, 0.42), (3.1, 0.16), (5.3, 0.05)):
        phase, detune = rng.uniform(0, 2 * math.pi), rng.uniform(0.85, 1.15)
        total += share * np.sin(2 * math.pi * hertz * detune * seconds + phase)
    return total


def hand_held(seconds: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Shake of a hand-held camera: shifts in metres and rotation vectors, each [n, 3]."""
    shift = [size * unsteady(seconds, rng) for size in (0.020, 0.015, 0.018)]
    turn = [size * unsteady(seconds, rng) for size in (0.45, 0.40, 0.55)]
    return np.stack(shift, 1), np.radians(np.stack(turn, 1))


def look(centre: FloatArray, target: FloatArray, turn: FloatArray) -> FloatArray:
    """Pose [3, 4] of an upright camera that looks at a target, changed by a rotation vector."""
    forward = target - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = cv2.Rodrigues(turn)[0] @ np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ centre])


def _camera_path() -> FloatArray:
    """[FRAMES, 3, 4] poses of a hand-held camera on an arc of 42 degrees."""
    poses = np.empty((FRAMES, 3, 4))
    along = np.linspace(0, 1, FRAMES)
    angle = np.radians(-22 + 42 * (along + 0.02 * np.sin(2 * math.pi * along)))
    radius = 5.0 - 0.35 * along
    shift, turn = hand_held(np.arange(FRAMES) / FPS, np.random.default_rng(_SEED))
    for k in range(FRAMES):
        orbit = np.array([math.sin(angle[k]), -math.cos(angle[k]), 0]) * radius[k]
        centre = np.array([0.1, 0.35, 1.55 + 0.22 * along[k]]) + orbit + shift[k]
        poses[k] = look(centre, np.array([0.10, 0.35, 0.62]), turn[k])
    return poses


def _intersect(surface: Surface, o_dot: Dot, d_dot: Dot) -> tuple[Any, Any, Any]:
    """First intersections of rays with a surface.

    Args:
        surface: the surface.
        o_dot: maps a [3] vector to its dot product with each ray's origin.
        d_dot: maps a [3] vector to its dot product with each ray's direction.

    Returns:
        Ray parameter (inf for rays that miss the surface), u and v, broadcast over the rays.
    """
    if surface.kind in ("quad", "disc"):
        n = surface.normal
        eu = surface.edge_u / (surface.edge_u @ surface.edge_u)
        ev = surface.edge_v / (surface.edge_v @ surface.edge_v)
        t = (n @ surface.origin - o_dot(n)) / d_dot(n)
        u = (o_dot(eu) - eu @ surface.origin) + t * d_dot(eu)
        v = (o_dot(ev) - ev @ surface.origin) + t * d_dot(ev)
        if surface.kind == "disc":
            hit = (u - 0.5) ** 2 + (v - 0.5) ** 2 <= 0.25
        else:
            hit = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        return np.where(hit & (t > 0), t, np.inf), u, v

    axes = np.eye(3) / surface.radius
    o = [o_dot(a) - a @ surface.origin for a in axes]
    d = [d_dot(a) for a in axes]
    dims = 3 if surface.kind == "sphere" else 2
    a = sum(d[i] * d[i] for i in range(dims))
    b = sum(o[i] * d[i] for i in range(dims))
    c = sum(o[i] * o[i] for i in range(dims)) - 1
    root = b * b - a * c
    t = np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    x, y, z = (o[i] + np.where(root >= 0, t, 0) * d[i] for i in range(3))
    u = 0.5 + np.arctan2(x, -y) / (2 * math.pi)
    if surface.kind == "sphere":
        v = np.arccos(np.clip(z, -1, 1)) / math.pi
    else:
        v = 1 - z * surface.radius / np.linalg.norm(surface.edge_v)
    return np.where((t > 0) & (v >= 0) & (v <= 1), t, np.inf), u, v


_UNIT = ((0, 0), (1, 0), (0, 1), (1, 1))


def _bounds(scene: Scene, frame: int, surface: Surface) -> tuple[float, float, float, float] | None:
    """Rectangle (x0, y0, x1, y1) in pixels that bounds a surface; None if it is not visible."""
    pose = scene.cam_from_world[frame]
    if surface.kind in ("quad", "disc"):
        centre = -pose[:, :3].T @ pose[:, 3]
        if surface.normal @ (centre - surface.origin) <= 0:
            return None
        corners = [surface.origin + i * surface.edge_u + j * surface.edge_v for i, j in _UNIT]
    else:
        r = surface.radius
        low, high = -r, r
        if surface.kind == "cylinder":
            low, high = 0.0, float(np.linalg.norm(surface.edge_v))
        corners = [
            surface.origin + np.array([i * r, j * r, z]) for i, j in _CORNERS for z in (low, high)
        ]
    local = np.array(corners) @ pose[:, :3].T + pose[:, 3]
    if (local[:, 2] < 0.05).all():
        return None
    if (local[:, 2] < 0.05).any():
        return -math.inf, -math.inf, math.inf, math.inf
    x = scene.fx * local[:, 0] / local[:, 2] + scene.cx
    y = scene.fy * local[:, 1] / local[:, 2] + scene.cy
    # A margin, so that rounding does not cut off the rim of the surface.
    return x.min() - 1e-6, y.min() - 1e-6, x.max() + 1e-6, y.max() + 1e-6


def _cast(scene: Scene, frame: int, xy: FloatArray) -> FloatArray:
    """[n] depth along the camera's z axis at positions ``xy`` [n, 2]."""
    return cast(scene, frame, xy)[0]


def cast(scene: Scene, frame: int, xy: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Depths and surfaces at image positions.

    Args:
        scene: the scene.
        frame: frame index.
        xy: [n, 2] positions in pixels, corner (0, 0); they may lie between pixels.

    Returns:
        [n] depth along the camera's z axis, inf where there is no surface, and [n] index of the
        surface.
    """
    pose = scene.cam_from_world[frame]
    centre = -pose[:, :3].T @ pose[:, 3]
    rays = _rays(scene, frame, xy)
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    depth = np.full(len(xy), np.inf)
    seen = np.full(len(xy), -1, dtype=np.int64)
    for serial, surface in enumerate(scene.surfaces):
        box = _bounds(scene, frame, surface)
        if box is None:
            continue
        at = np.flatnonzero((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3]))
        near = rays[at]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = _intersect(surface, centre.dot, near.dot)[0]
        nearer = t < depth[at]
        depth[at[nearer]], seen[at[nearer]] = t[nearer], serial
    return depth, seen


def _rays(scene: Scene, frame: int, xy: FloatArray) -> FloatArray:
    """[n, 3] world directions through ``xy``, one unit long along the camera's z axis."""
    x = (xy[:, 0] - scene.cx) / scene.fx
    y = (xy[:, 1] - scene.cy) / scene.fy
    local = np.stack([x, y, np.ones(len(xy))], 1)
    return np.asarray(local @ scene.cam_from_world[frame, :, :3])


def surface_points(scene: Scene, frame: int, xy: FloatArray) -> FloatArray:
    """World points at image positions.

    Args:
        scene: the scene.
        frame: frame index.
        xy: [n, 2] positions in pixels, corner (0, 0); they may lie between pixels.

    Returns:
        [n, 3] float64 world points in metres, NaN at positions without a surface, which are
        outside the image.
    """
    xy = np.asarray(xy, float)
    pose = scene.cam_from_world[frame]
    depth = _cast(scene, frame, xy)
    depth[np.isinf(depth)] = np.nan
    return np.asarray(-pose[:, :3].T @ pose[:, 3] + depth[:, None] * _rays(scene, frame, xy))


def project(
    scene: Scene, frame: int, points: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Project world points and determine which of them are visible.

    Args:
        scene: the scene.
        frame: frame index.
        points: [n, 3] world points in metres.

    Returns:
        [n, 2] positions in pixels (NaN behind the camera), [n] depths in metres, and [n] bool:
        inside the image and not hidden by another surface.
    """
    pose = scene.cam_from_world[frame]
    local = np.asarray(points, float) @ pose[:, :3].T + pose[:, 3]
    depth = local[:, 2]
    safe = np.where(depth > 0, depth, np.nan)
    xy = np.stack(
        [scene.fx * local[:, 0] / safe + scene.cx, scene.fy * local[:, 1] / safe + scene.cy], 1
    )
    visible = (xy >= 0).all(1) & (xy[:, 0] <= scene.width) & (xy[:, 1] <= scene.height)
    nearest = _cast(scene, frame, xy[visible])
    # A tolerance, so that a surface does not occlude its own points by rounding.
    visible[visible] = nearest >= depth[visible] * (1 - 1e-6)
    return xy, depth, visible


def surface_distance(scene: Scene, points: FloatArray) -> FloatArray:
    """[n] distances in metres of world points [n, 3] to the nearest surface."""
    points = np.asarray(points, float)
    nearest = np.full(len(points), np.inf)
    for surface in scene.surfaces:
        offset = points - surface.origin
        if surface.kind == "sphere":
            distance = np.abs(np.linalg.norm(offset, axis=1) - surface.radius)
        elif surface.kind == "cylinder":
            height = surface.size[1]
            axis = surface.edge_v / height
            along = offset @ axis
            radial = np.linalg.norm(offset - along[:, None] * axis, axis=1) - surface.radius
            distance = np.hypot(radial, along - np.clip(along, 0, height))
        else:
            uv = np.stack([offset @ e / (e @ e) for e in (surface.edge_u, surface.edge_v)], 1)
            if surface.kind == "disc":
                # The only ellipse of the example is a circle.
                away = np.linalg.norm(uv - 0.5, axis=1, keepdims=True)
                uv = 0.5 + (uv - 0.5) * np.minimum(1, 0.5 / np.maximum(away, 1e-12))
            uv = np.clip(uv, 0, 1)
            foot = uv[:, :1] * surface.edge_u + uv[:, 1:] * surface.edge_v
            distance = np.linalg.norm(offset - foot, axis=1)
        nearest = np.minimum(nearest, distance)
    return nearest


def transfer(
    scene: Scene, xy: FloatArray, frame_a: int, frame_b: int
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Exact positions in frame b of the surface points at positions in frame a.

    Args:
        scene: the scene.
        xy: [n, 2] positions in frame a in pixels, corner (0, 0).
        frame_a: frame index of the positions.
        frame_b: frame index of the result.

    Returns:
        [n, 2] positions in frame b, and [n] bool whether the points are visible there.
    """
    xy_b, _, visible = project(scene, frame_b, surface_points(scene, frame_a, xy))
    return xy_b, visible


# ---------------------------------------------------------------------------------------------
# Painting. A painter returns linear albedo [h, w, 3] and height [h, w] in metres.

Painted = tuple[FloatArray, FloatArray]


def _noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float | tuple[float, float],
    octaves: int = 6,
    gain: float = 0.55,
) -> FloatArray:
    """[h, w] fractal noise of about unit variance; ``cell`` is the longest wavelength in texels."""
    cell_y, cell_x = cell if isinstance(cell, tuple) else (cell, cell)
    total = np.zeros(shape, np.float32)
    power = 0.0
    for k in range(octaves):
        cy, cx = max(cell_y / 2**k, 1.0), max(cell_x / 2**k, 1.0)
        if max(cy, cx) < 1.5:
            break
        rows, cols = math.ceil(shape[0] / cy) + 5, math.ceil(shape[1] / cx) + 5
        grid = rng.standard_normal((rows, cols)).astype(np.float32)
        matrix = np.array([[1 / cx, 0, 2], [0, 1 / cy, 2]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        total += gain**k * cv2.warpAffine(grid, matrix, shape[::-1], flags=flags)
        power += gain ** (2 * k)
    return np.asarray(total * (1.45 / math.sqrt(power)))


def _step(low: float, high: float, x: FloatArray) -> FloatArray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _mix(a: FloatArray, b: FloatArray, weight: FloatArray) -> FloatArray:
    return np.asarray(a + (b - a) * weight[..., None])


def _rgb(*values: int) -> FloatArray:
    """Linear colour of 8-bit sRGB values."""
    return ((np.array(values, np.float32) / 255) ** 2.2).astype(np.float32)


def _edges(labels: FloatArray) -> FloatArray:
    """[h, w] distance in texels to the nearest border between labels."""
    inner = np.ones(labels.shape, np.uint8)
    inner[:, 1:][labels[:, 1:] != labels[:, :-1]] = 0
    inner[1:][labels[1:] != labels[:-1]] = 0
    return np.asarray(cv2.distanceTransform(inner, cv2.DIST_L2, 5))


def _warp_labels(
    rng: np.random.Generator, labels: FloatArray, amount: float, cell: float
) -> FloatArray:
    """Move label borders by smooth noise of ``amount`` texels, for a hand-made look."""
    h, w = labels.shape
    ys, xs = np.mgrid[0:h, 0:w].astype(np.float32)
    xs += amount * _noise(rng, (h, w), cell, 4)
    ys += amount * _noise(rng, (h, w), cell, 4)
    moved = cv2.remap(
        labels.astype(np.float32), xs, ys, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved.astype(np.int32))


def _stones(
    rng: np.random.Generator, shape: tuple[int, int], cell_x: float, cell_y: float
) -> FloatArray:
    """[h, w] int labels of irregular stones about ``cell_x`` by ``cell_y`` texels large."""
    h, w = shape
    small = (h, max(round(w * cell_y / cell_x), 1))
    seeds = np.ones(small, np.uint8)
    for y in np.arange(0, small[0], cell_y):
        for x in np.arange(0, small[1], cell_y):
            px, py = x + rng.uniform(0.08, 0.92) * cell_y, y + rng.uniform(0.08, 0.92) * cell_y
            if py < small[0] and px < small[1]:
                seeds[int(py), int(px)] = 0
    _, labels = cv2.distanceTransformWithLabels(
        seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    return np.asarray(cv2.resize(labels, (w, h), interpolation=cv2.INTER_NEAREST))


def _courses(
    rng: np.random.Generator, shape: tuple[int, int], length: float, height: float
) -> FloatArray:
    """[h, w] int labels of bricks or boards laid in rows of ``height`` texels."""
    h, w = shape
    labels = np.zeros(shape, np.int32)
    top, serial = 0.0, 1
    while top < h:
        bottom = top + height * rng.uniform(0.9, 1.1)
        cuts = np.cumsum(length * rng.uniform(0.72, 1.25, int(2 * w / length) + 4))
        cuts -= rng.uniform(0, 1) * length
        ids = np.searchsorted(cuts, np.arange(w))
        labels[round(top) : round(bottom)] = serial + ids
        serial += len(cuts) + 1
        top = bottom
    return labels


def _per_label(
    rng: np.random.Generator, labels: FloatArray, palette: FloatArray, spread: float
) -> FloatArray:
    """[h, w, 3] palette colours by label, with random brightness and tint."""
    count = int(labels.max()) + 1
    colours = palette[rng.integers(0, len(palette), count)]
    colours = colours * np.exp(spread * rng.standard_normal((count, 1)))
    colours = colours * np.exp(0.25 * spread * rng.standard_normal((count, 3)))
    return np.asarray(colours.astype(np.float32)[labels])


def _leaves(
    rng: np.random.Generator,
    painted: Painted,
    centres: FloatArray,
    size: FloatArray,
    colours: FloatArray,
    *,
    lift: float,
) -> None:
    """Draw pointed leaves in place at ``centres`` [n, 2] (texels), ``size`` [n] texels long."""
    albedo, height = painted
    outline = np.array(
        [
            [-1, 0],
            [-0.6, 0.36],
            [0, 0.5],
            [0.55, 0.3],
            [1, 0],
            [0.55, -0.3],
            [0, -0.5],
            [-0.6, -0.36],
        ]
    )
    for centre, length, colour in zip(centres, size, colours, strict=True):
        turn = _rotate(rng.uniform(0, 360))[:2, :2]
        shape = outline * (length / 2) * (1 + 0.13 * rng.standard_normal(outline.shape))
        points = shape @ turn.T + centre
        fixed = np.round(points * 16).astype(np.int32)
        shadow = np.round((points + 0.09 * length + 0.6) * 16).astype(np.int32)
        where = tuple(np.clip(centre.astype(int)[::-1], 0, np.array(height.shape) - 1))
        dark = (albedo[where] * 0.35).tolist()
        level = float(height[where]) + lift * rng.uniform(0.5, 1.5)
        cv2.fillConvexPoly(albedo, shadow, dark, cv2.LINE_AA, 4)
        cv2.fillConvexPoly(albedo, fixed, colour.tolist(), cv2.LINE_AA, 4)
        cv2.fillConvexPoly(height, fixed, level, cv2.LINE_AA, 4)
        rib = np.round(np.stack([points[0], points[4]]) * 16).astype(np.int32)
        rib_colour = (colour * 1.5).tolist()
        cv2.line(albedo, rib[0].tolist(), rib[1].tolist(), rib_colour, 1, cv2.LINE_AA, 4)


def _speckle(rng: np.random.Generator, shape: tuple[int, int], amount: float) -> FloatArray:
    """[h, w, 1] fine grain of about two texels, multiplied onto an albedo."""
    return np.asarray(np.exp(amount * _noise(rng, shape, 5, 3, 0.9)))[..., None]


def _flagstones(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    labels = _stones(rng, shape, 0.62 * texels, 0.46 * texels)
    labels = _warp_labels(rng, labels, 0.018 * texels, 0.25 * texels)
    gap = _edges(labels) / texels
    palette = np.stack(
        [_rgb(158, 146, 128), _rgb(139, 134, 126), _rgb(172, 154, 124), _rgb(124, 120, 117)]
    )
    albedo = _per_label(rng, labels, palette, 0.16)
    broad, fine = _noise(rng, shape, 1.1 * texels), _noise(rng, shape, 0.14 * texels)
    veins = np.abs(_noise(rng, shape, 0.5 * texels, 5))
    albedo *= np.exp(0.16 * broad + 0.20 * fine)[..., None] * _speckle(rng, shape, 0.16)
    albedo = _mix(albedo, albedo * 0.62, _step(0.07, 0.0, veins))
    lichen = _step(0.9, 1.5, _noise(rng, shape, 0.22 * texels, 6, 0.7))
    albedo = _mix(albedo, _rgb(190, 186, 150) * _speckle(rng, shape, 0.15), 0.7 * lichen)
    ragged = gap + 0.006 * fine
    soil = _mix(
        _rgb(66, 55, 43) * np.ones((*shape, 1), np.float32),
        _rgb(88, 102, 46) * np.ones((*shape, 1), np.float32),
        _step(-0.4, 0.7, broad + 0.6 * fine),
    )
    soil *= _speckle(rng, shape, 0.42)
    on_stone = _step(0.010, 0.024, ragged)
    albedo = _mix(soil, albedo, on_stone)
    height = 0.016 * _step(0.004, 0.045, ragged) + 0.0022 * fine + 0.006 * on_stone * broad * 0.3
    count = 1500
    drift = _noise(rng, shape, 2.2 * texels, 3)
    centres = rng.uniform(0, 1, (6 * count, 2)) * np.array(shape[::-1])
    density = drift[centres[:, 1].astype(int), centres[:, 0].astype(int)]
    centres = centres[np.argsort(-(density + 0.9 * rng.standard_normal(len(centres))))][:count]
    autumn = np.stack(
        [_rgb(176, 92, 34), _rgb(196, 140, 46), _rgb(124, 60, 30), _rgb(150, 128, 52)]
    )
    colours = autumn[rng.integers(0, 4, count)] * np.exp(0.22 * rng.standard_normal((count, 1)))
    _leaves(
        rng, (albedo, height), centres, texels * rng.uniform(0.05, 0.11, count), colours, lift=0.006
    )
    return albedo, height


def _masonry(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    labels = _stones(rng, shape, 0.46 * texels, 0.25 * texels)
    labels = _warp_labels(rng, labels, 0.012 * texels, 0.16 * texels)
    gap = _edges(labels) / texels
    palette = np.stack(
        [_rgb(170, 150, 120), _rgb(148, 134, 114), _rgb(126, 118, 108), _rgb(182, 166, 136)]
    )
    fine = _noise(rng, shape, 0.12 * texels)
    albedo = _per_label(rng, labels, palette, 0.20) * np.exp(0.24 * fine)[..., None]
    albedo *= _speckle(rng, shape, 0.14)
    ragged = gap + 0.006 * fine
    mortar = _rgb(186, 176, 156) * np.exp(0.14 * fine)[..., None] * _speckle(rng, shape, 0.14)
    albedo = _mix(mortar, albedo, _step(0.008, 0.020, ragged))
    damp = _noise(rng, shape, (1.6 * texels, 0.5 * texels))
    albedo *= np.exp(0.20 * np.minimum(damp, 0.4))[..., None]
    height = 0.030 * _step(0.0, 0.06, ragged) + 0.004 * fine
    return albedo, height


def _plastered_brick(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    labels = _courses(rng, shape, 0.29 * texels, 0.105 * texels)
    labels = _warp_labels(rng, labels, 0.005 * texels, 0.2 * texels)
    gap = _edges(labels) / texels
    palette = np.stack(
        [_rgb(158, 82, 58), _rgb(138, 70, 52), _rgb(176, 104, 72), _rgb(116, 66, 54)]
    )
    fine, mid = _noise(rng, shape, 0.08 * texels), _noise(rng, shape, 0.5 * texels)
    brick = _per_label(rng, labels, palette, 0.20) * np.exp(0.20 * fine)[..., None]
    mortar = _rgb(178, 168, 152) * np.exp(0.15 * fine)[..., None]
    face = _step(0.004, 0.012, gap + 0.003 * fine)
    albedo = _mix(mortar, brick, face) * _speckle(rng, shape, 0.13)
    height = 0.010 * face + 0.002 * fine
    # The remaining plaster is thicker than the relief of the bricks, so that its edge is visible.
    cover = _noise(rng, shape, 1.7 * texels, 8, 0.58)
    depth_down = np.linspace(0.55, -0.75, shape[0], dtype=np.float32)[:, None]
    plaster = _step(0.02, 0.07, cover + depth_down + 0.33)
    tint = _mix(
        _rgb(226, 182, 128) * np.ones((*shape, 1), np.float32),
        _rgb(196, 158, 116) * np.ones((*shape, 1), np.float32),
        _step(-1.2, 1.2, mid),
    )
    streaks = _noise(rng, shape, (1.3 * texels, 0.07 * texels), 5)
    crack = np.abs(_noise(rng, shape, 0.8 * texels, 6, 0.6))
    tint *= np.exp(0.10 * streaks + 0.13 * mid + 0.15 * fine)[..., None]
    tint = _mix(tint, tint * 0.45, _step(0.035, 0.0, crack)) * _speckle(rng, shape, 0.10)
    albedo = _mix(albedo, tint, plaster)
    height = height + plaster * (0.022 + 0.004 * mid + 0.003 * fine - height)
    return albedo, height


def _ivy(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    albedo, height = _masonry(rng, shape, texels)
    climb = _noise(rng, shape, (1.9 * texels, 1.2 * texels), 5)
    count = 9000
    centres = rng.uniform(0, 1, (3 * count, 2)) * np.array(shape[::-1])
    density = climb[centres[:, 1].astype(int), centres[:, 0].astype(int)]
    keep = density + 0.45 * rng.standard_normal(len(centres)) > 0.15
    centres = centres[keep][:count]
    green = np.stack([_rgb(70, 106, 44), _rgb(96, 130, 56), _rgb(50, 82, 38), _rgb(126, 142, 62)])
    n = len(centres)
    colours = green[rng.integers(0, 4, n)] * np.exp(0.28 * rng.standard_normal((n, 1)))
    _leaves(rng, (albedo, height), centres, texels * rng.uniform(0.07, 0.15, n), colours, lift=0.02)
    return albedo, height


def _boards(
    rng: np.random.Generator,
    shape: tuple[int, int],
    texels: float,
    palette: FloatArray,
    width: float,
    *,
    upright: bool = False,
) -> Painted:
    """Weathered boards ``width`` metres wide, horizontal or vertical."""
    if upright:
        albedo, height = _boards(rng, shape[::-1], texels, palette, width)
        return albedo.transpose(1, 0, 2).copy(), height.T.copy()
    labels = _courses(rng, shape, 40 * shape[1], width * texels)
    gap = _edges(labels) / texels
    bend = _noise(rng, shape, (0.12 * texels, 0.5 * texels), 3)
    rows = np.arange(shape[0], dtype=np.float32)[:, None]
    rings = np.sin(rows * (2 * math.pi / (0.016 * texels)) + 3.2 * bend + 1.7 * labels)
    grain = _noise(rng, shape, (0.02 * texels, 0.45 * texels), 5, 0.7)
    wear = _noise(rng, shape, 0.25 * texels)
    albedo = _per_label(rng, labels, palette, 0.18)
    albedo *= np.exp(0.10 * rings + 0.24 * grain + 0.20 * wear)[..., None]
    albedo *= _speckle(rng, shape, 0.10)
    knots = rng.uniform(0, 1, (max(int(9 * shape[0] * shape[1] / texels**2), 1), 2))
    for x, y in knots * np.array(shape[::-1]):
        ry, rx = 0.010 * texels * rng.uniform(0.7, 1.5), 0.017 * texels * rng.uniform(0.7, 1.6)
        far = np.hypot(
            (np.arange(shape[1])[None] - x) / rx, (np.arange(shape[0])[:, None] - y) / ry
        )
        albedo = _mix(albedo, albedo * 0.30, _step(1.4, 0.5, far.astype(np.float32)))
    open_gap = _step(0.001, 0.007, gap + 0.001 * grain)
    albedo *= (0.16 + 0.84 * open_gap)[..., None]
    return albedo, 0.008 * _step(0.0, 0.010, gap) + 0.0012 * grain


_PINE = np.stack([_rgb(190, 146, 92), _rgb(172, 128, 78), _rgb(200, 162, 110)])
_GREY_WOOD = np.stack([_rgb(150, 136, 116), _rgb(128, 114, 98), _rgb(164, 146, 120)])
_BLUE_PAINT = np.stack([_rgb(70, 108, 128), _rgb(82, 122, 138), _rgb(60, 94, 118)])
_OAK = np.stack([_rgb(142, 96, 58), _rgb(124, 80, 48), _rgb(156, 110, 68)])


def _crate(
    rng: np.random.Generator,
    shape: tuple[int, int],
    texels: float,
    palette: FloatArray,
    words: tuple[str, str],
) -> Painted:
    """Boards in a frame, nailed and stencilled."""
    albedo, height = _boards(rng, shape, texels, palette, 0.13)
    h, w = shape
    stencil = np.zeros(shape, np.uint8)
    for k, word in enumerate(words):
        scale = 0.55 * w / max(cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 1, 2)[0][0], 1)
        place = (round(w * (0.22 + 0.04 * k)), round(h * (0.44 + 0.27 * k)))
        stroke = max(round(1.6 * scale), 1)
        cv2.putText(stencil, word, place, cv2.FONT_HERSHEY_DUPLEX, scale, 255, stroke, cv2.LINE_AA)
    ink = stencil.astype(np.float32) / 255
    worn = _step(-1.9, -0.7, _noise(rng, shape, 0.09 * texels, 5, 0.8))
    albedo = _mix(albedo, _rgb(44, 38, 36) * np.ones((*shape, 1), np.float32), 0.85 * ink * worn)
    frame, frame_height = _boards(rng, shape, texels, palette * 0.86, 0.30, upright=True)
    side = 0.085 * texels
    xs = np.minimum(np.arange(w) + 0.5, w - np.arange(w) - 0.5)[None].astype(np.float32)
    ys = np.minimum(np.arange(h) + 0.5, h - np.arange(h) - 0.5)[:, None].astype(np.float32)
    uprights, rails = _step(side + 1, side - 1, xs), _step(side + 1, side - 1, ys)
    rail, rail_height = _boards(rng, shape, texels, palette * 0.92, 0.30)
    dark = np.exp(-(np.maximum(np.minimum(xs, ys) - side, 0) / (0.012 * texels)))
    albedo *= (1 - 0.55 * dark)[..., None]
    albedo = _mix(_mix(albedo, rail, rails), frame, uprights)
    height = height * (1 - rails) + (rail_height + 0.016) * rails
    height = height * (1 - uprights) + (frame_height + 0.018) * uprights
    for x in (side / 2, w - side / 2):
        for y in np.arange(0.35, h / side) * side:
            centre = (round(16 * (x + rng.normal(0, 0.1 * side))), round(16 * y))
            cv2.circle(albedo, centre, round(16 * 0.007 * texels), (0.02,) * 3, -1, cv2.LINE_AA, 4)
    return albedo, height


def _concrete(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    fine, mid = _noise(rng, shape, 0.05 * texels, 5, 0.75), _noise(rng, shape, 0.4 * texels)
    albedo = _rgb(176, 168, 154) * np.exp(0.20 * fine + 0.22 * mid)[..., None]
    pits = _step(1.5, 2.0, _noise(rng, shape, 0.035 * texels, 3))
    moss = _step(0.5, 1.4, mid + 0.5 * fine)
    albedo = _mix(albedo, _rgb(104, 112, 62) * _speckle(rng, shape, 0.35), 0.7 * moss)
    albedo = _mix(albedo, albedo * 0.4, pits) * _speckle(rng, shape, 0.12)
    return albedo, 0.0035 * fine - 0.006 * pits


def _solid_noise(
    rng: np.random.Generator, points: FloatArray, cell: float, octaves: int, gain: float
) -> FloatArray:
    """Fractal noise at 3D ``points`` [..., 3], which has no seams or poles on any surface."""
    total = np.zeros(points.shape[:-1], np.float32)
    power = 0.0
    for k in range(octaves):
        scaled = points / (cell / 2**k) + 100.37
        base = np.floor(scaled)
        f = (scaled - base).astype(np.float32)
        f = f * f * (3 - 2 * f)
        low = base.astype(np.int64)
        low -= low.min(axis=tuple(range(low.ndim - 1)))
        grid = rng.standard_normal(tuple(low.reshape(-1, 3).max(0) + 2)).astype(np.float32)
        value = np.zeros(points.shape[:-1], np.float32)
        for corner in np.ndindex(2, 2, 2):
            weight = np.ones(points.shape[:-1], np.float32)
            for axis in range(3):
                weight *= f[..., axis] if corner[axis] else 1 - f[..., axis]
            at = low + np.array(corner)
            value += weight * grid[at[..., 0], at[..., 1], at[..., 2]]
        total += gain**k * value
        power += gain ** (2 * k)
    return np.asarray(total * (1.7 / math.sqrt(power)))


def _ball(
    rng: np.random.Generator, points: FloatArray, palette: FloatArray, relief: float
) -> Painted:
    """Veined stone or clay for a sphere whose texels lie at ``points`` [h, w, 3]."""
    size = float(np.ptp(points[..., 2]))
    broad = _solid_noise(rng, points, 0.45 * size, 6, 0.6)
    fine = _solid_noise(rng, points, 0.07 * size, 5, 0.8)
    veins = np.abs(_solid_noise(rng, points, 0.6 * size, 6, 0.55))
    albedo = _mix(
        palette[0] * np.ones((*broad.shape, 1), np.float32),
        palette[1] * np.ones((*broad.shape, 1), np.float32),
        _step(-1.0, 1.0, broad),
    )
    albedo = _mix(
        albedo, palette[2] * np.ones((*broad.shape, 1), np.float32), _step(0.12, 0, veins)
    )
    spots = _step(1.1, 1.7, _solid_noise(rng, points, 0.12 * size, 4, 0.6))
    albedo = _mix(albedo, palette[2] * 0.8 * np.ones((*broad.shape, 1), np.float32), 0.6 * spots)
    albedo *= np.exp(0.22 * fine)[..., None]
    return albedo, relief * (0.5 * fine - _step(0.10, 0, veins))


def _barrel(rng: np.random.Generator, shape: tuple[int, int], texels: float) -> Painted:
    albedo, height = _boards(rng, shape, texels, _OAK, 0.105, upright=True)
    rows = np.arange(shape[0], dtype=np.float32)[:, None] / shape[0]
    for place in (0.06, 0.27, 0.73, 0.94):
        hoop = _step(0.030, 0.026, np.abs(rows - place)) * np.ones((1, shape[1]), np.float32)
        rust = _noise(rng, shape, 0.08 * texels, 5, 0.7)
        iron = _mix(
            _rgb(84, 80, 80) * np.ones((*shape, 1), np.float32),
            _rgb(134, 78, 46) * np.ones((*shape, 1), np.float32),
            _step(-0.6, 1.2, rust),
        )
        albedo = _mix(albedo, iron * _speckle(rng, shape, 0.14), hoop)
        height = height * (1 - hoop) + 0.014 * hoop
    return albedo, height


def _paint(surface: Surface, serial: int, points: FloatArray) -> Painted:
    """Albedo and height of a surface whose texels lie at world ``points`` [h, w, 3]."""
    rng = np.random.default_rng([_SEED, serial])
    shape = (points.shape[0], points.shape[1])
    texels = surface.texels
    if surface.material in ("marble", "terracotta"):
        marble = np.stack([_rgb(196, 188, 176), _rgb(140, 132, 128), _rgb(78, 70, 66)])
        clay = np.stack([_rgb(196, 112, 72), _rgb(158, 80, 50), _rgb(214, 168, 132)])
        palette = marble if surface.material == "marble" else clay
        return _ball(rng, points, palette, 0.05 * surface.radius)
    painters: dict[str, Callable[[], Painted]] = {
        "flagstones": lambda: _flagstones(rng, shape, texels),
        "rubble": lambda: _masonry(rng, shape, texels),
        "plastered_brick": lambda: _plastered_brick(rng, shape, texels),
        "ivy": lambda: _ivy(rng, shape, texels),
        "crate": lambda: _crate(rng, shape, texels, _PINE, ("AV1", "No. 27")),
        "crate_small": lambda: _crate(rng, shape, texels, _BLUE_PAINT, ("4x4", "units")),
        "crate_tall": lambda: _crate(rng, shape, texels, _GREY_WOOD, ("COLMAP", "this way up")),
        "plinth": lambda: _concrete(rng, shape, texels),
        "planter": lambda: _plastered_brick(rng, shape, 0.55 * texels),
        "barrel": lambda: _barrel(rng, shape, texels),
        "barrel_top": lambda: _boards(rng, shape, texels, _OAK, 0.11),
        "post": lambda: _boards(rng, shape, texels, _GREY_WOOD, 0.5, upright=True),
    }
    return painters[surface.material]()


# ---------------------------------------------------------------------------------------------
# Baked light: a low sun through leaves, and sky light with ambient occlusion


def _texel_points(surface: Surface, rows: int, cols: int) -> tuple[FloatArray, FloatArray]:
    """[rows, cols, 3] world points of texel centres and the outward unit normals there."""
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(cols) + 0.5) / cols, indexing="ij"
    )
    if surface.kind in ("quad", "disc"):
        points = surface.origin + u[..., None] * surface.edge_u + v[..., None] * surface.edge_v
        return points, np.broadcast_to(surface.normal, points.shape)
    angle = (u - 0.5) * 2 * math.pi
    ring = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], -1)
    if surface.kind == "cylinder":
        return surface.origin + ring * surface.radius + (1 - v)[..., None] * surface.edge_v, ring
    polar = (v * math.pi)[..., None]
    normals = ring * np.sin(polar) + np.array([0, 0, 1.0]) * np.cos(polar)
    return surface.origin + normals * surface.radius, normals


def _blocked(
    surfaces: list[Surface], points: FloatArray, direction: FloatArray, reach: float
) -> NDArray[np.bool_]:
    """[n] whether a ray from each point hits a surface within ``reach`` metres."""
    shadow = np.zeros(len(points), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for s in surfaces:
            if s.kind in ("quad", "disc") and abs(s.normal @ direction) < 1e-9:
                continue
            t = _intersect(s, lambda e: points @ e.astype(np.float32), lambda e: direction @ e)[0]
            shadow |= t < reach
    return shadow


def _light(scene: Scene, surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Sunlit share and sky share [rows, cols] on a coarse grid over a surface."""
    rng = np.random.default_rng(_SEED + 1)
    size_u, size_v = surface.size
    per_metre = 22 if max(size_u, size_v) > 3 else 44
    rows, cols = max(round(size_v * per_metre), 4), max(round(size_u * per_metre), 4)
    points, normals = _texel_points(surface, rows, cols)
    start = (points + 2e-3 * normals).reshape(-1, 3).astype(np.float32)
    flat_normals = normals.reshape(-1, 3)

    casters = [s for s in scene.surfaces if s.casts]
    sun = np.zeros(len(start), np.float32)
    rays = 16
    for _ in range(rays):
        direction = _SUN + 0.02 * rng.standard_normal(3)
        sun += ~_blocked(casters, start, direction / np.linalg.norm(direction), 20.0)

    sky = np.zeros(len(start), np.float32)
    weights = np.full(len(start), 1e-3, np.float32)
    for k in range(28):
        # Directions on a spiral over the sphere, weighted by the cosine with the texel's normal.
        z = 1 - (2 * k + 1) / 28
        turn = k * 2.399963
        ring = math.sqrt(1 - z * z)
        direction = np.array([ring * math.cos(turn), ring * math.sin(turn), z])
        facing = np.maximum(flat_normals @ direction, 0).astype(np.float32)
        facing *= 0.35 + 0.65 * (z > 0)
        lit = facing > 0
        open_sky = np.zeros(len(start), bool)
        open_sky[lit] = ~_blocked(list(scene.surfaces), start[lit], direction, 1.6)
        sky += facing * open_sky
        weights += facing
    share = (sun / rays).reshape(rows, cols) * _dapple(points)
    return share, cv2.GaussianBlur((sky / weights).reshape(rows, cols), (0, 0), 1.2)


def _dapple(points: FloatArray) -> FloatArray:
    """Shadow of leaves [rows, cols]: smooth noise on a plane perpendicular to the sun."""
    rng = np.random.default_rng(_SEED + 2)
    a = np.cross(_SUN, [0, 0, 1.0])
    a /= np.linalg.norm(a)
    b = np.cross(_SUN, a)
    canopy = _noise(rng, (640, 640), 36, 4, 0.6)
    canopy = 0.42 + 0.58 * _step(-0.55, 0.15, canopy)
    x = ((points @ a) * 20 + 320).astype(np.float32)
    y = ((points @ b) * 20 + 320).astype(np.float32)
    return np.asarray(cv2.remap(canopy, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT))


@dataclass(frozen=True)
class _Texture:
    """Mipmaps of linear radiance, ``levels[k]`` float32 [h, w, 3]."""

    metres: float
    levels: list[FloatArray] = field(default_factory=list)


def _texture(scene: Scene, serial: int) -> _Texture:
    surface = scene.surfaces[serial]
    size_u, size_v = surface.size
    rows, cols = max(round(size_v * surface.texels), 8), max(round(size_u * surface.texels), 8)
    points, normals = _texel_points(surface, rows, cols)
    albedo, height = _paint(surface, serial, points)

    # Bump mapping: tilt the normal by the slope of the painted height.
    along_v = np.gradient(height, axis=0) * surface.texels
    along_u = np.gradient(height, axis=1) * surface.texels
    if surface.kind in ("quad", "disc"):
        tangent_u = surface.edge_u / np.linalg.norm(surface.edge_u)
        tangent_v = surface.edge_v / np.linalg.norm(surface.edge_v)
    else:
        tangent_u = np.cross(normals, [0, 0, -1.0])
        tangent_u /= np.linalg.norm(tangent_u, axis=-1, keepdims=True) + 1e-9
        tangent_v = np.cross(tangent_u, normals)
        if surface.kind == "sphere":
            # Texels are narrower near the poles.
            narrow = np.sin((np.arange(rows) + 0.5) / rows * math.pi)[:, None]
            along_u = along_u / np.maximum(narrow, 0.05)
    bent = normals - along_u[..., None] * tangent_u - along_v[..., None] * tangent_v
    bent = bent / np.linalg.norm(bent, axis=-1, keepdims=True)
    facing = np.maximum(bent @ _SUN, 0).astype(np.float32)
    above = (0.62 + 0.38 * bent[..., 2]).astype(np.float32)

    sun, sky = (
        np.clip(cv2.resize(m, (cols, rows), interpolation=cv2.INTER_CUBIC), 0, 1)
        for m in _light(scene, surface)
    )
    light = (sun * facing)[..., None] * _SUN_COLOUR + (sky * above)[..., None] * _SKY_COLOUR
    level = cv2.GaussianBlur((albedo * light).astype(np.float32), (0, 0), 0.6)
    levels = [level]
    while min(level.shape[:2]) > 8:
        half = (math.ceil(level.shape[1] / 2), math.ceil(level.shape[0] / 2))
        level = cv2.resize(level, half, interpolation=cv2.INTER_AREA)
        levels.append(level)
    return _Texture(1 / surface.texels, levels)


# ---------------------------------------------------------------------------------------------
# Pictures


def _sample(texture: _Texture, u: FloatArray, v: FloatArray, spacing: FloatArray) -> FloatArray:
    """[n, 3] texture values with trilinear filtering for the samples' ``spacing`` in metres."""
    detail = np.log2(np.maximum(spacing / texture.metres, 1))
    detail = np.minimum(detail, len(texture.levels) - 1)
    result = np.zeros((len(u), 3), np.float32)
    for k in range(math.floor(detail.min()), math.ceil(detail.max()) + 1):
        weight = 1 - np.abs(detail - k)
        at = np.flatnonzero(weight > 0)
        if len(at) == 0:
            continue
        level = texture.levels[k]
        # cv2.remap accepts at most 32767 rows or columns: arrange the list as a table.
        sheet = np.zeros((2, math.ceil(len(at) / 1024), 1024), np.float32)
        sheet[0].ravel()[: len(at)] = u[at] * level.shape[1] - 0.5
        sheet[1].ravel()[: len(at)] = v[at] * level.shape[0] - 0.5
        values = cv2.remap(
            level, sheet[0], sheet[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        result[at] += weight[at, None] * values.reshape(-1, 3)[: len(at)]
    return result


def render_frame(scene: Scene, textures: list[_Texture], frame: int) -> NDArray[np.uint8]:
    """[height, width, 3] uint8 sRGB picture of a frame; each pixel averages several samples."""
    s = SUPERSAMPLE
    pose = scene.cam_from_world[frame]
    rotation = pose[:, :3]
    centre = -rotation.T @ pose[:, 3]
    xs = ((np.arange(scene.width * s) + 0.5) / s - scene.cx) / scene.fx
    ys = ((np.arange(scene.height * s) + 0.5) / s - scene.cy) / scene.fy
    shape = (len(ys), len(xs))
    depth = np.full(shape, np.inf, np.float32)
    seen = np.full(shape, 255, np.uint8)
    us, vs, slant = (np.zeros(shape, np.float32) for _ in range(3))
    length = np.sqrt(1 + xs[None] ** 2 + ys[:, None] ** 2).astype(np.float32)
    for serial, surface in enumerate(scene.surfaces):
        box = _bounds(scene, frame, surface)
        if box is None:
            continue
        flat = surface.kind in ("quad", "disc")
        x0, y0 = (s * math.floor(max(edge, 0)) for edge in box[:2])
        x1 = s * math.ceil(min(max(box[2], 0), scene.width))
        y1 = s * math.ceil(min(max(box[3], 0), scene.height))
        if x0 >= x1 or y0 >= y1:
            continue
        window = np.s_[y0:y1, x0:x1]

        def d_dot(e: FloatArray, rows: Any = np.s_[y0:y1], cols: Any = np.s_[x0:x1]) -> FloatArray:
            local = rotation @ e
            across = (local[0] * xs[cols] + local[2]).astype(np.float32)
            return np.asarray(across[None] + (local[1] * ys[rows]).astype(np.float32)[:, None])

        with np.errstate(divide="ignore", invalid="ignore"):
            t, u, v = _intersect(surface, lambda e: np.float32(centre @ e), d_dot)
        nearer = t < depth[window]
        for target, value in ((depth, t), (us, u), (vs, v)):
            np.copyto(target[window], value, where=nearer)
        if flat:
            cosine = np.abs(d_dot(surface.normal)) / length[window]
        else:
            # Angle of incidence on a round surface, from the distance of the ray from its axis.
            normal = [
                d_dot(a) * np.where(nearer, t, 0) + (centre - surface.origin) @ a for a in np.eye(3)
            ]
            dims = 3 if surface.kind == "sphere" else 2
            along = sum(normal[i] * d_dot(np.eye(3)[i]) for i in range(dims))
            cosine = np.abs(along) / (surface.radius * length[window])
        np.copyto(slant[window], cosine, where=nearer)
        np.copyto(seen[window], np.uint8(serial), where=nearer)
    if np.isinf(depth).any():
        raise RuntimeError(f"frame {frame} has rays that leave the scene: extend its walls")
    spacing = depth * length / (scene.fx * s * np.maximum(slant, 0.05))
    picture = np.empty((*shape, 3), np.float32)
    for serial in np.unique(seen):
        at = np.nonzero(seen == serial)
        picture[at] = _sample(textures[serial], us[at], vs[at], spacing[at])
    small = cv2.resize(picture, (scene.width, scene.height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(255 * _tone(small)).astype(np.uint8))


def _tone(linear: FloatArray) -> FloatArray:
    """Tone mapping of linear radiance to sRGB in [0, 1], without clipped highlights."""
    x = np.maximum(1.15 * linear, 0)
    x = x * (1 + x / 1.9**2) / (1 + x)
    x = np.minimum(x * 1.25, 1)
    return np.asarray(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055))


def paint(scene: Scene, first: int = 0) -> list[_Texture]:
    """Lit textures of the surfaces, starting with number ``first``."""
    return [_texture(scene, k) for k in range(first, len(scene.surfaces))]


def render(scene: Scene) -> Iterator[NDArray[np.uint8]]:
    """All frames in order, uint8 [height, width, 3] RGB."""
    textures = paint(scene)
    for frame in range(len(scene.cam_from_world)):
        yield render_frame(scene, textures, frame)


def encode(frames: Iterator[NDArray[np.uint8]], output: Path, crf: int = CRF) -> None:
    """Write RGB frames as AV1 in MP4 with ffmpeg's libaom.

    Raises:
        RuntimeError: ffmpeg failed; the message includes the last line that it printed.
    """
    executable = os.environ.get("IMAGEIO_FFMPEG_EXE")
    if not executable:
        # Only encoding needs this package, not importing the ground truth.
        import imageio_ffmpeg  # noqa: PLC0415

        executable = imageio_ffmpeg.get_ffmpeg_exe()
    colour = "bt709"
    command = [executable, "-hide_banner", "-loglevel", "error", "-y", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(FPS), "-i", "-"]
    command += ["-vf", f"scale=out_color_matrix={colour}:out_range=tv", "-pix_fmt", "yuv420p"]
    command += ["-colorspace", colour, "-color_primaries", colour, "-color_trc", colour]
    command += ["-c:v", "libaom-av1", "-usage", "realtime", "-cpu-used", "6"]
    command += ["-lag-in-frames", "0", "-row-mt", "1", "-crf", str(crf), "-b:v", "0", "-g", "9999"]
    command += ["-fflags", "+bitexact", "-flags:v", "+bitexact", "-movflags", "+faststart"]
    with subprocess.Popen(
        [*command, str(output)], stdin=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        if process.stdin is None or process.stderr is None:
            raise RuntimeError("ffmpeg was started without pipes")
        try:
            for frame in frames:
                process.stdin.write(frame.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg's message is reported below.
        message = process.stderr.read().decode(errors="replace").strip()
    if process.returncode != 0:
        raise RuntimeError(f"ffmpeg could not encode the clip: {message.splitlines()[-1:]}")


def write_truth(scene: Scene, path: Path) -> None:
    """Write poses, intrinsics and a coarse depth map of every frame.

    ``depth[k, j, i]`` is the depth of frame k along its z axis at (depth_x[i], depth_y[j]), in
    metres, rounded to float16. :func:`project` returns exact depths.
    """
    depth_x = np.arange(DEPTH_STEP / 2, scene.width, DEPTH_STEP)
    depth_y = np.arange(DEPTH_STEP / 2, scene.height, DEPTH_STEP)
    grid = np.stack(np.meshgrid(depth_x, depth_y), -1).reshape(-1, 2)
    frames = len(scene.cam_from_world)
    depth = np.stack([_cast(scene, k, grid) for k in range(frames)])
    np.savez_compressed(
        path,
        width=scene.width,
        height=scene.height,
        fps=FPS,
        fx=scene.fx,
        fy=scene.fy,
        cx=scene.cx,
        cy=scene.cy,
        cam_from_world=scene.cam_from_world,
        depth=depth.reshape(frames, len(depth_y), len(depth_x)).astype(np.float16),
        depth_x=depth_x,
        depth_y=depth_y,
    )


def main() -> int:
    """Write the clip and its ground truth."""
    here = Path(__file__).resolve().parent
    parser = argparse.ArgumentParser(description="Render the example clip and its ground truth.")
    parser.add_argument("--output", type=Path, default=here / "scene.mp4", help="the clip (AV1)")
    parser.add_argument(
        "--truth", type=Path, default=here / "scene_truth.npz", help="its ground truth"
    )
    options = parser.parse_args()
    scene = build_scene()
    write_truth(scene, options.truth)
    encode(render(scene), options.output)
    print(f"{options.output}: {options.output.stat().st_size / 1000:.0f} kB, {FRAMES} frames")
    print(f"{options.truth}: {options.truth.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
