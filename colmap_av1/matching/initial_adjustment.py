"""Find pairs with which COLMAP's incremental mapper should not begin a model."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.mapper_limits import (
    FORWARD_MOTION_OPTIONS,
    INITIAL_MAX_FORWARD_MOTION,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
    INITIAL_MIN_POINTS,
    MIN_INLIERS,
)
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewGeometry

_Floats = NDArray[np.float64]

# The mapper looks for an initial pair among the images with the most matches, one image per core at
# a time, and takes the first it finds; if it finds none, it goes on to the other images. Here, at
# least the first number of images and at most the second are tried.
_NUM_FIRST_IMAGES, _MAX_IMAGES = 16, 100
# The mapper estimates a pair's pose anew by RANSAC: fewest trials, and largest error in pixels.
_NUM_TRIALS, _MAX_ERROR = 30, 4.0
# Neighbours are at most this many images apart.
_NEIGHBOURS = 2
# Estimates of each pair's pose, with different seeds.
_NUM_SEEDS = 2
# The mapper may accept or reject a pair this close to its limits at random: a factor of the inliers
# and the angle, and a difference in forward motion.
_MARGIN, _FORWARD_MARGIN = 1.1, 0.02
# A quick test with about this many inliers rejects pairs below this share of the angle.
_NUM_QUICK = 64
_QUICK_SHARE = 0.5
# A pair with a wrong pose may begin a model if it has this share of the angle.
_WIDE_SHARE = 0.75
# Rotations differ if the angle between them exceeds this share of the triangulation angle: from a
# known rotation, and between two estimates of the same pair.
_WRONG, _SAME = 0.25, 0.05
# Intrinsics diverge if a focal length changes by more than this factor, or a distortion parameter
# by more than this difference. The mapper registers no images once distortion exceeds 1.
_MAX_FOCAL_FACTOR, _MAX_DISTORTION_CHANGE = 2.0, 0.5
# The mapper's limits: focal lengths in units of the longer image side, distortion
# (min_focal_length_ratio, max_focal_length_ratio, max_extra_param).
_MAPPER_LIMITS = 0.1, 10.0, 1.0
# About this many points are adjusted.
_NUM_ADJUSTED = 200
# The mapper adjusts few images up to five times, with 100 iterations and this gradient tolerance.
# Some intrinsics diverge slowly.
_NUM_ITERATIONS, _GRADIENT_TOLERANCE = 500, 0.1


@dataclass(frozen=True)
class _Limits:
    """The mapper's limits for an initial pair.

    Attributes:
        min_inliers: fewest inliers.
        min_angle: smallest triangulation angle in degrees.
        max_forward_motion: largest share of the translation along the optical axis.
    """

    min_inliers: int
    min_angle: float
    max_forward_motion: float

    def allow(self, pose: _Floats, angle: float, margin: float) -> bool:
        """Whether a pose meets the limits of angle and forward motion, within a margin."""
        forward_margin = _FORWARD_MARGIN if margin < 1 else -_FORWARD_MARGIN
        is_aside = abs(pose[2, 3]) <= self.max_forward_motion + forward_margin
        return bool(is_aside and angle >= margin * self.min_angle)


def _limits(min_angle: float, max_forward_motion: float) -> tuple[_Limits, ...]:
    """The mapper's limits; the next ones are tried if no pair meets the first ones."""
    first = _Limits(INITIAL_MIN_INLIERS, min_angle, max_forward_motion)
    fewer = replace(first, min_inliers=first.min_inliers // 2)
    return first, fewer, replace(fewer, min_angle=fewer.min_angle / 2)


_DEFAULT_LIMITS = _limits(INITIAL_MIN_ANGLE, INITIAL_MAX_FORWARD_MOTION)
# The printed init_max_forward_motion excludes no pair.
_FORWARD_LIMITS = _limits(FORWARD_MOTION_OPTIONS["init_min_tri_angle"], math.inf)


@dataclass(frozen=True)
class PairInliers:
    """The inliers of a pair.

    Attributes:
        cameras: the cameras of the first and the second image.
        xy: float64 [n, 2] of each image, in pixels.
        x: float64 [2, n] of each image, normalised undistorted coordinates.
    """

    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    xy: tuple[_Floats, _Floats]
    x: tuple[_Floats, _Floats]

    @property
    def rays(self) -> list[_Floats]:
        """Unit vectors to the inliers, float64 [3, n] of each image."""
        rays = [np.vstack([own, np.ones(own.shape[1])]) for own in self.x]
        return [own / np.linalg.norm(own, axis=0) for own in rays]


def inliers_of(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
) -> PairInliers:
    """The inliers of a pair that have a ray in front of both cameras."""
    a, b = (
        matched.keypoints[image].xy[chosen].astype(np.float64)
        for image, chosen in zip(pair, geometry.inlier_matches.T, strict=True)
    )
    return _in_front((cameras[pair[0]], cameras[pair[1]]), (a, b))


def _in_front(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera], xy: tuple[_Floats, _Floats]
) -> PairInliers:
    """Select the matches that have a ray in front of both cameras."""
    a, b = (
        np.asarray(camera.cam_from_img(own), dtype=np.float64)
        for camera, own in zip(cameras, xy, strict=True)
    )
    # Some pixels of a wide lens have no such ray.
    known = np.isfinite(a + b).all(axis=1)
    return PairInliers(cameras, (xy[0][known], xy[1][known]), (a[known].T, b[known].T))


