from __future__ import annotations

import cv2
import numpy as np
import pycolmap
from hypothesis import given
from hypothesis import strategies as st

from colmap_av1.geometry.undistortion import on_pinholes, pinhole_camera, undistortion


def test_undistorted_picture_matches_the_pinhole_camera() -> None:
    for k in (-0.12, 0.1):
        camera = pycolmap.Camera(
            camera_id=3, model="SIMPLE_RADIAL", width=320, height=240, params=[250, 160, 120, k]
        )
        pinhole = pinhole_camera(camera)
        assert (pinhole.model_name, pinhole.width, pinhole.height) == ("PINHOLE", 320, 240)
        undistort = undistortion(camera, pinhole)
        assert undistort is not None
        assert undistort(np.full((240, 320, 3), 200, np.uint8)).min() == 200
        at = np.array([[60.5, 50.5], [250.5, 180.5]], np.float32)
        picture = np.zeros((240, 320, 3), np.uint8)
        for x, y in at:
            cv2.circle(picture, (int(x), int(y)), 3, (255, 255, 255), -1)
        flat = undistort(picture)[..., 0].astype(float)
        rays = np.asarray(camera.cam_from_img(at.astype(np.float64)))
        for x, y in on_pinholes(rays, np.zeros(2, np.int64), [pinhole]):
            near = np.mgrid[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9]
            weight = flat[near[0], near[1]]
            centre = [(weight * (n + 0.5)).sum() / weight.sum() for n in near[::-1]]
            assert np.allclose(centre, [x, y], atol=0.3)
        # The field of view is maximal: some edge pixel comes from the edge of the source.
        wider = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=pinhole.params * 1)
        wider.params = [p * 0.98 for p in pinhole.params[:2]] + list(pinhole.params[2:])
        undistort_wider = undistortion(camera, wider)
        ramp = np.zeros((240, 320, 3), np.uint8)
        ramp[2:-2, 2:-2] = 255
        assert undistort_wider is not None
        assert undistort_wider(ramp).min() == 0
    plain = pycolmap.Camera(
        camera_id=3, model="SIMPLE_PINHOLE", width=320, height=240, params=[250, 160, 120]
    )
    assert undistortion(plain, pinhole_camera(plain)) is None
    assert list(pinhole_camera(plain).params) == [250, 250, 160, 120]


@given(st.lists(st.tuples(st.integers(0, 96), st.integers(0, 60)), max_size=1100))
def test_single_pixels_match_the_undistorted_picture(at: list[tuple[int, int]]) -> None:
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=97, height=61, params=[90, 48, 30, -0.1]
    )
    undistort = undistortion(camera, pinhole_camera(camera))
    assert undistort is not None
    assert undistort.size == (97, 61)
    picture = np.random.default_rng(0).integers(0, 256, (61, 97, 3), dtype=np.uint8)
    x, y = np.array(at, np.int64).reshape(-1, 2).T
    assert np.array_equal(undistort.pixels(picture, x, y), undistort(picture)[y, x])
