"""Match images along tracks and verify the matches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.mapper_limits import INITIAL_MAX_FORWARD_MOTION, MIN_INLIERS
from colmap_av1.matching.pairs import (
    ImageKeypoints,
    image_keypoints,
    next_track,
    pair_matches,
)
from colmap_av1.matching.two_view_geometry import UNUSED_CONFIGS, TwoViewConfig, TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import PairOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.graphs import connected_components
from colmap_av1.util.progress import Progress, no_progress, progress_in
from colmap_av1.util.run_context import RunContext


@dataclass(frozen=True)
class PairedImages:
    """Keypoints of images and the matches between them.

    Attributes:
        keypoints: keypoints of each image.
        pairs: int32 [m, 2] indices of images.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
    """

    keypoints: list[ImageKeypoints]
    pairs: NDArray[np.int32]
    matches: list[NDArray[np.uint32]]

    @property
    def track_lengths(self) -> Ints:
        """Number of images that observe each track of the keypoints."""
        counts = np.bincount(np.concatenate([k.track for k in self.keypoints]))
        return counts[counts > 0].astype(np.int64)


@dataclass(frozen=True)
class MatchedImages(PairedImages):
    """Keypoints of images and the verified matches between them.

    Attributes:
        geometries: two-view geometry of each pair.
        forward_motion: the camera moves along its axis, see `MatchReport`.
    """

    geometries: list[TwoViewGeometry]
    forward_motion: bool

    @property
    def num_inliers(self) -> Ints:
        """Number of inlier matches of each pair, int64 [num_pairs]."""
        return np.array([len(own.inlier_matches) for own in self.geometries], np.int64)

    @property
    def is_used(self) -> Bools:
        """Whether mappers use each pair, bool [num_pairs]."""
        configs = [geometry.config for geometry in self.geometries]
        return (self.num_inliers >= MIN_INLIERS) & ~np.isin(configs, UNUSED_CONFIGS)


def pair_by_tracks(
    tracks: Tracks,
    frames: NDArray[np.int32],
    choose: Callable[[list[ImageKeypoints]], NDArray[np.int32]],
    progress: Progress = no_progress,
) -> PairedImages:
    """Match the images of a video along tracks.

    Args:
        tracks: the tracks.
        frames: int32 [num_images] the frame of each image, ascending.
        choose: chooses the pairs, int32 [m, 2], from the keypoints, see `schedule_pairs` and
            `covisible_pairs`.
        progress: called with the stage "pairs".
    """
    keypoints = image_keypoints(tracks, frames.tolist())
    pairs = choose(keypoints)
    matches = []
    for i, j in pairs.tolist():
        matches.append(pair_matches(keypoints[i], keypoints[j]))
        progress("pairs", len(matches), len(pairs))
    return PairedImages(keypoints, pairs, matches)


def nothing_to_match(name: str, options: PairOptions) -> VideoError:
    """The error to raise if no two images have enough matches."""
    return VideoError(
        f"{name}: no two images share {options.min_matches} tracks, so there is nothing to "
        "match: use more frames as images, or see 'colmap-av1 info --video' for what the stream "
        "lacks; --reencode 1 converts it first"
    )


def join_videos(videos: Sequence[PairedImages], image_set: ImageSet) -> PairedImages:
    """Join the images of all videos, and add the photos without keypoints.

    Args:
        videos: the images of each video. A single video without photos is returned unchanged.
        image_set: all images.
    """
    if image_set.num_sequences == 1:
        return videos[0]
    keypoints: list[ImageKeypoints] = []
    pairs, matches = [np.empty((0, 2), np.int32)], []
    first_track = 0
    for own in videos:
        pairs.append((own.pairs + len(keypoints)).astype(np.int32))
        matches += own.matches
        keypoints += [replace(k, track=k.track + first_track) for k in own.keypoints]
        first_track += next_track(own.keypoints)
    no_xy, no_track = np.empty((0, 2), np.float32), np.empty(0, np.int64)
    num_photos = len(image_set.sequence) - len(keypoints)
    keypoints += [ImageKeypoints(no_xy, no_track)] * num_photos
    return PairedImages(keypoints, np.concatenate(pairs), matches)


def verify_images(
    paired: PairedImages,
    cameras: Sequence[pycolmap.Camera],
    options: VerifyOptions,
    context: RunContext,
) -> MatchedImages:
    """Verify the pairs.

    Args:
        paired: the images and their matches.
        cameras: the camera of each image.
        options: thresholds and effort.
        context: its clock and progress get the stage "verification".
    """
    keypoints, pairs, matches = paired.keypoints, paired.pairs, paired.matches
    with context.clock.measure("verification"):
        geometries = verify_pairs(
            keypoints,
            pairs,
            matches,
            cameras,
            options,
            num_threads=context.num_threads,
            seed=context.seed,
            progress=progress_in(context.progress, "verification", len(pairs)),
        )
    seconds = [cameras[second] for second in pairs[:, 1].tolist()]
    forward_motion = _is_forward_motion(geometries, seconds)
    return MatchedImages(keypoints, pairs, matches, geometries, forward_motion)


def _is_forward_motion(
    geometries: Sequence[TwoViewGeometry], cameras: Sequence[pycolmap.Camera]
) -> bool:
    """Whether COLMAP's mapper would reject most pairs as initial pairs because of forward motion.

    Args:
        geometries: the two-view geometries. Only those with parallax have a direction of motion.
        cameras: the second camera of each pair.
    """
    along_axis = [
        abs(float(translation[2]))
        for translation in map(_translation, geometries, cameras)
        if translation is not None
    ]
    return bool(along_axis) and float(np.median(along_axis)) >= INITIAL_MAX_FORWARD_MOTION


def _translation(geometry: TwoViewGeometry, camera: pycolmap.Camera) -> Floats | None:
    """Direction of the first camera from the second, float64 [3], up to its sign.

    None if it is not known.
    """
    if geometry.tvec is not None:
        return geometry.tvec
    if geometry.config != TwoViewConfig.UNCALIBRATED or geometry.F is None:
        return None
    # The epipole in the second image is the image of the first camera.
    epipole = np.linalg.svd(geometry.F)[0][:, -1]
    direction = np.linalg.solve(camera.calibration_matrix(), epipole)
    return np.asarray(direction / np.linalg.norm(direction))


def connected_images(matched: MatchedImages) -> NDArray[np.int32]:
    """Label each image with its connected component, int32 [num_images]."""
    return connected_components(len(matched.keypoints), matched.pairs[matched.is_used])
