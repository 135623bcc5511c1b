"""Slopes of surfaces, estimated from neighbouring points in the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_av1.poses.corners.slopes import surface_slopes

slope = st.floats(-0.006, 0.006)


def inverse_depth(xy: np.ndarray, x: float, y: float) -> np.ndarray:
    """Inverse depth of a plane: 1/5 at (100, 100), with a relative change of (x, y) per pixel."""
    return 0.2 * (1 + (xy - 100.0) @ [x, y])


@given(x=slope, y=slope, seed=st.integers(0, 1000))
@settings(deadline=None)
def test_slopes_of_a_plane_are_exact(x: float, y: float, seed: int) -> None:
    around = np.random.default_rng(seed).uniform(60, 140, (60, 2))
    xy = np.array([[100.0, 100.0]])
    found = surface_slopes(xy, np.array([5.0]), around, 1 / inverse_depth(around, x, y))
    assert found[0] == pytest.approx([x, y], abs=1e-6)


def test_another_surface_nearby_has_little_effect() -> None:
    around = np.random.default_rng(3).uniform(70, 130, (80, 2))
    depth = 1 / inverse_depth(around, 0.004, -0.002)
    depth[around[:, 0] > 108] = 2.0
    found = surface_slopes(np.array([[100.0, 100.0]]), np.array([5.0]), around, depth)
    assert found[0] == pytest.approx([0.004, -0.002], abs=4e-4)


def test_surfaces_without_a_plane_get_no_slope() -> None:
    rng = np.random.default_rng(5)
    around = rng.uniform(70, 130, (40, 2))
    xy, depth = np.array([[100.0, 100.0]]), np.array([5.0])
    assert (surface_slopes(xy, depth, around, rng.uniform(1, 30, 40)) == 0).all()
    # Too few neighbours, too far away, only the point itself, none at all.
    plane = 1 / inverse_depth(around, 0.004, 0.0)
    assert (surface_slopes(xy, depth, around[:3], plane[:3]) == 0).all()
    assert (surface_slopes(xy, depth, around + 500, plane) == 0).all()
    assert (surface_slopes(xy, depth, xy, depth) == 0).all()
    assert (surface_slopes(xy, depth, np.empty((0, 2)), np.empty(0)) == 0).all()
    assert surface_slopes(np.empty((0, 2)), np.empty(0), around, plane).shape == (0, 2)


def test_very_steep_surfaces_get_no_slope() -> None:
    around = np.random.default_rng(7).uniform(85, 115, (60, 2))
    steep = 1 / inverse_depth(around, 0.03, 0.0)
    found = surface_slopes(np.array([[100.0, 100.0]]), np.array([5.0]), around, steep)
    assert (found == 0).all()
