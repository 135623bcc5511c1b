"""Images matched along tracks, and the matches verified."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.geometry.cameras import (
    check_pixel_aspect,
    is_fisheye,
    is_nearly_pinhole,
    make_camera,
)
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.photos import Photo
from colmap_av1.images.takes import Takes
from colmap_av1.matching.focal import estimate_focal_length
from colmap_av1.matching.mapper_limits import INITIAL_MAX_FORWARD_MOTION
from colmap_av1.matching.pairs import ImageKeypoints, image_keypoints, pair_matches, schedule_pairs
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import MatchOptions
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.util.progress import Clock, Progress
from colmap_av1.video.facts import Video
from colmap_av1.video.metadata.lens import said_focal_length

# Factor to which the focal lengths of tracks and containers agree, where these crop little.
_AGREE = 1.2


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


def pairs_of_takes(videos: Sequence[PairedImages], takes: Takes) -> PairedImages:
    """The images of all takes, those of each video paired among themselves.

    Args:
        videos: the images of each video; the same object is given back where nothing is beside it.
        takes: all images.
    """
    if takes.num_takes == 1:
        return videos[0]
    keypoints: list[ImageKeypoints] = []
    pairs, matches = [np.empty((0, 2), np.int32)], []
    first_track = 0
    for video, own in enumerate(videos):
        first_frame = int(takes.first_frame[video])
        pairs.append((own.pairs + len(keypoints)).astype(np.int32))
        matches += own.matches
        keypoints += [
            replace(k, frame=k.frame + first_frame, track=k.track + first_track)
            for k in own.keypoints
        ]
        first_track += max(
            (int(k.track.max()) + 1 for k in own.keypoints if k.track.size), default=0
        )
    nothing = np.empty((0, 2), np.float32), np.empty(0, np.int64)
    photos = takes.images.frames[len(keypoints) :]
    keypoints += [ImageKeypoints(int(frame), *nothing) for frame in photos]
    return PairedImages(keypoints, np.concatenate(pairs), matches)


def _of_images(paired: PairedImages, images: Sequence[int]) -> PairedImages:
    """Some of the images, ascending, with the pairs among them."""
    if len(images) == len(paired.keypoints):
        return paired
    place = np.full(len(paired.keypoints), -1, dtype=np.int32)
    place[list(images)] = np.arange(len(images))
    pairs = place[paired.pairs]
    kept = np.flatnonzero((pairs >= 0).all(axis=1))
    return PairedImages(
        [paired.keypoints[i] for i in images], pairs[kept], [paired.matches[k] for k in kept]
    )


def nothing_to_match(video: Path | str, options: MatchOptions) -> VideoError:
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
    fisheye = is_fisheye(camera.camera_model)
    if camera.camera_params is not None or not (fisheye or is_nearly_pinhole(camera.camera_model)):
        return None
    with clock.measure("focal length"):
        return estimate_focal_length(
            paired.keypoints,
            paired.pairs,
            paired.matches,
            size,
            pixel_aspect=pixel_aspect,
            fisheye=fisheye,
            seed=options.run.seed,
        )


@dataclass(frozen=True)
class NewCameras:
    """Cameras of images that have none yet.

    Attributes:
        of_images: the camera of each image; images share one where it is the same object.
        focal_length: of the first video's, in heights of a pixel, where it was estimated.
        warnings: what the user should know of them.
    """

    of_images: list[Any]
    focal_length: float | None
    warnings: list[str]


@dataclass(frozen=True)
class Shape:
    """The pictures of a video.

    Attributes:
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        focal_length: in heights of a pixel, as the container says; None where it does not.
    """

    size: tuple[int, int]
    pixel_aspect: float
    focal_length: float | None


def shape_of(video: Video, size: tuple[int, int], pixel_aspect: float) -> Shape:
    """The shape of images of a video."""
    return Shape(size, pixel_aspect, said_focal_length(video.tags, size, pixel_aspect))


def _focal_length_of(
    estimated: float | None, shape: Shape, model: str | None
) -> tuple[float | None, list[str]]:
    """The focal length that a camera starts from, and what is to be said of it.

    Tracks tell it of the very pictures; what the container says is of a lens, whose pictures may
    have been cropped to hold them steady.
    """
    said = shape.focal_length
    if said is None or not is_nearly_pinhole(model):
        return estimated, []
    if estimated is None:
        return said, [
            f"the motion does not determine the focal length: it starts from {said:.0f} px, which "
            "the container says"
        ]
    if abs(math.log(estimated / said)) <= math.log(_AGREE):
        return estimated, []
    return estimated, [
        f"the focal length is {estimated:.0f} px by the tracks, {said:.0f} px by the container: "
        "that of the tracks is used, as the other does not know of crops"
    ]


def new_cameras(
    paired: PairedImages,
    takes: Takes,
    shapes: Sequence[Shape],
    photos: Sequence[Photo],
    options: MatchOptions,
    *,
    clock: Clock,
) -> NewCameras:
    """Make a camera for each video, and for the photos of each camera and size.

    Given intrinsics are those of videos. Others are estimated from the tracks of a video, else from
    what its container says, and from what EXIF says of photos.

    Args:
        paired: the images.
        takes: of which video each image is, or whether it is a photo.
        shapes: of each video.
        photos: the photos.
        options: those of the camera and the seed are used.
        clock: gets the stage "focal length".

    Raises:
        OptionError: given parameters do not fit such pixels.
    """
    of_images: list[Any] = [None] * len(takes.take)
    estimated: list[float | None] = []
    notes: dict[str, None] = {}
    for shared in _takes_by_camera(len(shapes), photos, options):
        images = [image for take in shared for image in takes.images_of(take)]
        given, aspect = options.camera, 1.0
        if shared[0] < len(shapes):
            shape = shapes[shared[0]]
            size, aspect = shape.size, shape.pixel_aspect
            of_videos = [i for t in shared if t < len(shapes) for i in takes.images_of(t)]
            own = _of_images(paired, of_videos)
            focal_length = shared_focal_length(own, size, aspect, options, clock=clock)
            estimated.append(focal_length)
            if given.camera_params is None:
                focal_length, words = _focal_length_of(focal_length, shape, given.camera_model)
                notes |= dict.fromkeys(words)
        else:
            photo = photos[shared[0] - len(shapes)]
            size, focal_length = photo.size, photo.focal_length
            given = replace(given, camera_params=None)
        camera = make_camera(given, *size, aspect, focal_length)
        notes |= dict.fromkeys(
            check_pixel_aspect(camera, aspect, "leave out --camera_model or give one")
        )
        for image in images:
            of_images[image] = copy.copy(camera) if given.single_camera is False else camera
    return NewCameras(of_images, estimated[0], list(notes))


def _takes_by_camera(
    num_videos: int, photos: Sequence[Photo], options: MatchOptions
) -> list[list[int]]:
    """The takes that one camera each took."""
    if options.camera.single_camera:
        return [list(range(num_videos + len(photos)))]
    of_photos: dict[object, list[int]] = {}
    for take, photo in enumerate(photos, start=num_videos):
        of_photos.setdefault((photo.size, photo.camera, photo.focal_length), []).append(take)
    return [*([video] for video in range(num_videos)), *of_photos.values()]


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
