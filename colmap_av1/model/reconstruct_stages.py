"""The first stages of `reconstruct`: tracks, and a database of the images matched along them.

Each stage leaves what the next one, and a later run, resume from.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later

from colmap_av1.database.writing import write_matched_images
from colmap_av1.errors import ImageError, OptionError
from colmap_av1.images.camera import make_camera
from colmap_av1.images.choosing import ChosenImages, choose_images
from colmap_av1.matching.image_matches import (
    MatchedImages,
    pair_images,
    shared_focal_length,
    verify_images,
)
from colmap_av1.matching.two_view_geometry import TwoViewConfig
from colmap_av1.model.track_points import chaining_for_points
from colmap_av1.options import DensityOptions, ReconstructOptions
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks, keep_frames, keep_long_tracks, least_length
from colmap_av1.tracks.video_tracks import (
    VideoSource,
    decoded_pictures,
    times_of_frames,
    track_video,
)
from colmap_av1.util.digests import digest_if_there, file_digest
from colmap_av1.util.progress import Clock, Progress
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import check_unchanged

# A mapper may leave a bogus model of two images where it finds no start.
LEAST_IMAGES = 3


@dataclass(frozen=True)
class Run:
    """What every stage is given.

    Attributes:
        source: the video.
        output: the folder that is made.
        stages: the folder in it that holds what later runs resume from.
        options: options of every stage.
        clock: gets the time of each stage.
        progress: called in each stage.
    """

    source: VideoSource
    output: Path
    stages: Path
    options: ReconstructOptions
    clock: Clock
    progress: Progress


def track_stage(run: Run) -> Kept:
    """Chain the motion of the video into tracks and choose the frames that are images."""
    source, clock, progress = run.source, run.clock, run.progress
    options = chaining_for_points(run.options.match, run.options.triangulate)

    def make(partial: Path) -> dict[str, Any]:
        tracked = track_video(source, options, one_size=True, clock=clock, progress=progress)
        tracks = tracked.tracks
        with clock.measure("choice"):
            chosen = choose_images(
                pose_tracks(run, tracks),
                options.images,
                existing=(),
                folder=partial,
                times=lambda: times_of_frames(source, tracks.num_frames),
                decode=lambda: decoded_pictures(source, options),
            )
        if len(chosen.names) < LEAST_IMAGES:
            raise ImageError(
                f"{len(chosen.names)} of {tracks.num_frames} frames become images: a model needs "
                f"{LEAST_IMAGES} or more"
            )
        unfit = next((n for n in chosen.names if "/" in n or n.count(".") != 1), None)
        if unfit is not None:
            raise OptionError(f"image '{unfit}': trainers want a flat name with one dot")
        with (partial / "tracks.npz").open("wb") as file:
            # Names are kept by np.savez as they are.
            np.savez(file, **vars(tracks), names=np.array(chosen.names), frames=chosen.frames)
        check_unchanged(*source.files)
        return {
            "num_frames": tracks.num_frames,
            "num_images": len(chosen.names),
            "num_tracks": len(tracks.offsets) - 1,
            "warnings": list(tracked.warnings),
        }

    given = (options.images, options.read, options.tracks, options.refine)
    listed = digest_if_there(options.images.frame_list)
    return run_stage(
        run.stages,
        "tracks",
        [[file_digest(file.path) for file in source.files], given, listed],
        into=run.stages,
        products=["tracks.npz"],
        make=make,
    )


def read_tracks(stages: Path) -> tuple[Tracks, ChosenImages]:
    """The tracks and images that `track_stage` kept."""
    with np.load(stages / "tracks.npz") as file:
        arrays = {field.name: file[field.name] for field in dataclasses.fields(Tracks)}
        chosen = ChosenImages([str(name) for name in file["names"]], file["frames"])
    for name in ("num_frames", "width", "height"):
        arrays[name] = int(arrays[name])
    return Tracks(**arrays), chosen


def pose_tracks(run: Run, tracks: Tracks) -> Tracks:
    """The tracks that poses are estimated from; short ones are for points only."""
    return keep_long_tracks(tracks, least_length(run.options.match.tracks))


def match_stage(run: Run, tracks: Tracks, chosen: ChosenImages, tracked: Kept) -> Kept:
    """Write the database of the tracks that the poses come from."""
    options, clock, progress = run.options, run.clock, run.progress
    density = DensityOptions(
        preset="sparse",
        max_tracks_per_image=options.mapping.pose_tracks_per_image,
        spacing=options.mapping.pose_spacing,
    )

    def make(partial: Path) -> dict[str, Any]:
        with clock.measure("pairs"):
            sparse = select_tracks(keep_frames(tracks, chosen.frames), density)
        video = run.source.pictures
        paired = pair_images(
            video.path, sparse, chosen, options.match, clock=clock, progress=progress
        )
        size = (tracks.width, tracks.height)
        pixel_aspect = video.display.pixel_aspect
        focal_length = shared_focal_length(paired, size, pixel_aspect, options.match, clock=clock)
        camera = make_camera(options.match.camera, *size, pixel_aspect, focal_length)
        matched = verify_images(paired, camera, options.match, clock=clock, progress=progress)
        with clock.measure("database"):
            write_matched_images(partial / "database.db", chosen.names, camera, matched)
        return {
            "num_pose_tracks": len(sparse.offsets) - 1,
            "guessed": not camera.has_prior_focal_length,
            **_pair_facts(matched),
        }

    given = (density, options.match.pairs, options.match.verify, options.match.camera)
    return run_stage(
        run.stages,
        "matches",
        [tracked.digest, given, options.match.run.seed],
        into=run.output,
        products=["database.db"],
        make=make,
    )


def _pair_facts(matched: MatchedImages) -> dict[str, Any]:
    """What explains why a mapper finds no start."""
    configs = [geometry.config for geometry in matched.geometries]
    return {
        "forward_motion": matched.forward_motion,
        "num_pairs": len(configs),
        "num_flat_pairs": configs.count(TwoViewConfig.PLANAR_OR_PANORAMIC),
        "num_verified_pairs": len(configs) - configs.count(TwoViewConfig.DEGENERATE),
        "keypoints_per_image": sum(len(k.xy) for k in matched.keypoints) / len(matched.keypoints),
    }
