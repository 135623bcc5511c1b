"""Try the first steps of COLMAP's incremental mapper with an initial pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.mapper_limits import InitialLimits
from colmap_av1.util.arrays import Floats
from colmap_av1.util.colmap_log import only_errors

# Intrinsics have diverged if the focal length changes by more than this factor, or a distortion
# parameter by more than this. The mapper itself permits a factor of ten and distortion parameters
# up to 1, but no further image registers with the points of such a pair.
_MAX_FOCAL_LENGTH_RATIO, _MAX_DISTORTION_CHANGE = 2.0, 0.5
# The mapper's RANSAC may accept a pair with some seeds only.
_NUM_SEEDS = 3


@dataclass(frozen=True)
class InitialPairTrial:
    """The model of an initial pair.

    Attributes:
        cam2_from_cam1: float64 [3, 4] pose of the second image.
        diverged: whether the intrinsics have diverged.
    """

    cam2_from_cam1: Floats
    diverged: bool


def try_initial_pair(
    xy: Sequence[NDArray[np.float32]],
    camera: pycolmap.Camera,
    limits: InitialLimits,
    *,
    refine_intrinsics: bool = True,
) -> InitialPairTrial | None:
    """Initialize a model from two images as COLMAP's incremental mapper does.

    The mapper estimates the relative pose, triangulates the matches, and refines focal length and
    distortion together with the pose and the points. RANSAC may find a wrong pose, and two images
    do not always determine all of the intrinsics. The mapper itself is run, see
    `initialize_reconstruction` of `pycolmap.IncrementalPipeline`.

    Args:
        xy: float32 [n, 2] pixel coordinates of the inliers in each image.
        camera: the camera of both images, with a known focal length.
        limits: the mapper's limits of the initial pair.
        refine_intrinsics: whether the mapper refines focal length and distortion.

    Returns:
        None if the mapper does not accept these images as an initial pair.
    """
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, extract_colors=False)
    options.init_image_id1, options.init_image_id2 = 1, 2
    options.ba_refine_focal_length = options.ba_refine_extra_params = refine_intrinsics
    # Here each track has two views. In the database, it usually has more.
    options.triangulation.ignore_two_view_tracks = False
    for name, value in vars(limits).items():
        setattr(options.mapper, name, value)
    with only_errors():
        cache = _database_cache(xy, camera)
        for seed in range(_NUM_SEEDS):
            options.random_seed = seed
            found = _begin(cache, options, camera)
            if found is not None:
                return found
    return None


def _begin(
    cache: pycolmap.DatabaseCache,
    options: pycolmap.IncrementalPipelineOptions,
    camera: pycolmap.Camera,
) -> InitialPairTrial | None:
    pipeline = pycolmap.IncrementalPipeline(options, cache, pycolmap.ReconstructionManager())
    mapper, model = pycolmap.IncrementalMapper(cache), pycolmap.Reconstruction()
    mapper.begin_reconstruction(model)
    status = pipeline.initialize_reconstruction(mapper, options.get_mapper(), model)
    found = None
    if status == pycolmap.IncrementalPipelineStatus.SUCCESS:
        first, second = (model.images[number].cam_from_world() for number in (1, 2))
        pose = np.asarray((second * first.inverse()).matrix())
        found = InitialPairTrial(pose, _has_diverged(model.cameras[1], camera))
    mapper.end_reconstruction(discard=True)
    return found


def _has_diverged(refined: pycolmap.Camera, camera: pycolmap.Camera) -> bool:
    ratio = refined.mean_focal_length() / camera.mean_focal_length()
    if not 1.0 / _MAX_FOCAL_LENGTH_RATIO <= ratio <= _MAX_FOCAL_LENGTH_RATIO:
        return True
    distortion = list(camera.extra_params_idxs())
    change = np.abs(refined.params - camera.params)[distortion]
    return bool(change.max(initial=0.0) > _MAX_DISTORTION_CHANGE)


def _database_cache(
    xy: Sequence[NDArray[np.float32]], camera: pycolmap.Camera
) -> pycolmap.DatabaseCache:
    """What the mapper reads from a database with two images."""
    own_camera = pycolmap.Camera({**camera.todict(), "camera_id": 1})
    matches = np.repeat(np.arange(len(xy[0]), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = pycolmap.TwoViewGeometry(
        config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=matches
    )
    with pycolmap.Database.open(":memory:") as database:
        database.write_camera(own_camera, use_camera_id=True)
        for number, own in enumerate(xy, start=1):
            image = pycolmap.Image(name=str(number), camera_id=1, image_id=number)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number, own)
        database.write_two_view_geometry(1, 2, geometry)
        return pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
