from __future__ import annotations

import copy

import numpy as np
import pycolmap
import pytest
from dense_points import depth_differences
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.evaluate.metrics.clouds import cloud_distances
from colmap_av1.evaluate.metrics.poses import fit_similarity, image_poses, pose_errors
from colmap_av1.geometry.alignment import transform_poses
from colmap_av1.geometry.colmap_model import point_positions


def test_distances_of_known_clouds() -> None:
    reference = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    points = np.array([[0.0, 0.1, 0], [1, 0.3, 0]])
    distances = cloud_distances(points, reference)
    assert distances is not None
    assert distances.accuracy == pytest.approx(0.2)
    far = [0.1, 0.3, np.hypot(1, 0.3), np.hypot(2, 0.3)]
    assert distances.completeness == pytest.approx(np.mean(far))
    assert distances.chamfer == pytest.approx((0.2 + np.mean(far)) / 2)
    assert distances.hausdorff == pytest.approx(far[-1])
    assert distances.mean_hausdorff == pytest.approx((0.3 + far[-1]) / 2)
    assert distances.robust_hausdorff < distances.hausdorff
    assert distances.extent == pytest.approx(0.9 * 3)


def test_stray_point_only_changes_the_hausdorff_distance() -> None:
    cloud = np.random.default_rng(0).random((2000, 3))
    stray = np.concatenate([cloud, [[50.0, 0, 0]]])
    distances = cloud_distances(stray, cloud)
    assert distances is not None
    assert distances.hausdorff > 49
    assert distances.robust_hausdorff == 0
    assert distances.completeness == 0


def test_depths_are_compared_with_neighbouring_points() -> None:
    options = pycolmap.SyntheticDatasetOptions(num_frames_per_rig=6, num_points3D=400)
    pycolmap.set_random_seed(0)
    truth = pycolmap.synthesize_dataset(options)
    assert np.nanmax(depth_differences(truth, truth)) < 1e-9
    # Each point is moved away from the camera in the middle of its track by 3 % of its depth.
    moved = copy.deepcopy(truth)
    for point in moved.points3D.values():
        ids = sorted(e.image_id for e in point.track.elements)
        centre = moved.images[ids[len(ids) // 2]].projection_center()
        point.xyz = centre + 1.03 * (point.xyz - centre)
    # The nearest neighbour of a point in the image is sometimes a different point.
    assert np.nanmedian(depth_differences(moved, truth, pixels=0.5)) == pytest.approx(0.03)
    far = copy.deepcopy(truth)
    for point in far.points3D.values():
        point.xyz = point.xyz + np.array([0, 0, 1000.0])
    assert np.isnan(depth_differences(far, truth, pixels=1e-6)).all()


def test_empty_clouds_have_no_distance() -> None:
    assert cloud_distances(np.empty((0, 3)), np.ones((1, 3))) is None


def test_models_are_aligned_by_their_cameras() -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 100
    model = pycolmap.synthesize_dataset(options)
    moved = copy.deepcopy(model)
    turn = pycolmap.Rotation3d(np.array([0.1, -0.3, 0.2, 0.9]) / np.sqrt(0.95))
    moved.transform(pycolmap.Sim3d(2.5, turn, np.array([3.0, -1, 7])))
    assert np.abs(point_positions(moved) - point_positions(model)).max() > 1
    names = sorted(image.name for image in model.images.values())
    poses = image_poses(model, [*names, "not there"])
    assert np.isnan(poses[-1]).all()
    similarity = fit_similarity(image_poses(moved, names), poses[:-1])
    assert similarity is not None
    np.testing.assert_allclose(
        similarity * point_positions(moved), point_positions(model), atol=1e-6
    )
    np.testing.assert_allclose(
        transform_poses(similarity, image_poses(moved, names)), poses[:-1], atol=1e-6
    )
    assert fit_similarity(np.full_like(poses, np.nan), poses) is None


def test_poses_in_a_plane_are_aligned_and_those_on_a_line_are_not() -> None:
    rng = np.random.default_rng(0)
    centres = np.column_stack([rng.normal(size=(9, 2)), np.zeros(9)])
    rotations = Rotation.random(9, rng).as_matrix()

    def poses(centres: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([rotations, -rotations @ centres[:, :, None]], axis=2)

    truth = poses(centres)
    moved = pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.5, 0.5, 0.5, 0.5])), [1, 2, 3])
    estimated = transform_poses(moved.inverse(), truth)
    errors = pose_errors(estimated, truth)
    assert errors is not None
    assert errors.ate == pytest.approx(0, abs=1e-9)
    assert errors.robust_rms == pytest.approx(0, abs=1e-9)
    similarity = fit_similarity(estimated, truth)
    assert similarity is not None
    np.testing.assert_allclose(similarity.matrix(), moved.matrix(), atol=1e-9)
    on_line = poses(np.outer(np.arange(9.0), [1.0, 2.0, 3.0]))
    assert fit_similarity(on_line, truth) is None
    assert pose_errors(truth, on_line) is None


def test_reference_without_extent_gives_no_distances() -> None:
    assert cloud_distances(np.random.default_rng(0).random((5, 3)), np.ones((1, 3))) is None
