"""The first stage of `reconstruct`: the tracks of each video, and its frames that become images."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, OptionError
from colmap_av1.geometry.track_points import chaining_for_points
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.key_images import spread_images
from colmap_av1.images.names import image_names
from colmap_av1.images.track_images import (
    ImageChoice,
    TrackedImages,
    VideoTracks,
    track_chosen_images,
    track_images,
)
from colmap_av1.matching.shutter.correct import correct_rolling_shutter, shutter_settings
from colmap_av1.options import RefineOptions, TrackingOptions
from colmap_av1.poses.key_images import key_images_of_video
from colmap_av1.poses.mapper import LEAST_IMAGES
from colmap_av1.poses.run import Run
from colmap_av1.tracks.fast_frames import fast_frames
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import TrackedVideo, count_frames
from colmap_av1.util.digests import digest_if_there, file_digest
from colmap_av1.util.progress import Clock
from colmap_av1.util.spread import evenly_spread
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import check_unchanged

# Candidate frames per image of a long video.
_CANDIDATES = 2
# Largest number of observations in candidate frames that are held in memory, and the assumed number
# of pixels per observation.
_MAX_HELD = 24_000_000
_PIXELS_PER_OBSERVATION = 16
# Images of a long video are chosen by every fourth track, or by tracks seeded in squares of this
# width in pixels: a quarter of the tracks that poses are estimated from.
_FEWER = 4
_SEEDING = 8


@dataclass(frozen=True)
class TracksResult:
    """What `track_stage` found, apart from the tracks it stores.

    Attributes:
        num_frames: number of shown frames of the video.
        num_tracks: number of its tracks.
        read_out: read-out time in milliseconds of the rolling shutter that tracks were corrected
            for; None if they were not.
        warnings: warnings about the video.
    """

    num_frames: int
    num_tracks: int
    read_out: float | None
    warnings: tuple[str, ...]


def stage_of_video(run: Run, video: int) -> str:
    """Name of the track stage of a video."""
    label = run.inputs.labels[video]
    return f"tracks_{label}" if label else "tracks"


def track_stage(run: Run, video: int) -> Kept[TracksResult]:
    """Chain the motion of a video into tracks and choose the frames that are images."""
    source, options = run.sources[video], run.options.match
    chaining = chaining_for_points(
        options.tracks, run.options.triangulate, is_downscaled=source.is_downscaled
    )
    tracking = replace(options.tracking, tracks=chaining)
    name = stage_of_video(run, video)
    count = 0 if options.images.ways else count_frames(source, options.read)
    is_long = count > run.options.max_images

    def make(partial: Path) -> TracksResult:
        if is_long:
            found = _track_long(run, video, tracking, count)
        else:
            found = track_chosen_images(
                source,
                tracking,
                ImageChoice(options.images, folder=partial),
                masks=run.inputs.masks_of_videos[video],
                every_frame=options.camera.needs_every_frame,
                context=run.context,
            )
        chosen = found.chosen
        tracked = correct_rolling_shutter(
            found.video,
            run.shown[video],
            source.pictures.frame_rate,
            options.camera,
            run.context,
        )
        tracks = tracked.tracks
        if is_long:  # Later stages need no other frames of a long video.
            tracks = tracks.keep_frames(chosen.frames)
        _check_chosen(run, chosen, tracks.num_frames)
        with (partial / f"{name}.npz").open("wb") as file:
            np.savez(
                file,
                **vars(tracks),
                names=np.array(chosen.names),  # np.savez keeps names as they are
                frames=chosen.frames,
                inter_share=tracked.inter_share,
                fast=found.fast,
            )
        check_unchanged(*source.files)
        return TracksResult(
            num_frames=tracks.num_frames,
            num_tracks=tracks.num_tracks,
            read_out=tracked.read_out,
            warnings=tracked.warnings,
        )

    pose_options = run.options.poses
    # The images of a long video are chosen by the tracks that poses are estimated from, and include
    # those that links need.
    choice = (
        run.options.max_images,
        pose_options.pose_tracks_per_image,
        pose_options.pose_spacing,
        options.links,
    )
    shutter = shutter_settings(options.camera)
    given = (options.images, options.read, options.tracks, chaining, options.refine)
    listed = digest_if_there(options.images.frame_list)
    masked = run.inputs.masks.digest if run.inputs.masks is not None else None
    return run_stage(
        run.stages,
        name,
        [
            [file_digest(file.path) for file in source.files],
            given,
            choice if is_long else None,
            shutter,
            options.run.seed,
            listed,
            masked,
        ],
        TracksResult,
        products=[f"{name}.npz"],
        make=make,
    )


def _track_long(run: Run, video: int, options: TrackingOptions, count: int) -> TrackedImages:
    """Track a video with more frames than `max_images`, and keep the chosen images only.

    The images are chosen from evenly spread candidate frames. The motion is read twice, first with
    few tracks for the choice alone, if the tracks in all candidates need too much memory, or if the
    rolling shutter is corrected or tracks are refined, both of which need other frames.
    """
    source = run.sources[video]
    candidates = np.array(evenly_spread(count, _CANDIDATES * run.options.max_images), np.int32)
    width, height = source.stream.picture_size
    held = len(candidates) * width * height / _PIXELS_PER_OBSERVATION
    every_frame = run.options.match.camera.needs_every_frame
    track = functools.partial(track_images, source, masks=run.inputs.masks_of_videos[video])

    if options.refine.refine == "none" and not every_frame and held <= _MAX_HELD:

        def choose(tracked: TrackedVideo) -> ChosenImages:
            few = tracked.tracks.every_nth(_FEWER)
            return _spread_in(run, replace(tracked, tracks=few), candidates)

        return track(options, choose, frames=candidates, context=run.context)

    with run.clock.measure("choice"):
        chosen = track(
            TrackingOptions(
                options.read, replace(run.options.match.tracks, seeding=_SEEDING), RefineOptions()
            ),
            lambda tracked: _spread_in(run, tracked, candidates),
            frames=candidates,
            refine=False,
            context=replace(run.context, clock=Clock()),
        ).chosen
    return track(
        options,
        lambda _: chosen,
        frames=None if every_frame else chosen.frames,
        context=run.context,
    )


def _spread_in(run: Run, tracked: TrackedVideo, candidates: NDArray[np.int32]) -> ChosenImages:
    """Choose up to `max_images` of the candidate frames, including the key images."""
    tracks = tracked.tracks
    candidates = candidates[candidates < tracks.num_frames]
    names = image_names(run.options.match.images.file_name, candidates.tolist())
    every = ChosenImages(names, candidates)
    video = TrackedImages(tracked, every, fast_frames(tracked.ends))
    key = key_images_of_video(run, video.for_matching)
    most = min(run.options.max_images, len(candidates))
    return every.some(spread_images(tracks.subsample_frames(candidates), most, key))


def _check_chosen(run: Run, chosen: ChosenImages, num_frames: int) -> None:
    """Check that there are enough images for a model, and that trainers accept their names."""
    if len(run.sources) == 1 and len(chosen.names) + len(run.inputs.photos) < LEAST_IMAGES:
        raise ImageError(
            f"{len(chosen.names)} of {num_frames} frames become images: a model needs "
            f"{LEAST_IMAGES} or more"
        )
    unfit = next((n for n in chosen.names if "/" in n or n.count(".") != 1), None)
    if unfit is not None:
        raise OptionError(f"image '{unfit}': trainers need a name without folders and with one dot")


def read_tracks(run: Run, video: int, stage: Kept[TracksResult]) -> VideoTracks:
    """The tracks and images of a video that `track_stage` stored."""
    with np.load(run.stages / f"{stage_of_video(run, video)}.npz") as file:
        return VideoTracks(
            Tracks.from_arrays(file),
            ChosenImages([str(name) for name in file["names"]], file["frames"]),
            file["inter_share"],
            file["fast"],
            stage.result.read_out,
            stage.digest,
        )


def read_tracks_only(run: Run, video: int) -> Tracks:
    """The tracks of a video that `track_stage` stored, without its images."""
    with np.load(run.stages / f"{stage_of_video(run, video)}.npz") as file:
        return Tracks.from_arrays(file)
