"""Copied constants of COLMAP agree with the installed pycolmap."""

from __future__ import annotations

import numpy as np  # noqa: F401 - before pycolmap
import pycolmap

from colmap_av1.matching import mapper_limits as limits
from colmap_av1.matching.two_view_geometry import TwoViewConfig, config_name


def test_limits_agree_with_colmap() -> None:
    incremental = pycolmap.IncrementalPipelineOptions()
    assert incremental.min_num_matches == limits.MIN_INLIERS
    assert pycolmap.GlobalPipelineOptions().min_num_matches == limits.MIN_INLIERS
    assert incremental.mapper.init_min_num_inliers == limits.INITIAL_MIN_INLIERS
    assert incremental.mapper.init_max_forward_motion == limits.INITIAL_MAX_FORWARD_MOTION
    assert incremental.mapper.init_min_tri_angle == limits.INITIAL_MIN_ANGLE
    assert incremental.mapper.abs_pose_min_num_inliers == limits.REGISTRATION_MIN_INLIERS
    assert incremental.mapper.filter_min_tri_angle == limits.POINT_MIN_ANGLE
    assert all(hasattr(incremental.mapper, name) for name in limits.FORWARD_MOTION.options)


def test_two_view_configurations_agree_with_colmap() -> None:
    colmaps = pycolmap.TwoViewGeometryConfiguration.__members__
    ours = {config.name: config.value for config in TwoViewConfig}
    assert ours == {name: int(member.value) for name, member in colmaps.items()}
    assert config_name(colmaps["CALIBRATED_RIG"].value) == "CALIBRATED_RIG"
    assert config_name(12) == "12"
