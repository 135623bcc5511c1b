"""Images matched along tracks, and the matches verified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.images.camera import is_nearly_pinhole
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.matching.focal import estimate_focal_length
from colmap_av1.matching.mapper_limits import INITIAL_MAX_FORWARD_MOTION
from colmap_av1.matching.pairs import ImageKeypoints, image_keypoints, pair_matches, schedule_pairs
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import MatchOptions
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.util.progress import Clock, Progress


@dataclass(frozen=True)
class PairedImages:
    """Keypoints of the images, and the matches between them.

    Attributes:
        keypoints: keypoints of each image.
        pairs: int32 [m, 2] indices of images.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
    """

    keypoints: list[ImageKeypoints]
    pairs: NDArray[np.int32]
    matches: list[NDArray[np.uint32]]


@dataclass(frozen=True)
class MatchedImages(PairedImages):
    """Keypoints of the images, and the verified matches between them.

    Attributes:
        geometries: two-view geometry of each pair.
        forward_motion: the camera moves along its axis, see `MatchReport`.
    """

    geometries: list[TwoViewGeometry]
    forward_motion: bool


def pair_images(
    video: Path,
    tracks: Tracks,
    chosen: ChosenImages,
    options: MatchOptions,
    *,
    needed: bool = True,
    clock: Clock,
    progress: Progress,
) -> PairedImages:
    """Match the images along the tracks.

    Args:
        video: the file that messages name.
        tracks: tracks of the whole video.
        chosen: the images.
        options: those of pairs are used.
        needed: refuse a video of which no two images share enough tracks.
        clock: gets the stage "pairs".
        progress: called in the stage "pairs".

    Raises:
        VideoError: no two images share enough tracks.
    """
    with clock.measure("pairs"):
        keypoints = image_keypoints(tracks, chosen.frames.tolist())
        pairs = schedule_pairs(keypoints, options.pairs)
        length = least_length(options.tracks)
        if needed and tracks.num_frames < length:
            raise VideoError(
                f"{video}: tracks are of {length} frames or more, the video has "
                f"{tracks.num_frames}: give a longer video, or --min_length 2"
            )
        if needed and len(pairs) == 0:
            raise nothing_to_match(video, options)
        matches = []
        for i, j in pairs:
            matches.append(pair_matches(keypoints[i], keypoints[j]))
            progress("pairs", len(matches), len(pairs))
    return PairedImages(keypoints, pairs, matches)


def nothing_to_match(video: Path, options: MatchOptions) -> VideoError:
    """The error where no two images have enough matches."""
    return VideoError(
        f"{video}: no two images share {options.pairs.min_matches} tracks, so there is nothing to "
        "match: use more frames as images, or see 'colmap-av1 info --video' for what the stream "
        "lacks; --reencode 1 converts it first"
    )


def shared_focal_length(
    paired: PairedImages,
    size: tuple[int, int],
    pixel_aspect: float,
    options: MatchOptions,
    *,
    clock: Clock,
) -> float | None:
    """Estimate, from the tracks, the focal length of a camera with unknown intrinsics.

    Args:
        paired: the images, all of one camera.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        options: those of the camera and the seed are used.
        clock: gets the stage "focal length".

    Returns:
        In heights of a pixel; None where parameters are given or the motion does not determine it.
    """
    camera = options.camera
    if camera.camera_params is not None or not is_nearly_pinhole(camera.camera_model):
        return None
    with clock.measure("focal length"):
        return estimate_focal_length(
            paired.keypoints,
            paired.pairs,
            paired.matches,
            size,
            pixel_aspect=pixel_aspect,
            seed=options.run.seed,
        )


def verify_images(
    paired: PairedImages,
    cameras: Any,
    options: MatchOptions,
    *,
    clock: Clock,
    progress: Progress,
) -> MatchedImages:
    """Verify the pairs.

    Args:
        paired: the images and their matches.
        cameras: the camera of all images, or one for each.
        options: those of verification and of the run are used.
        clock: gets the stage "verification".
        progress: called in the stage "verification".
    """
    keypoints, pairs, matches = paired.keypoints, paired.pairs, paired.matches
    with clock.measure("verification"):
        geometries = verify_pairs(
            keypoints,
            pairs,
            matches,
            cameras,
            options=options.verify,
            run=options.run,
            progress=lambda done: progress("verification", done, len(pairs)),
        )
    return MatchedImages(keypoints, pairs, matches, geometries, _is_forward_motion(geometries))


def _is_forward_motion(geometries: Sequence[TwoViewGeometry]) -> bool:
    """Whether COLMAP's mapper would take most pairs for forward motion and not start with them.

    Only pairs with known intrinsics say in which direction the camera moved.
    """
    along_axis = [abs(float(g.tvec[2])) for g in geometries if g.tvec is not None]
    return bool(along_axis) and float(np.median(along_axis)) >= INITIAL_MAX_FORWARD_MOTION