def pose_of_homography(H: _Floats, inliers: PairInliers) -> _Floats:
    """Decompose a homography into a pose as COLMAP's mapper does, float64 [3, 4]."""
    matrices = [camera.calibration_matrix() for camera in inliers.cameras]
    found = pycolmap.pose_from_homography_matrix(H, *matrices, *(own.T for own in inliers.rays))
    return np.asarray(found["cam2_from_cam1"].matrix())


def pose_of_essential(E: _Floats, inliers: PairInliers) -> _Floats:
    """Decompose an essential matrix into the pose with the most points in front of both cameras.

    Returns float64 [3, 4].
    """
    a, b = (np.ascontiguousarray(own.T) for own in inliers.x)
    _, rotation, translation, _ = cv2.recoverPose(E, a, b, np.eye(3))
    return np.column_stack([rotation, translation])


def triangulation_angle(rotation: _Floats, rays: Sequence[_Floats]) -> float:
    """Median triangulation angle of matches in degrees, given the rotation to the second camera."""
    cosine = ((rotation @ rays[0]) * rays[1]).sum(axis=0)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _angle_between(rotation: _Floats, other: _Floats) -> float:
    """The angle between two rotations in degrees."""
    cosine = (np.trace(rotation @ other.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True)
class KnownPoses:
    """Known poses, which the poses of pairs are compared with.

    Attributes:
        models: for each model, float64 [3, 4] cam_from_world of each image, None if it is not in
            the model. The relative pose of images in different models is not known.
        are_comparable: whether to compare the poses of pairs with these. The poses of pairs are
            wrong if a focal length is a guess.
    """

    models: Sequence[Sequence[_Floats | None]] = ()
    are_comparable: bool = False

    def rotation(self, pair: Sequence[int]) -> _Floats | None:
        """The rotation from the first camera of a pair to the second; None if not known."""
        for cam_from_world in self.models if self.are_comparable else ():
            first, second = (cam_from_world[image] for image in pair)
            if first is not None and second is not None:
                return np.asarray(second[:, :3] @ first[:, :3].T)
        return None

    def in_first(self, pair: Sequence[int]) -> bool:
        """Whether a pair belongs to the first model, or no model is known."""
        return not self.models or all(self.models[0][image] is not None for image in pair)

    def contradict(self, pair: Sequence[int], rotation: _Floats, angle: float) -> bool:
        """Whether a pair's rotation is off by a large share of its triangulation angle."""
        known = self.rotation(pair)
        return known is not None and _angle_between(rotation, known) > _WRONG * angle

    def misleading_pairs(
        self, matched: MatchedImages, cameras: Sequence[pycolmap.Camera]
    ) -> dict[int, float]:
        """Find pairs with a wrong pose.

        Args:
            matched: the images.
            cameras: the camera of each image.

        Returns:
            The triangulation angle in degrees of these pairs, by index, according to their pose.
        """
        found = {}
        for k, (pair, geometry) in enumerate(
            zip(matched.pairs.tolist(), matched.geometries, strict=True)
        ):
            if len(geometry.inlier_matches) < INITIAL_MIN_INLIERS // 2:
                continue
            if self.rotation(pair) is None:
                continue
            some = _some_inliers(matched, cameras, pair, geometry)
            pose = _pose(geometry, some)
            if pose is None:
                continue
            angle = triangulation_angle(pose[:, :3], some.rays)
            if self.contradict(pair, pose[:, :3], angle):
                found[k] = angle
        return found


def bad_initial_pairs(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    known: KnownPoses,
    misleading: Mapping[int, float],
) -> list[int]:
    """Find initial pairs with a wrong pose, or with intrinsics that diverge in an adjustment.

    If the camera moves along its axis, they are bad with the mapper's default limits or with those
    that `match` prints: users may leave the options out.

    The mapper first adjusts focal length and distortion to two images alone. If their matches do
    not determine these, the values may end anywhere: no third image registers, and the mapper
    writes the two images as its first model. Pairs are tried in the mapper's order, for each image
    up to the first pair that the mapper certainly accepts and that is stable. If there is no such
    pair, they are tried again with the mapper's lower limits.

    Trainers open the model that the mapper writes first, so it should begin with the first known
    model. If that has no pair that meets the mapper's first limits, pairs of other models with few
    inliers are bad. Their pairs with many inliers are not, so the mapper may still begin with them.

    Args:
        matched: the images.
        cameras: the camera of each image.
        known: known poses, which the pose of a pair must not contradict.
        misleading: triangulation angle in degrees of pairs whose pose is wrong, by index.

    Returns:
        Indices of pairs. Pairs that diverge are not among them if no poses are comparable and no
        tried pair is stable, as no other pair would then be a better start. If poses are comparable
        and no pair meets the mapper's first limits, all pairs with few inliers are among them,
        except those of the first model that are certainly stable.
    """
    bad = _bad_pairs(matched, cameras, known, misleading, every=_DEFAULT_LIMITS)
    if matched.forward_motion:
        bad |= _bad_pairs(matched, cameras, known, misleading, every=_FORWARD_LIMITS)
    return sorted(bad)


def _bad_pairs(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    known: KnownPoses,
    misleading: Mapping[int, float],
    *,
    every: Sequence[_Limits],
) -> set[int]:
    """The bad pairs for a mapper with the given limits, see `bad_initial_pairs`."""
    counts = np.array([len(own.inlier_matches) for own in matched.geometries], dtype=np.intp)
    bad, sure = set[int](), set[int]()
    for limits in every:
        # Pairs that the mapper rejects keep their inliers, however wrong their pose is.
        bad |= {
            k
            for k, angle in misleading.items()
            if counts[k] >= limits.min_inliers and angle >= _WIDE_SHARE * limits.min_angle
        }
        starts = _starts(matched, cameras, known, limits=limits, left_out=bad)
        if known.are_comparable or any(start.is_stable for start in starts.values()):
            bad |= {k for k, start in starts.items() if not start.is_stable}
        sure = {
            k
            for k, start in starts.items()
            if start.is_sure and known.in_first(matched.pairs[k].tolist())
        }
        if sure:
            break
    if known.are_comparable and limits != every[0]:
        # The mapper tries hundreds of pairs with few inliers, and RANSAC may give any of them a
        # wrong pose with a large angle. Neighbours keep their inliers, which connect them.
        apart = np.diff(matched.pairs.reshape(-1, 2), axis=1)[:, 0] > _NEIGHBOURS
        few = (counts >= INITIAL_MIN_INLIERS // 2) & (counts < INITIAL_MIN_INLIERS)
        bad |= set(np.flatnonzero(apart & few).tolist()) - sure
    return bad


def _starts(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    known: KnownPoses,
    *,
    limits: _Limits,
    left_out: Container[int],
) -> dict[int, _Start]:
    """Begin models with pairs in the mapper's order, until it would certainly have begun one.

    Returns:
        The pairs that the mapper may accept, by index.
    """
    starts: dict[int, _Start | None] = {}
    is_sure = False
    for num_looked, of_image in enumerate(_in_order(matched, cameras, limits.min_inliers)):
        if num_looked >= _NUM_FIRST_IMAGES and is_sure:
            break
        for k in of_image:
            if k in left_out:
                continue
            if k not in starts:
                pair, geometry = matched.pairs[k].tolist(), matched.geometries[k]
                starts[k] = _try_start(matched, cameras, pair, geometry, known, limits=limits)
            start = starts[k]
            if start is not None and start.is_sure:
                is_sure |= known.in_first(matched.pairs[k].tolist())
                break
    return {k: start for k, start in starts.items() if start is not None}


def _in_order(
    matched: MatchedImages, cameras: Sequence[pycolmap.Camera], min_inliers: int
) -> Iterator[list[int]]:
    """Yield the pairs of each image in the order in which the mapper tries images and pairs."""
    counts = np.array([len(own.inlier_matches) for own in matched.geometries], dtype=np.intp)
    used = np.where(counts >= MIN_INLIERS, counts, 0)
    pairs = matched.pairs.reshape(-1, 2)
    totals = np.zeros(len(cameras), dtype=np.intp)
    for side in pairs.T:
        np.add.at(totals, side, used)
    known = np.array([camera.has_prior_focal_length for camera in cameras], dtype=bool)
    for image in np.lexsort((-totals, ~known))[:_MAX_IMAGES]:
        own = np.flatnonzero((pairs == image).any(axis=1) & (counts >= min_inliers))
        yield own[np.argsort(-counts[own], kind="stable")].tolist()


@dataclass(frozen=True)
class _Start:
    """A pair with which the mapper may begin.

    Attributes:
        is_stable: bundle adjustment keeps the intrinsics near their initial values.
        is_certain: the mapper accepts the pair with any seed.
    """

    is_stable: bool
    is_certain: bool

    @property
    def is_sure(self) -> bool:
        """Whether the mapper accepts the pair with any seed, and its model does not diverge."""
        return self.is_stable and self.is_certain


def _try_start(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
    known: KnownPoses,
    *,
    limits: _Limits,
) -> _Start | None:
    """Begin a model with a pair as the mapper does; None if the mapper rejects the pair."""
    some = _some_inliers(matched, cameras, pair, geometry)
    pose = _pose(geometry, some)
    if pose is None:
        return None
    angle = triangulation_angle(pose[:, :3], some.rays)
    if not limits.allow(pose, angle, _QUICK_SHARE):
        return None
    inliers = inliers_of(matched, cameras, pair, geometry)
    rotations, certain = list[_Floats](), list[bool]()
    for rows, pose, angle in _poses(inliers):
        # A pose just below the limits is tried, too: with another seed the mapper may accept it.
        enough = len(rows) * _MARGIN >= limits.min_inliers
        if not enough or not limits.allow(pose, angle, 1 / _MARGIN):
            continue
        rotation = pose[:, :3]
        if known.contradict(pair, rotation, angle):
            return _Start(is_stable=False, is_certain=False)
        # Adjustment from nearly the same pose has the same result, so it is not repeated.
        if all(_angle_between(own, rotation) > _SAME * angle for own in rotations):
            is_stable = _is_stable(inliers, rows, pose, limits.min_angle)
            if is_stable is None:
                continue
            if not is_stable:
                return _Start(is_stable=False, is_certain=False)
        rotations.append(rotation)
        enough = len(rows) >= _MARGIN * limits.min_inliers
        certain.append(enough and limits.allow(pose, angle, _MARGIN))
    if not certain:
        return None
    return _Start(True, len(certain) >= _NUM_SEEDS and all(certain))


def _some_inliers(
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    pair: Sequence[int],
    geometry: TwoViewGeometry,
) -> PairInliers:
    """About `_NUM_QUICK` of the inliers of a pair."""
    step = max(1, len(geometry.inlier_matches) // _NUM_QUICK)
    some = replace(geometry, inlier_matches=geometry.inlier_matches[::step])
    return inliers_of(matched, cameras, pair, some)


def _pose(geometry: TwoViewGeometry, inliers: PairInliers) -> _Floats | None:
    """The pose of a pair from its two-view geometry, float64 [3, 4]; None if it has no matrix."""
    if geometry.qvec is not None and geometry.tvec is not None:
        rotation = pycolmap.Rotation3d(np.roll(geometry.qvec, -1)).matrix()
        return np.column_stack([rotation, geometry.tvec])
    if geometry.config in FLAT_CONFIGS and geometry.H is not None:
        return pose_of_homography(geometry.H, inliers)
    E = geometry.E
    if E is None and geometry.F is not None:
        a, b = (camera.calibration_matrix() for camera in inliers.cameras)
        E = b.T @ geometry.F @ a
    return None if E is None else pose_of_essential(E, inliers)


def _poses(inliers: PairInliers) -> Iterator[tuple[NDArray[np.uint32], _Floats, float]]:
    """Yield poses the mapper may begin with: rows of the inliers, [R | t], angle in degrees."""
    own = np.arange(len(inliers.xy[0]), dtype=np.uint32)
    # Assumed focal lengths count as known: otherwise COLMAP 4.2 estimates them together with the
    # pose, and its solver crashes on some pairs.
    a, b = (pycolmap.Camera(camera.todict()) for camera in inliers.cameras)
    a.has_prior_focal_length = b.has_prior_focal_length = True
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.min_num_trials = _NUM_TRIALS
    options.ransac.max_error = _MAX_ERROR
    for seed in range(_NUM_SEEDS):
        pycolmap.set_random_seed(seed)
        if hasattr(options.ransac, "random_seed"):  # before COLMAP 4 only the global seed exists
            options.ransac.random_seed = seed
        views = (a, inliers.xy[0], b, inliers.xy[1])
        found = pycolmap.estimate_two_view_geometry(*views, np.column_stack([own, own]), options)
        if pycolmap.estimate_two_view_geometry_pose(*views, found):
            assert found.cam2_from_cam1 is not None
            pose = np.asarray(found.cam2_from_cam1.matrix())
            yield found.inlier_matches[:, 0], pose, float(np.degrees(found.tri_angle))
    if not all(camera.has_prior_focal_length for camera in inliers.cameras):
        # With assumed focal lengths, the mapper may use a homography that explains most matches.
        flat = pycolmap.estimate_homography_matrix(*inliers.xy, options.ransac)
        if flat is not None:
            rows = np.flatnonzero(flat["inlier_mask"]).astype(np.uint32)
            rays = [own[:, rows] for own in inliers.rays]
            pose = pose_of_homography(flat["H"], inliers)
            yield rows, pose, triangulation_angle(pose[:, :3], rays)


def _is_stable(
    inliers: PairInliers, rows: NDArray[np.uint32], pose: _Floats, min_angle: float
) -> bool | None:
    """Whether bundle adjustment keeps the intrinsics; None if too few points are triangulated."""
    x = [own[:, rows] for own in inliers.x]
    points = cv2.triangulatePoints(np.eye(3, 4), pose, *x)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.asarray(points[:3] / points[3]).T
    inside = np.isfinite(points).all(axis=1)
    points = np.where(inside[:, None], points, 0.0)
    seen = points @ pose[:, :3].T + pose[:, 3]
    inside &= (points[:, 2] > 0) & (seen[:, 2] > 0)
    # Triangulation angles, between the vectors from both cameras to a point.
    sides = np.stack([seen - pose[:, 3], seen])
    lengths = np.linalg.norm(sides, axis=2)
    cosine = (sides[0] * sides[1]).sum(axis=1) / np.maximum(lengths[0] * lengths[1], 1e-12)
    inside &= np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) >= min_angle
    if inside.sum() < INITIAL_MIN_POINTS:
        return None
    some = np.flatnonzero(inside)[:: max(1, np.count_nonzero(inside) // _NUM_ADJUSTED)]
    model = _adjusted(inliers, pose, points[some], rows[some].tolist())
    return all(
        _is_near(model.images[k + 1].camera, camera) for k, camera in enumerate(inliers.cameras)
    )


def _is_near(found: pycolmap.Camera | None, given: pycolmap.Camera) -> bool:
    if found is None or given.has_bogus_params(*_MAPPER_LIMITS):
        return False
    focal = given.focal_length_idxs()
    extra = given.extra_params_idxs()
    factors = found.params[focal] / given.params[focal]
    added = np.abs(found.params[extra] - given.params[extra])
    return bool(
        ((factors < _MAX_FOCAL_FACTOR) & (factors > 1 / _MAX_FOCAL_FACTOR)).all()
        and (added < _MAX_DISTORTION_CHANGE).all()
    )


def _adjusted(
    inliers: PairInliers, pose: _Floats, points: _Floats, rows: Sequence[int]
) -> pycolmap.Reconstruction:
    """Adjust poses, points, focal lengths and distortion of a pair as the mapper does."""
    model = pycolmap.Reconstruction()
    cameras = list({id(camera): camera for camera in inliers.cameras}.values())
    for number, camera in enumerate(cameras, 1):
        numbered = pycolmap.Camera(camera.todict() | {"camera_id": number})
        model.add_camera(numbered)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(numbered.sensor_id)
        model.add_rig(rig)
    poses = pycolmap.Rigid3d(), pycolmap.Rigid3d(pose)
    views = zip(inliers.cameras, inliers.xy, poses, strict=True)
    for k, (camera, xy, rig_from_world) in enumerate(views, 1):
        number = next(n for n, of_pair in enumerate(cameras, 1) if of_pair is camera)
        image = pycolmap.Image(image_id=k, name=str(k), camera_id=number, keypoints=xy)
        frame = pycolmap.Frame(frame_id=k, rig_id=number)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = rig_from_world
        model.add_frame(frame)
        image.frame_id = k
        model.add_image(image)
        model.register_frame(k)
    for xyz, row in zip(points, rows, strict=True):
        track = pycolmap.Track()
        track.add_element(1, row)
        track.add_element(2, row)
        model.add_point3D(xyz, track)
    config = pycolmap.BundleAdjustmentConfig()
    config.add_image(1)
    config.add_image(2)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    holder: Any = getattr(options, "ceres", options)  # the options themselves before COLMAP 4
    solver = holder.solver_options
    solver.num_threads = 1
    solver.max_num_iterations = _NUM_ITERATIONS
    solver.function_tolerance = solver.parameter_tolerance = 0.0
    solver.gradient_tolerance = _GRADIENT_TOLERANCE
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return model
