"""Matches that agree with a joint estimate of all poses, for a COLMAP database.

Two images do not show which tracks have drifted: drifted tracks agree with some epipolar geometry,
too. The poses of all images show it, so they are estimated as in `reconstruct`. The tracks that
agree with them are matched: the corners and SIFT links used in the adjustment, and motion tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import ModelError
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.matching.mapper_limits import POINT_MIN_ANGLE
from colmap_av1.matching.match_images import ImageMatches
from colmap_av1.matching.matched_images import PairedImages, pair_by_tracks, verify_images
from colmap_av1.matching.pairs import ImageKeypoints, covisible_pairs
from colmap_av1.options import DensityOptions, TriangulateOptions
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.estimate import estimate_poses
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.further_models import further_poses
from colmap_av1.poses.initial_pair import initial_pair
from colmap_av1.poses.joint_cameras import joint_cameras
from colmap_av1.poses.long_range_stage import LongRangeResult
from colmap_av1.poses.matched_observations import (
    NUM_OBSERVATIONS,
    SPANS,
    limits_of_density,
    matched_observations,
)
from colmap_av1.poses.model_tracks import at_same_place, tracks_of_model
from colmap_av1.poses.posed_images import PosedImages, posed_images_of, read_poses, triangulate_in
from colmap_av1.poses.run import Run
from colmap_av1.poses.unregistered import models_of_images, tracks_of_unregistered, within_models
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.spread import evenly_spread
from colmap_av1.util.texts import some_names
from colmap_av1.video.coded_size import smaller_grey

# An observation of the adjusted model is an outlier if its error exceeds both this many pixels and
# this multiple of the median error, which is larger with a rolling shutter, for example. SIFT
# features of links are less accurate than corners, and where there are links, there is little else.
_LEAST_ERROR, _LEAST_ERROR_OF_LINKS, _MEDIAN_ERRORS = 0.6, 1.0, 4.0
# Points of motion tracks need the mapper's smallest triangulation angle, and a depth error below
# 50 %.
_POINTS = TriangulateOptions(
    max_reprojection_error=1.0, min_angle=POINT_MIN_ANGLE, max_depth_error=0.5, points="survey"
)
# Pairs at these distances in images are matched: at all spans of tracks and at half of them.
_NEAR = sorted({*SPANS, *(span // 2 for span in SPANS)})
_MAX_PAIRS = 16
# Number of pictures whose SIFT features are counted, and COLMAP's threshold for them. With OpenCV's
# own threshold, which is twice as high, pictures of low contrast have far fewer features.
_NUM_SAMPLED = 5
_SIFT_CONTRAST = 0.02
# A motion track this close to a corner, in pixels, observes the same point less accurately.
_SAME_POINT = 1.0
# Two tracks of one video this close to each other, in pixels, are the same.
_SAME_TRACK = 0.01
# If at least this share of the images is not registered, the estimate has failed.
_MAX_NOT_REGISTERED = 0.5
# Largest number of matches of the initial pair.
_MAX_INITIAL_MATCHES = 300


@dataclass(frozen=True)
class JointEstimate:
    """Results of the joint estimate of all poses.

    Attributes:
        num_registered: number of registered images of each model, the largest first. The other
            figures describe the one that was estimated first, usually the largest.
        long_range: median long-range epipolar error in pixels, over pairs of images ten or more
            apart; None if no such images have enough matches.
        long_range_largest: its 90th percentile.
        dynamic_share: share of dynamic pixels, which have no matches; None if dynamic objects were
            not looked for.
        focal_lengths: the shortest and the longest focal length of the registered images in pixels,
            in the cameras of the database: the estimated ones unless the images hardly determine
            them, or the database already has cameras.
    """

    num_registered: tuple[int, ...]
    long_range: float | None
    long_range_largest: float | None
    dynamic_share: float | None
    focal_lengths: tuple[float, float]


@dataclass(frozen=True)
class JointMatches(ImageMatches):
    """Matches of all images that agree with an estimate of their poses.

    Attributes:
        estimate: results of the estimate.
        poses: for each model, float64 [3, 4] cam_from_world of each image; None if the image is not
            in the model.
    """

    estimate: JointEstimate
    poses: list[list[Floats | None]]

    @property
    def registered_cameras(self) -> list[pycolmap.Camera]:
        """The cameras of the registered images."""
        return [
            camera
            for poses in self.poses
            for camera, pose in zip(self.cameras, poses, strict=True)
            if pose is not None
        ]


def match_jointly(
    run: Run,
    videos: Sequence[VideoTracks],
    image_set: ImageSet,
    density: DensityOptions,
) -> JointMatches:
    """Estimate the poses of all images, and match the tracks that agree with them.

    Images that are not registered are matched along all their tracks if they belong to a model, see
    `models_of_images`; otherwise they have no matches.

    Args:
        run: inputs and options of the run.
        videos: the tracks and images of each video.
        image_set: all images.
        density: which motion tracks are matched.

    Raises:
        ModelError: the poses of most images cannot be estimated.
        VideoError: nothing connects any two images.
    """
    if density.max_sigma is None:
        density = replace(density, max_sigma=0.0)  # the poses show which tracks have drifted
    estimate = estimate_poses(run, videos, image_set)
    models = [_model_of(run, estimate, image_set)]
    # A second mapping would join images across turns, which the mapper of the database then bends.
    lost = set[str]()
    for tried in further_poses(
        run, estimate, image_set, lambda: [v.tracks for v in videos], map_again=False
    ):
        lost |= tried.lost
        if tried.poses is not None:
            own = tried.poses
            models.append(_model_of(own.run, own.estimate, own.image_set))
    first = models[0]
    models.sort(key=lambda model: -len(model.registered.images))
    in_models = {image.name for model in models for image in model.registered.images}
    not_registered = [name for name in image_set.images.names if name not in in_models]
    num_images = len(image_set.sequence)
    # Images of uncertain models count, because without the estimate their models would be bent.
    if len(lost.union(in_models)) <= (1 - _MAX_NOT_REGISTERED) * num_images:
        raise ModelError(
            f"the joint estimate registers only {len(in_models)} of {num_images} images: match "
            "them pair by pair with --verify pairs"
        )
    with run.clock.measure("pairs"):
        others = tracks_of_unregistered(run, estimate, image_set, not_registered, density)
        model_of = models_of_images(
            others, [model.registered.frames for model in models], image_set
        )
        others = within_models(others, not_registered, model_of, image_set)
        agreeing = [_agreeing_tracks(model, image_set, others, density) for model in models]
        paired = _paired(run, image_set, agreeing, others, density)
    cameras = joint_cameras(
        run, image_set, [(m.known, {i.name for i in m.registered.images}) for m in models]
    )
    matched = verify_images(paired, cameras, run.options.match.verify, run.context)
    long_range = estimate.long_range.result
    warnings = _warnings(long_range, models, not_registered, others, image_set)
    if first.adjusted.seams_warning is not None:
        warnings.append(first.adjusted.seams_warning)
    matches = estimate.matches.result
    in_first = {image.name for image in first.registered.images}
    focal = [
        camera.mean_focal_length()
        for camera, name in zip(cameras, image_set.images.names, strict=True)
        if name in in_first
    ]
    return JointMatches(
        cameras=cameras,
        focal_length=_focal_length(run, cameras[0]),
        matched=matched,
        links=matches.links,
        link_tracks=estimate.tracks.link_tracks,
        track_lengths=paired.track_lengths,
        depth=matches.depth,
        warnings=(*matches.warnings, *warnings),
        estimate=JointEstimate(
            num_registered=tuple(len(model.registered.images) for model in models),
            long_range=long_range.median,
            long_range_largest=long_range.largest,
            dynamic_share=estimate.dynamic.result.share if estimate.dynamic is not None else None,
            focal_lengths=(min(focal), max(focal)),
        ),
        poses=[model.poses_of(image_set) for model in models],
    )


@dataclass(frozen=True)
class _Model:
    """A model of the joint estimate.

    Attributes:
        run: its run.
        adjusted: its adjustment.
        known: its poses and points.
        registered: its registered images, except those of an earlier model.
        tracks: the tracks that poses are estimated from, in these images.
    """

    run: Run
    adjusted: AdjustedResult
    known: PosedModel
    registered: PosedImages
    tracks: Tracks

    def poses_of(self, image_set: ImageSet) -> list[Floats | None]:
        """float64 [3, 4] cam_from_world of each image; None if it is not in the model."""
        pose_of = {image.name: image.cam_from_world for image in self.registered.images}
        return [pose_of.get(name) for name in image_set.images.names]


def _model_of(run: Run, estimate: Estimate, image_set: ImageSet) -> _Model:
    """The finished model of a run, with those of its images that are in the set."""
    assert estimate.adjustment is not None  # `match` always adjusts
    known = read_poses(run, estimate.last)
    registered = posed_images_of(known, image_set)
    tracks = run.pose_tracks(estimate.tracks.motion).keep_frames(registered.frames)
    return _Model(run, estimate.adjustment.result, known, registered, tracks)


@dataclass(frozen=True)
class _Agreeing:
    """Tracks that agree with the poses of a model, in its registered images.

    Attributes:
        registered: the registered images.
        tracks: the tracks, without outliers.
        is_corner: bool [num_tracks] corners; the others are motion tracks.
        pair: frames of the initial pair for a mapper; None if there is none.
        is_of_pair: bool [num_tracks] the tracks to match this pair by.
    """

    registered: PosedImages
    tracks: Tracks
    is_corner: Bools
    pair: tuple[int, int] | None
    is_of_pair: Bools


def _agreeing_tracks(
    model: _Model, image_set: ImageSet, others: Tracks, density: DensityOptions
) -> _Agreeing:
    """The corners of a model and a selection of motion tracks, without outliers.

    Args:
        model: the model.
        image_set: all images.
        others: tracks with observations in images that are not registered.
        density: which motion tracks are selected.
    """
    run, registered = model.run, model.registered
    corners, corner_points = _agreeing_corners(model, image_set)
    repeated = at_same_place(corners, others, _SAME_TRACK)
    corners, corner_points = corners.keep_tracks(~repeated), corner_points[~repeated]
    every = model.tracks
    every = every.keep_tracks(~at_same_place(every, others, _SAME_TRACK))
    # `matched_observations` applies the limit per image, which depends on what each track keeps.
    some = select_tracks(every, replace(density, max_tracks_per_image=0))
    some = some.keep_tracks(~at_same_place(some, corners, _SAME_POINT))
    motion, motion_points = _agreeing_motion(run, some, registered)
    tracks = Tracks.concatenate(corners, motion)
    pair, of_pair = _start(tracks, np.concatenate([corner_points, motion_points]), registered)
    if pair is None:
        wide, points = _agreeing_motion(run, every, registered)
        pair, of_pair = _start(wide, points, registered)
        further = wide.keep_tracks(np.isin(np.arange(wide.num_tracks), of_pair))
        corners = corners.keep_tracks(~at_same_place(corners, further, _SAME_POINT))
        motion = motion.keep_tracks(~at_same_place(motion, further, _SAME_TRACK))
        tracks = Tracks.concatenate(corners, motion, further)
        of_pair = np.arange(tracks.num_tracks - further.num_tracks, tracks.num_tracks)
    number = np.arange(tracks.num_tracks)
    return _Agreeing(
        registered,
        tracks,
        is_corner=number < corners.num_tracks,
        pair=pair,
        is_of_pair=np.isin(number, of_pair),
    )


def _agreeing_corners(model: _Model, image_set: ImageSet) -> tuple[Tracks, Floats]:
    """The corners and SIFT links used in the adjustment, without outliers, and their points."""
    known = model.known
    adjusted = tracks_of_model(known, image_set)
    # Points of motion tracks come first, then those of links.
    number = adjusted.track - model.adjusted.num_motion_points
    agrees = are_inliers(reprojection_errors(known), number < model.adjusted.num_link_points)
    agrees &= number >= 0
    agrees &= np.isin(adjusted.frame, model.registered.frames)
    enough = np.bincount(adjusted.track[agrees], minlength=adjusted.num_tracks) >= NUM_OBSERVATIONS
    kept = adjusted.keep_observations(agrees & enough[adjusted.track])
    return kept, known.points.xyz[enough]


def are_inliers(errors: Floats, is_link: Bools) -> Bools:
    """Which observations of an adjusted model are no outliers.

    Args:
        errors: float64 [num_observations] reprojection errors in pixels.
        is_link: bool [num_observations] observations of SIFT links.

    Returns:
        bool [num_observations].
    """
    least = np.where(is_link, _LEAST_ERROR_OF_LINKS, _LEAST_ERROR)
    return np.asarray(errors <= np.maximum(least, _MEDIAN_ERRORS * float(np.median(errors))))


def _agreeing_motion(run: Run, tracks: Tracks, registered: PosedImages) -> tuple[Tracks, Floats]:
    """Motion tracks that have a point, without outliers, and their points."""
    found = triangulate_in(run, registered, tracks, _POINTS)
    points = found.points
    return found.tracks.take(points.observation, points.offsets), points.xyz


def _start(
    tracks: Tracks, points: Floats, registered: PosedImages
) -> tuple[tuple[int, int] | None, Ints]:
    """The frames of the initial pair for a mapper, and the tracks to match it by.

    None and no tracks if there is no such pair, see `initial_pair`.
    """
    view = np.searchsorted(registered.frames, tracks.frame)
    start = initial_pair(tracks.track, view, points, registered.images)
    if start is None:
        return None, np.empty(0, np.int64)
    first, second = registered.frames[[start.first, start.second]].tolist()
    chosen = evenly_spread(len(start.points), _MAX_INITIAL_MATCHES)
    return (first, second), start.points[chosen]


def _num_features(run: Run, image_set: ImageSet) -> float:
    """Mean number of SIFT features of a picture, estimated from a few."""
    some = evenly_spread(len(image_set.sequence), _NUM_SAMPLED)
    sift = cv2.SIFT.create(contrastThreshold=_SIFT_CONTRAST)
    pictures = run.pictures(image_set)(some)
    return float(np.mean([len(sift.detect(smaller_grey(own))) for _, own in pictures]))


def _paired(
    run: Run,
    image_set: ImageSet,
    agreeing: Sequence[_Agreeing],
    others: Tracks,
    density: DensityOptions,
) -> PairedImages:
    """Match registered images along the tracks that agree with the poses, others along all."""
    frames = image_set.images.frames
    limits = limits_of_density(density, partial(_num_features, run, image_set))
    tracks = list[Tracks]()
    starts = list[tuple[int, int, Ints]]()  # two images and the tracks to match them by
    num_tracks = 0
    for own in agreeing:
        kept = matched_observations(own.tracks, frames, own.is_corner, own.is_of_pair, limits)
        tracks.append(own.tracks.keep_observations(kept))
        if own.pair is not None:
            first, second = np.searchsorted(frames, own.pair).tolist()
            # Tracks without a kept observation are gone, which changes the numbers of the others.
            of_pair = np.flatnonzero(own.is_of_pair[own.tracks.having(kept)])
            starts.append((first, second, of_pair + num_tracks))
        num_tracks += tracks[-1].num_tracks

    def choose(keypoints: list[ImageKeypoints]) -> NDArray[np.int32]:
        min_matches = run.options.match.pairs.min_matches
        pairs = covisible_pairs(keypoints, min_matches, near=_NEAR, most_pairs=_MAX_PAIRS)
        initial = np.array([start[:2] for start in starts], np.int32).reshape(-1, 2)
        return np.unique(np.vstack([pairs, initial]), axis=0)

    paired = pair_by_tracks(Tracks.concatenate(*tracks, others), frames, choose)
    matches = list(paired.matches)
    for first, second, of_pair in starts:
        number = int(np.flatnonzero((paired.pairs == [first, second]).all(axis=1))[0])
        track = paired.keypoints[first].track[matches[number][:, 0]]
        matches[number] = matches[number][np.isin(track, of_pair)]
    return replace(paired, matches=matches)


def _focal_length(run: Run, camera: pycolmap.Camera) -> float | None:
    """The estimated focal length of the first video; None if it is given or assumed."""
    given = run.cameras is not None or run.options.match.camera.camera_params is not None
    return None if given or not camera.has_prior_focal_length else float(camera.focal_length_y)


def _warnings(
    long_range: LongRangeResult,
    models: Sequence[_Model],
    not_registered: Sequence[str],
    others: Tracks,
    image_set: ImageSet,
) -> list[str]:
    """Warnings about the estimate.

    Args:
        long_range: result of the long-range check of the first model.
        models: the models.
        not_registered: names of the images that are not registered.
        others: the tracks by which images are matched that are not registered.
        image_set: all images.
    """
    warnings = []
    if long_range.contradicts_poses and long_range.warning is not None:
        warnings.append(long_range.warning)
    if len(models) > 1:
        parts = ", ".join(
            f"{len(images)} from '{images[0].name}' to '{images[-1].name}'"
            for images in (model.registered.images for model in models)
        )
        warnings.append(
            f"hardly any points connect {len(models)} parts of the images, which are matched "
            f"separately: {parts}; a mapper makes a model of each, not always the largest first"
        )
    num_images = len(image_set.sequence)
    frame_of = image_set.images.frame_of
    is_matched = np.isin([frame_of[name] for name in not_registered], others.frame)
    matched = [name for name, own in zip(not_registered, is_matched, strict=True) if own]
    alone = [name for name, own in zip(not_registered, is_matched, strict=True) if not own]
    if matched:
        warnings.append(
            f"{len(matched)} of {num_images} images are not registered in the joint estimate and "
            f"are matched without known poses: {some_names(matched)}"
        )
    if alone:
        have_motion = set(image_set.images.names[: image_set.photos.start])
        advice = "; --verify pairs matches them by motion alone, which may bend models"
        warnings.append(
            f"{len(alone)} of {num_images} images are not registered in the joint estimate and "
            f"have no matches: {some_names(alone)}{advice if have_motion & {*alone} else ''}"
        )
    return warnings
