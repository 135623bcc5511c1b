"""Rendering a furnished room with any camera model and a pose for each row.

It serves to test fisheye lenses and rolling shutters. The renderer casts rays at axis-aligned boxes
with seeded textures. It is simpler than `examples/render_scene.py`, but a frame of 480x360 takes
only a third of a second, and each ray may have a different origin. The world is in metres, z up;
cameras look along +z with x right and y down, and the image's top-left corner is (0, 0).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_TEXELS = 512  # Size of a texture, which repeats every _PERIOD metres.
_PERIOD = 4.0
_SEED = 5
# The inside of the room, and the furniture: smallest and largest corners in metres.
ROOM = np.array([[-5.0, -4.0, 0.0], [5.0, 6.0, 3.4]])
BOXES = np.array(
    [
        [[-2.6, 2.4, 0.0], [-1.4, 3.6, 1.5]],
        [[0.2, 3.2, 0.0], [1.6, 4.2, 0.9]],
        [[2.4, 1.8, 0.0], [3.2, 2.8, 2.2]],
        [[-0.7, 4.6, 0.0], [-0.2, 5.2, 2.6]],
        [[-4.2, 4.0, 0.0], [-3.0, 5.4, 2.0]],
        [[1.2, 2.0, 0.0], [1.7, 2.5, 0.6]],
    ]
)


def rays_of(camera: pycolmap.Camera, samples: int = 2) -> Floats:
    """Rays of a camera's pixels, float64 [height, width, samples**2, 3] with z = 1."""
    s = samples
    x, y = (np.arange(n * s) + 0.5 for n in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(x / s, y / s), -1).reshape(-1, 2)
    flat = np.asarray(camera.cam_from_img(grid)).reshape(camera.height, s, camera.width, s, 2)
    flat = flat.transpose(0, 2, 1, 3, 4).reshape(camera.height, camera.width, s * s, 2)
    return np.concatenate([flat, np.ones((*flat.shape[:3], 1))], axis=3)


def render(
    rays: Floats,
    cam_from_world: Floats,
    textures: NDArray[np.float32],
    *,
    walls: Floats = ROOM,
    boxes: Floats = BOXES,
) -> Any:
    """A picture, uint8 [height, width, 3].

    Args:
        rays: rays from `rays_of`.
        cam_from_world: float64 [height, 3, 4] pose of each row.
        textures: textures from `make_textures`: for the faces perpendicular to x, y and z, of the
            room and then of each box; repeated if there are fewer.
        walls: float64 [2, 3] smallest and largest corner of the room.
        boxes: float64 [n, 2, 3] smallest and largest corners of the boxes in it.
    """
    rotation = cam_from_world[:, :, :3]
    origin = -np.einsum("nij,ni->nj", rotation, cam_from_world[:, :, 3])
    # Coordinates come first, because NumPy reduces a short last axis slowly.
    direction = np.einsum("nij,nwsi->jnws", rotation, rays).astype(np.float32, order="C")
    start = origin.T[:, :, None, None].astype(np.float32)
    with np.errstate(divide="ignore"):
        step = 1 / direction
    best, face = _leave(start, step, walls)
    for number, box in enumerate(boxes.astype(np.float32)):
        near, axis = _enter(start, step, box)
        closer = near < best
        best = np.where(closer, near, best)
        face = np.where(closer, 3 * (number + 1) + axis, face)
    hit = start + best * direction
    axis, texture = face % 3, face % len(textures)
    u = np.where(axis == 0, hit[1], hit[0])
    v = np.where(axis == 2, hit[1], hit[2])
    columns, rows = (w % _PERIOD * (_TEXELS / _PERIOD) for w in (u, v))
    rows += texture * (_TEXELS + 1)
    shape = (best.shape[0], -1)
    seen = cv2.remap(
        textures.reshape(-1, _TEXELS + 1, 3),
        columns.reshape(shape).astype(np.float32),
        rows.reshape(shape).astype(np.float32),
        cv2.INTER_LINEAR,
    )
    picture = seen.reshape(*best.shape, 3).mean(axis=2)
    return np.clip(picture.round(), 0, 255).astype(np.uint8)


def make_textures(count: int = 6) -> NDArray[np.float32]:
    """Seamless textures with several scales, float32 [count, _TEXELS + 1, _TEXELS + 1, 3].

    The first row and column of each are repeated at its end, for interpolation.
    """
    rng = np.random.default_rng(_SEED)
    made = []
    for _ in range(count):
        total = np.zeros((_TEXELS, _TEXELS, 3), np.float32)
        for size, share in ((8, 1.0), (32, 0.9), (96, 0.8), (256, 0.5)):
            noise = rng.normal(0, 1, (size, size, 3)).astype(np.float32)
            wrapped = np.pad(noise, ((2, 2), (2, 2), (0, 0)), mode="wrap")
            scale = _TEXELS / size
            large = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
            edge = round(2 * scale)
            total += share * large[edge : edge + _TEXELS, edge : edge + _TEXELS]
        grey = total.mean(axis=2, keepdims=True)
        texture = 128 + 38 * (grey + 0.3 * (total - grey))
        made.append(np.pad(texture, ((0, 1), (0, 1), (0, 0)), mode="wrap"))
    return np.stack(made)


def _leave(start: Any, step: Any, walls: Floats) -> tuple[Any, Any]:
    """Intersections of rays with the room's walls, from inside: ray parameter and axis."""
    low, high = walls.astype(np.float32)[:, :, None, None, None]
    far = np.maximum((low - start) * step, (high - start) * step)
    return far.min(axis=0), far.argmin(axis=0)


def _enter(start: Any, step: Any, box: Any) -> tuple[Any, Any]:
    """Intersections of rays with a box: ray parameter, infinite for a miss, and axis."""
    low, high = box[:, :, None, None, None]
    one, two = (low - start) * step, (high - start) * step
    near, far = np.minimum(one, two), np.maximum(one, two)
    first, last = near.max(axis=0), far.min(axis=0)
    met = (first < last) & (first > 0)
    return np.where(met, first, np.inf), near.argmax(axis=0)


def look(centre: Floats, target: Floats) -> Floats:
    """Poses [n, 3, 4] of upright cameras at centres [n, 3] that look at targets [n, 3]."""
    z = target - centre
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return np.concatenate([rotation, -np.einsum("nij,nj->ni", rotation, centre)[..., None]], 2)
