"""The step from tracks to matches: pair images, choose cameras, verify, link."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pycolmap

from colmap_av1.errors import VideoError
from colmap_av1.images.image_set import ImageSet, Pictures
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.matching.cameras import ImageCameras
from colmap_av1.matching.depth import DepthEvidence, depth_of_images
from colmap_av1.matching.links.link_images import link_images
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.matched_images import (
    MatchedImages,
    PairedImages,
    join_videos,
    pair_by_tracks,
    verify_images,
)
from colmap_av1.matching.pairs import schedule_pairs
from colmap_av1.options import MatchOptions
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.util.arrays import Ints
from colmap_av1.util.run_context import RunContext


@dataclass(frozen=True)
class ImageMatches:
    """Verified matches of all images.

    Attributes:
        cameras: the camera of each image; images that share a camera hold the same object.
        focal_length: estimated focal length, see `ImageCameras`.
        matched: keypoints, matches and two-view geometries, including those of links.
        links: report on the links.
        link_tracks: the links as tracks.
        track_lengths: int64 [num_tracks] number of images that observe each track.
        depth: whether the matches determine depth.
        warnings: warnings about the cameras and the links.
    """

    cameras: list[pycolmap.Camera]
    focal_length: float | None
    matched: MatchedImages
    links: LinkReport
    link_tracks: Tracks
    track_lengths: Ints
    depth: DepthEvidence
    warnings: tuple[str, ...]


def match_images(
    image_set: ImageSet,
    videos: Sequence[VideoTracks],
    cameras: Callable[[PairedImages], ImageCameras],
    pictures: Pictures,
    *,
    options: MatchOptions,
    context: RunContext,
    name: str,
    images_apart: float = 1.0,
) -> ImageMatches:
    """Match images along tracks, verify the matches, and link images that motion does not connect.

    Args:
        image_set: the images.
        videos: for each video, the tracks that are selected for matching; `image_set` may have
            only some of its images.
        cameras: returns the cameras of the images, which may depend on the matches.
        pictures: returns the pictures of images, for links.
        options: options of pairs, verification and links.
        context: its clock gets the stages "pairs", "verification" and "links".
        name: name of the videos in messages.
        images_apart: if the images are a selection, the number of images that each represents.

    Raises:
        VideoError: nothing connects any two images, or a single video is shorter than a track.
    """
    paired = pair_videos(image_set, videos, options, context, name)
    made = cameras(paired)
    matched = verify_images(paired, made.of_images, options.verify, context)
    linked = link_images(
        image_set,
        matched,
        made.of_images,
        np.concatenate([video.inter_share for video in videos]),
        pictures,
        fast=np.concatenate(
            [own.fast[image_set.of_video(k).frames] for k, own in enumerate(videos)]
        ),
        pairs=options.pairs,
        verify=options.verify,
        links=options.links,
        context=context,
        name=name,
        images_apart=images_apart,
    )
    with context.clock.measure("verification"):
        depth = depth_of_images(linked.matched, made.of_images)
    return ImageMatches(
        cameras=made.of_images,
        focal_length=made.focal_length,
        matched=linked.matched,
        links=linked.report,
        link_tracks=linked.tracks,
        track_lengths=paired.track_lengths,
        depth=depth,
        warnings=(*made.warnings, *linked.report.warnings),
    )


def pair_videos(
    image_set: ImageSet,
    videos: Sequence[VideoTracks],
    options: MatchOptions,
    context: RunContext,
    name: str,
) -> PairedImages:
    """Match the images of each video along its tracks, see `match_images`.

    Raises:
        VideoError: a single video is shorter than a track.
    """
    num_frames, least = videos[0].tracks.num_frames, least_length(options.tracks)
    if image_set.num_sequences == 1 and num_frames < least:
        shorter = ", or --min_length 2" if num_frames > 2 else ""
        raise VideoError(
            f"{name}: the video has {num_frames} frames, a track needs {least}: give a longer "
            f"video{shorter}"
        )
    choose = partial(schedule_pairs, options=options.pairs)
    with context.clock.measure("pairs"):
        paired = [
            pair_by_tracks(own.tracks, image_set.of_video(video).frames, choose, context.progress)
            for video, own in enumerate(videos)
        ]
        return join_videos(paired, image_set)
