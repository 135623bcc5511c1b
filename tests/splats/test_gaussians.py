from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_av1.errors import OptionError, WriteError
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.splats.gaussians import (
    Gaussians,
    check_gaussians_path,
    initial_gaussians,
    write_gaussians,
)

FOCAL = 400.0
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=640, height=360, params=[FOCAL, FOCAL, 320, 180]
)
STEP = 0.05  # between points of a surface


def views(step: float, count: int = 8) -> list[PosedCamera]:
    """A camera that moves to the right in equal steps."""
    poses = [np.column_stack([np.eye(3), [-step * i, 0, 0]]) for i in range(count)]
    return [PosedCamera(CAMERA, pose) for pose in poses]


def seen(xyz: np.ndarray, images: list[PosedCamera], error: np.ndarray) -> ModelPoints:
    """A cloud whose points are observed by all images."""
    n, m = len(xyz), len(images)
    offsets = np.arange(n + 1) * m
    rgb = np.tile(np.array([200, 100, 50], np.uint8), (n, 1))
    xy = np.zeros((n * m, 2))
    return ModelPoints(xyz, rgb, error, offsets, np.tile(np.arange(m), n), xy)


def slope(depth: float, tilt: float = 0.5) -> np.ndarray:
    """Evenly spaced points of a plane with normal (-tilt, 0, 1)."""
    x, y = np.meshgrid(np.arange(-20, 21) * STEP, np.arange(-15, 16) * STEP)
    return np.column_stack([x.ravel(), y.ravel(), depth + tilt * x.ravel()])


def turned(gaussians: Gaussians) -> np.ndarray:
    """The quaternions as rotation matrices."""
    w, x, y, z = gaussians.rotation.T
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def test_gaussians_are_discs_on_the_surface() -> None:
    """Their radius is half the distance of neighbours; they are thin where depth is certain."""
    images = views(0.5)
    xyz = slope(5.0)
    made = initial_gaussians(seen(xyz, images, np.full(len(xyz), 0.0)), images)
    normal = np.array([-0.5, 0, 1]) / np.sqrt(1.25)
    inner = (np.abs(xyz[:, 0]) < 0.9) & (np.abs(xyz[:, 1]) < 0.7)
    assert np.abs(made.normal[inner] @ normal).min() > 0.999
    axes = turned(made)
    assert np.allclose(axes @ axes.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(axes), 1)
    assert np.allclose(axes[:, :, 2], made.normal)
    across = made.scale[inner, 0]
    assert np.array_equal(across, made.scale[inner, 1])
    assert (np.abs(across / (0.5 * STEP) - 1) < 0.3).all()
    assert (made.scale[inner, 2] < 0.45 * across).all()


def test_gaussians_are_thicker_at_unknown_depth_and_larger_far_away() -> None:
    images = views(0.5)
    near, far = slope(5.0, 0.0), 4 * slope(5.0, 0.0)
    error = np.concatenate([np.full(len(near), -1.0), np.full(len(far), 3.0)])
    made = initial_gaussians(seen(np.concatenate([near, far]), images, error), images)
    assert np.allclose(made.scale[:, 2], 0.5 * made.scale[:, 0])
    ratio = np.median(made.scale[len(near) :, 0]) / np.median(made.scale[: len(near), 0])
    assert 3.5 < ratio < 4.5


def test_degenerate_points_get_finite_scales() -> None:
    images = views(0.1)
    behind = np.array([0.0, 0, -5])
    for xyz in ([[0.0, 0, 5]] * 3 + [behind], [[0.0, 0, 5]], [behind] * 2):
        points = np.array(xyz, dtype=np.float64).reshape(-1, 3)
        made = initial_gaussians(seen(points, images, np.zeros(len(points))), images)
        assert np.isfinite(made.scale).all()
        assert (made.scale > 0).all()
        assert np.isfinite(made.rotation).all()


def test_ply_layout_matches_the_reference_implementation(tmp_path: Path) -> None:
    images = views(0.5)
    xyz = slope(5.0)
    made = initial_gaussians(seen(xyz, images, np.zeros(len(xyz))), images)
    path = tmp_path / "below" / "init.ply"
    write_gaussians(path, made)
    assert [p.name for p in path.parent.iterdir()] == ["init.ply"]
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2].startswith("comment ")
    assert lines[3] == f"element vertex {len(xyz)}"
    names = [line.split()[2] for line in lines[4:] if line]
    assert all(line.startswith("property float ") for line in lines[4:] if line)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    # The reference implementation requires exactly this number.
    rest = [name for name in names if name.startswith("f_rest_")]
    assert rest == [f"f_rest_{i}" for i in range(3 * (3 + 1) ** 2 - 3)]
    assert names[54:] == [
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    table = np.frombuffer(body, "<f4").reshape(len(xyz), len(names))
    assert np.allclose(table[:, :3], xyz)
    assert np.allclose(table[:, 6:9] * 0.28209479177387814 + 0.5, made.rgb / 255, atol=1e-6)
    assert (table[:, 9:54] == 0).all()
    assert np.allclose(1 / (1 + np.exp(-table[:, 54])), made.opacity)
    assert np.allclose(np.exp(table[:, 55:58]), made.scale)
    assert np.allclose(table[:, 58:], made.rotation, atol=1e-6)


def test_unusable_output_paths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"init\.txt"):
        check_gaussians_path(tmp_path / "init.txt", [])
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OptionError, match="not a file"):
        check_gaussians_path(tmp_path / "folder.ply", [])
    (tmp_path / "file").touch()
    with pytest.raises(OptionError, match="cannot be created"):
        check_gaussians_path(tmp_path / "file" / "init.ply", [])
    empty = Gaussians(*(np.empty((0, k)) for k in (3, 3, 3, 4)), np.empty(0), np.empty((0, 3)))
    with pytest.raises(WriteError, match="cannot be written"):
        write_gaussians(tmp_path / "file" / "init.ply", empty)
    assert {p.name for p in tmp_path.iterdir()} == {"folder.ply", "file"}
    made = tmp_path / "made.ply"
    write_gaussians(made, empty)
    check_gaussians_path(made, [], overwrite=True)
    with pytest.raises(OptionError, match="--overwrite"):
        check_gaussians_path(made, [])
    with pytest.raises(OptionError, match="input"):
        check_gaussians_path(made, [made], overwrite=True)
