"""The stage that finds dynamic pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_av1.geometry.masks import Mask
from colmap_av1.geometry.posed_camera import views_of
from colmap_av1.geometry.track_points import chaining_for_points, triangulate_tracks
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.masks import mask_tracks
from colmap_av1.images.track_images import MIN_IMAGES
from colmap_av1.options import DensityOptions, TriangulateOptions
from colmap_av1.poses.dynamic.contradictions import tracks_in_cells
from colmap_av1.poses.dynamic.regions import dynamic_cells, mask_of_cells
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.posed_images import PosedImages, PosesResult, read_posed_images
from colmap_av1.poses.run import Run
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.util.stages import Kept, run_stage

_FILE = "dynamic.npz"
# Width in pixels of a cell, of which one track is examined, in pictures of up to the usual width.
# Larger pictures have proportionally larger cells.
_CELL = 8
_USUAL_WIDTH = 960
# Fewest images of a track that is examined, and of a video.
_MIN_IMAGES = 4
# Fewest images of a link.
_MIN_LINKED = 2


@dataclass(frozen=True)
class DynamicResult:
    """What `dynamic_stage` found, apart from the masks it stores.

    Attributes:
        share: share of dynamic pixels in all images.
    """

    share: float


def dynamic_stage(
    run: Run, tracks: Tracks, image_set: ImageSet, poses: Kept[PosesResult]
) -> Kept[DynamicResult]:
    """Find the dynamic regions of each image."""

    def make(partial: Path) -> DynamicResult:
        registered = read_posed_images(run, poses, image_set)
        found: dict[str, Mask] = {}
        with run.clock.measure("dynamic"):
            for video in range(len(image_set.videos)):
                own = registered.of_video(video)
                if len(own.images) >= _MIN_IMAGES:
                    found |= _dynamic_masks(run, tracks, own)
                run.progress("dynamic", video + 1, len(image_set.videos))
        _write(partial / _FILE, found)
        share = sum(1.0 - mask.share for mask in found.values()) / len(registered.images)
        return DynamicResult(share)

    return run_stage(
        run.stages,
        "dynamic",
        [poses.digest],
        DynamicResult,
        products=[_FILE],
        make=make,
    )


def without_dynamic(
    run: Run, tracks: EstimateTracks, image_set: ImageSet, dynamic: Kept[DynamicResult]
) -> EstimateTracks:
    """The tracks without the dynamic pixels that a stage found, and with its masks."""
    masks = _read_dynamic_masks(run.stages)
    if not masks:
        return tracks
    return replace(
        tracks,
        motion=without_dynamic_tracks(tracks.motion, image_set, masks, run),
        link_tracks=without_dynamic_links(tracks.link_tracks, image_set, masks),
        dynamic_masks=masks,
        masks_digest=dynamic.digest,
    )


def _read_dynamic_masks(stages: Path) -> dict[str, Mask]:
    """Masks that exclude dynamic pixels, by image name; only of images that have such pixels."""
    with np.load(stages / _FILE) as file:
        packed = np.split(file["packed"], file["ends"][:-1]) if len(file["names"]) else []
        return {
            str(name): Mask((int(size[0]), int(size[1])), part.tobytes(), float(share))
            for name, size, share, part in zip(
                file["names"], file["sizes"], file["shares"], packed, strict=True
            )
        }


def without_dynamic_tracks(
    tracks: Tracks, image_set: ImageSet, dynamic_masks: Mapping[str, Mask], run: Run
) -> Tracks:
    """The tracks of all sequences outside dynamic pixels, see `mask_tracks`."""
    images = image_set.images
    by_frame = {
        frame: dynamic_masks[name]
        for frame, name in zip(images.frames.tolist(), images.names, strict=True)
        if name in dynamic_masks
    }
    if not by_frame:
        return tracks
    options = chaining_for_points(run.options.match.tracks, run.options.triangulate)
    # Tracks may be kept in the images only, so frames without an observation count as well.
    masked = mask_tracks(tracks, by_frame, MIN_IMAGES, scaled=False)
    return masked.keep_lasting(least_length(options))


def without_dynamic_links(
    links: Tracks, image_set: ImageSet, dynamic_masks: Mapping[str, Mask]
) -> Tracks:
    """The links without observations on dynamic pixels.

    Unlike a track of motion, a link says nothing about the frames between two of its observations.
    """
    images = image_set.images
    kept = np.ones(links.num_observations, np.bool_)
    by_frame = links.by_frame()
    for frame, name in zip(images.frames.tolist(), images.names, strict=True):
        if name in dynamic_masks:
            mask, own = dynamic_masks[name], by_frame[frame]
            kept[own] = mask.keeps(links.xy[own], mask.size)
    return links.keep_observations(kept).keep_long(_MIN_LINKED)


def _write(path: Path, masks: Mapping[str, Mask]) -> None:
    parts = [np.frombuffer(mask.packed, np.uint8) for mask in masks.values()]
    with path.open("wb") as file:
        np.savez(
            file,
            names=np.array(list(masks)),
            sizes=np.array([mask.size for mask in masks.values()]).reshape(-1, 2),
            shares=np.array([mask.share for mask in masks.values()]),
            ends=np.cumsum([len(part) for part in parts], dtype=np.int64),
            packed=np.concatenate([np.empty(0, np.uint8), *parts]),
        )


def _dynamic_masks(run: Run, tracks: Tracks, registered: PosedImages) -> dict[str, Mask]:
    """Masks that exclude dynamic pixels from the images of a video, by image name."""
    num_threads = run.context.num_threads
    views = views_of(registered.images, registered.cameras)
    size = views[0].size
    cell = _CELL * max(1, round(max(size) / _USUAL_WIDTH))
    spread = DensityOptions(
        preset="sparse",
        max_tracks_per_image=0,
        spacing=float(cell),
        min_images=_MIN_IMAGES,
        max_sigma=0.0,
        wide_tracks=0,
    )
    # The limits are loose, so that slightly drifting and slowly moving tracks get points too.
    how = TriangulateOptions(
        max_reprojection_error=float(cell), min_angle=0.0, max_depth_error=None, points="survey"
    )
    found = triangulate_tracks(
        select_tracks(tracks.keep_frames(registered.frames), spread),
        registered.frames,
        views,
        options=how,
        num_threads=num_threads,
    )
    if len(found.view) == 0:
        return {}
    in_cells = tracks_in_cells(found, views, cell)
    cells = dynamic_cells(in_cells, views, num_threads=num_threads)
    return {
        image.name: mask_of_cells(dynamic, cell, size)
        for image, dynamic in zip(registered.images, cells, strict=True)
        if dynamic.any()
    }
