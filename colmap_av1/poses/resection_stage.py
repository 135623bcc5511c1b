"""The stage that estimates the poses of the images between the key images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_av1.geometry.colmap_model import ModelImage
from colmap_av1.geometry.posed_model import PosedModel, write_posed_model
from colmap_av1.geometry.resection import interpolate_poses, resect, sightings_of
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import DensityOptions
from colmap_av1.poses.posed_images import (
    FOR_POSES,
    PosedImages,
    PosesResult,
    read_posed_images,
    triangulate_in,
)
from colmap_av1.poses.run import Run
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import progress_in
from colmap_av1.util.stages import Kept, run_stage

# The selection of tracks for resection, and the fewest views of a point by key images.
_RESECTED = DensityOptions(
    preset="sparse", max_tracks_per_image=500, spacing=16.0, min_images=3, max_sigma=0.0
)
_FEWEST_VIEWS = 3


def resection_stage(
    run: Run, tracks: Tracks, image_set: ImageSet, keyed: ImageSet, poses: Kept[PosesResult]
) -> Kept[PosesResult]:
    """Estimate the poses of the images between the key images by resection."""

    def make(partial: Path) -> PosesResult:
        known = read_posed_images(run, poses, keyed)
        with run.clock.measure("resection"):
            images = _resect(run, tracks, image_set, known)
        model = PosedModel(known.cameras, images)
        write_posed_model(partial / "resected.npz", model)
        return PosesResult("resected.npz", len(images))

    return run_stage(
        run.stages,
        "resection",
        [poses.digest, image_set.images.names, run.context.seed],
        PosesResult,
        products=["resected.npz"],
        make=make,
    )


def _resect(run: Run, tracks: Tracks, image_set: ImageSet, known: PosedImages) -> list[ModelImage]:
    """The key images with a pose, and the images between them that get one."""
    seen_thrice = run.pose_tracks(tracks).keep_observed_in(known.frames, _FEWEST_VIEWS)
    spread = select_tracks(seen_thrice.keep_frames(image_set.images.frames), _RESECTED)
    with_points = triangulate_in(run, known, spread, FOR_POSES)
    pose_of = {
        frame: (image.camera_id, image.cam_from_world)
        for frame, image in zip(known.frames.tolist(), known.images, strict=True)
    }
    for video in range(len(image_set.videos)):
        own, images = known.of_video(video), image_set.images_of(video)
        left = np.setdiff1d(image_set.images.frames[images.start : images.stop], own.frames)
        if len(own.images) == 0 or len(left) == 0:
            continue
        nearest = np.abs(own.frames[:, None] - left).argmin(axis=0)
        camera_ids = [own.images[i].camera_id for i in nearest]
        cameras = [known.cameras[camera_id] for camera_id in camera_ids]
        guesses = interpolate_poses(
            np.array([image.cam_from_world for image in own.images]), own.frames, left
        )
        found = resect(
            sightings_of(with_points, spread, left, cameras),
            guesses,
            np.array([camera.mean_focal_length() for camera in cameras]),
            seed=run.context.seed,
            num_threads=run.context.num_threads,
            progress=progress_in(run.progress, "resection", len(left)),
        )
        pose_of |= {
            frame: (camera_id, pose)
            for frame, camera_id, pose in zip(left.tolist(), camera_ids, found, strict=True)
            if pose is not None
        }
    return [
        ModelImage(i + 1, name, *pose_of[frame])
        for i, (name, frame) in enumerate(
            zip(image_set.images.names, image_set.images.frames.tolist(), strict=True)
        )
        if frame in pose_of
    ]
