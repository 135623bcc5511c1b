"""The stage that matches the key images along their tracks and writes their database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from numpy.typing import NDArray

from colmap_av1.database.writing import write_matches
from colmap_av1.geometry.cameras import assumes_focal_length
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.matching.cameras import ImageCameras, new_cameras
from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.match_images import ImageMatches, match_images, pair_videos
from colmap_av1.matching.matched_images import PairedImages
from colmap_av1.matching.two_view_geometry import TwoViewConfig
from colmap_av1.options import DensityOptions
from colmap_av1.poses.key_images import key_images_of_video
from colmap_av1.poses.run import Run
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage

_LINKS = "links.npz"


@dataclass(frozen=True)
class MatchesResult:
    """What `match_stage` found, apart from the database and the links it stores.

    Attributes:
        links: SIFT links across gaps and loop closures.
        warnings: warnings about cameras and links.
        key_images: indices of the key images.
        num_pose_tracks: number of motion tracks by which the key images are matched.
        assumes_video_focal_length: whether the focal length of a video is assumed; photos do not
            count.
        forward_motion: whether the camera moves along its optical axis, see `MatchReport`.
        depth: whether the matches determine depth.
        num_pairs: number of image pairs.
        num_flat_pairs: number of pairs that a homography explains.
        num_verified_pairs: number of pairs with a two-view geometry.
        keypoints_per_image: mean number of keypoints.
    """

    links: LinkReport
    warnings: tuple[str, ...]
    key_images: tuple[int, ...]
    num_pose_tracks: int
    assumes_video_focal_length: bool
    forward_motion: bool
    depth: DepthEvidence
    num_pairs: int
    num_flat_pairs: int
    num_verified_pairs: int
    keypoints_per_image: float


def _write_links(folder: Path, found: ImageMatches) -> None:
    folder.mkdir()
    gaps = found.links.frames_of_gaps("contradicted")
    contradicted = np.array([before for before, _ in gaps], np.int32)
    with (folder / _LINKS).open("wb") as file:
        np.savez(file, **vars(found.link_tracks), contradicted=contradicted)


def read_links(stages: Path) -> tuple[Tracks, NDArray[np.int32]]:
    """The links as tracks, and the frame before each contradicted gap, which no track crosses."""
    with np.load(stages / _LINKS) as file:
        return Tracks.from_arrays(file), file["contradicted"]


def matches_key(run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> list[Any]:
    """What the matches depend on, except `doubted`, for `run_stage`."""
    match, pose_options = run.options.match, run.options.poses
    return [
        [own.digest for own in videos],
        image_set.videos,
        run.photo_digests,
        (match.tracks, match.pairs, match.verify, match.camera, match.links),
        (_pose_density(run), pose_options.key_images),
        match.run.seed,
        run.positions.digest if run.positions is not None else None,
    ]


def match_stage(
    run: Run,
    videos: Sequence[VideoTracks],
    image_set: ImageSet,
    doubted: Sequence[int],
) -> Kept[MatchesResult]:
    """Match the key images by tracks and links, and write them to a database.

    Args:
        run: inputs and options of the run.
        videos: the tracks of each video.
        image_set: the images.
        doubted: frames, counted through the videos, with unreliable motion.
    """
    clock = run.clock
    videos = [
        own.doubted_at([f - first for f in doubted if 0 <= f - first < own.tracks.num_frames])
        for own, first in zip(videos, image_set.first_frame.tolist(), strict=False)
    ]

    def make(partial: Path) -> MatchesResult:
        with clock.measure("pairs"):
            index = _key_images(run, videos, image_set)
        keyed = image_set.some(index)
        found = _match_images(run, videos, image_set, index)
        cameras, matched = found.cameras, found.matched
        with clock.measure("database"):
            write_matches(
                partial / "database.db",
                keyed.images.names,
                cameras,
                matched,
                places=run.positions.places[index] if run.positions is not None else None,
            )
        _write_links(partial / run.stages.name, found)
        configs = [geometry.config for geometry in matched.geometries]
        num_keypoints = sum(len(k.xy) for k in matched.keypoints)
        return MatchesResult(
            links=found.links,
            warnings=found.warnings,
            key_images=tuple(index),
            num_pose_tracks=len(found.track_lengths),
            assumes_video_focal_length=assumes_focal_length(cameras[: keyed.photos.start]),
            forward_motion=matched.forward_motion,
            depth=found.depth,
            num_pairs=len(configs),
            num_flat_pairs=configs.count(TwoViewConfig.PLANAR_OR_PANORAMIC),
            num_verified_pairs=len(configs) - configs.count(TwoViewConfig.DEGENERATE),
            keypoints_per_image=num_keypoints / len(matched.keypoints),
        )

    return run_stage(
        run.stages,
        "matches",
        [matches_key(run, videos, image_set), list(doubted)],
        MatchesResult,
        into=run.output,
        products=["database.db", f"{run.stages.name}/{_LINKS}"],
        make=make,
    )


def _key_images(run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> list[int]:
    """Indices of the images that are mapped: the key images, or all if the option is off.

    All photos are key images, since no track connects them.
    """
    if not run.options.poses.key_images:
        return list(range(len(image_set.sequence)))
    index: list[int] = []
    for video, own in enumerate(videos):
        tracks = run.pose_tracks(own.tracks).keep_frames(own.chosen.frames)
        found = key_images_of_video(run, replace(own, tracks=tracks))
        index += (found + image_set.images_of(video).start).tolist()
    return [*index, *image_set.photos]


def _pose_density(run: Run) -> DensityOptions:
    """Density of the tracks that poses are estimated from."""
    pose_options = run.options.poses
    return DensityOptions(
        preset="sparse",
        max_tracks_per_image=pose_options.pose_tracks_per_image,
        spacing=pose_options.pose_spacing,
    )


def _selected_tracks(
    run: Run, videos: Sequence[VideoTracks], image_set: ImageSet
) -> list[VideoTracks]:
    """A spread selection of the tracks of each video that poses are estimated from."""
    density = _pose_density(run)
    selected = []
    for video, own in enumerate(videos):
        with run.clock.measure("pairs"):
            tracks = run.pose_tracks(own.tracks)
            sparse = select_tracks(tracks.keep_frames(image_set.of_video(video).frames), density)
        selected.append(replace(own, tracks=sparse))
    return selected


def _match_images(
    run: Run, videos: Sequence[VideoTracks], image_set: ImageSet, index: Sequence[int]
) -> ImageMatches:
    """Match the key images, given by their indices.

    Cameras are estimated from all images, since key images are too far apart for it.
    """
    options = run.options.match
    camera = options.camera
    if camera.single_camera is False:
        # Mappers rarely converge with many focal lengths. The adjustment gives images their own.
        camera = replace(camera, single_camera=None)
    context = run.context
    keyed = image_set.some(index)

    def cameras(paired: PairedImages) -> ImageCameras:
        if run.cameras is not None:
            return replace(run.cameras, of_images=[run.cameras.of_images[i] for i in index])
        shown, photos = run.shown, run.inputs.photos
        if camera.camera_params is not None or len(index) == len(image_set.sequence):
            return new_cameras(paired, keyed, shown, photos, camera, context=context)
        selected = _selected_tracks(run, videos, image_set)
        every = pair_videos(image_set, selected, options, context, run.inputs.name)
        made = new_cameras(every, image_set, shown, photos, camera, context=context)
        return replace(made, of_images=[made.of_images[i] for i in index])

    return match_images(
        keyed,
        _selected_tracks(run, videos, keyed),
        cameras,
        run.pictures(keyed),
        options=options,
        context=context,
        name=run.inputs.name,
        images_apart=image_set.photos.start / keyed.photos.start,
    )
