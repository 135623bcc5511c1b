"""The stage that bundle-adjusts the poses of all images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.geometry.cameras import has_long_focal_length
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import DensityOptions, TriangulateOptions
from colmap_av1.poses.adjusting import (
    FOCAL_LENGTH_ERROR,
    Adjusted,
    adjust_posed,
    focal_length_errors,
    refines_intrinsics,
    without_sparse_images,
)
from colmap_av1.poses.corners.in_images import corners_in_images
from colmap_av1.poses.dynamic.following import follow_occluded, has_changing_masks
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.posed_images import (
    FOR_POSES,
    FROM_PICTURES,
    PosedImages,
    PosesResult,
    check_agreement,
    read_posed_images,
    triangulate_in,
)
from colmap_av1.poses.run import Run
from colmap_av1.poses.seams import model_seams
from colmap_av1.poses.zoom import with_own_cameras
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage

# The selection of tracks for bundle adjustment.
_ADJUSTED = DensityOptions(
    preset="sparse", max_tracks_per_image=500, spacing=12.0, min_images=3, max_sigma=0.0
)
# If corners are used as well, every second motion track is kept, cut into pieces of eight images.
# Motion tracks are less accurate than corners, their errors are correlated, and they drift: over
# twenty images by three times as much as over three, which bends the model.
_NTH_WITH_CORNERS = 2
_LENGTH_WITH_CORNERS = 8
# From this many images on, an iterative solver is faster if the scale is well determined: it takes
# 10 instead of 20 CPU s for 300 images, with the same accuracy. In walks with fast turns it takes
# three times as long as a direct one.
_ITERATIVE_IMAGES = 200
# On a drive with an assumed focal length, the cost hardly decreases while the focal length moves to
# its true value: with the usual steps it stops 38 % away from it, with these 1 %. Where the images
# do not determine it, the usual steps are better, because they stop near the assumed one.
_ASSUMED_STEPS, _ASSUMED_TOLERANCE = 200, 1e-7
# Corners determine the pose of an image, so motion tracks with larger errors are rejected.
_WITH_CORNERS = replace(FOR_POSES, max_reprojection_error=0.3)


@dataclass(frozen=True)
class AdjustedResult(PosesResult):
    """Result of `adjustment_stage`.

    Attributes:
        num_motion_points: number of points of motion tracks. They come first; points of links, then
            those of corners follow.
        num_link_points: number of points of links.
        doubtful_seams: names of the images before and after each of `Seams.doubtful`.
        few_point_seams: names of the images before and after each of `Seams.few_points`.
        scale_lost_seams: names of the images before and after each of `Seams.worst_scale_lost`.
        usual_scaled: see `Seams.usual_scaled`.
        seams_warning: see `Seams.disconnected_warning`.
        keeps_assumed_focal_length: whether the adjustment started from a default focal length, and
            the images hardly determine another.
        has_long_focal_length: whether the focal length of a camera was refined, and is longer than
            in most videos.
    """

    num_motion_points: int
    num_link_points: int
    doubtful_seams: tuple[tuple[str, str], ...]
    few_point_seams: tuple[tuple[str, str], ...]
    scale_lost_seams: tuple[tuple[str, str], ...]
    usual_scaled: float
    seams_warning: str | None
    keeps_assumed_focal_length: bool
    has_long_focal_length: bool


def adjustment_stage(
    run: Run,
    tracks: EstimateTracks,
    image_set: ImageSet,
    poses: Kept[PosesResult],
    *,
    is_fast: bool = False,
    is_assumed: bool = False,
    number: int = 1,
) -> Kept[AdjustedResult]:
    """Bundle-adjust the poses with a robust loss, on long tracks that cover the images evenly.

    All links get points: without them places that are seen again would drift apart. Corners of the
    pictures correct poses that motion misleads, as at a jerk of the camera. `adjust_posed` selects
    observations of points that have many.

    Args:
        run: the run.
        tracks: the tracks of all videos, without dynamic pixels.
        image_set: the images.
        poses: the stage with the initial poses.
        is_fast: the camera turns fast somewhere, so that the scale may be poorly determined.
        is_assumed: the adjustment starts from a default focal length, so it needs more steps.
        number: number of the adjustment in the run, which names its files.
    """
    options = run.options
    suffix = f"_{number}" if number > 1 else ""
    refine = refines_intrinsics(options)
    has_gaps = bool(tracks.dynamic_masks) or has_changing_masks(image_set)

    def make(partial: Path) -> AdjustedResult:
        registered = read_posed_images(run, poses, image_set.masked_by(tracks.dynamic_masks))
        # Not kept in a variable: the long tracks need several times the memory of the selection.
        spread = select_tracks(
            run.pose_tracks(tracks.motion).keep_frames(registered.frames), _ADJUSTED
        )
        if tracks.has_picture_positions and has_gaps:
            with run.clock.measure("refinement"):
                spread = follow_occluded(run, spread, registered)
        linked = tracks.link_tracks.keep_frames(registered.frames)
        sets = [(spread, FOR_POSES), (linked, FOR_POSES)]  # motion tracks and links come first
        if tracks.has_picture_positions:
            with run.clock.measure("refinement"):
                guide = Tracks.concatenate(spread, linked)
                followed, registered = corners_in_images(run, guide, registered)
            few = spread.every_nth(_NTH_WITH_CORNERS).split_to_length(_LENGTH_WITH_CORNERS)
            sets = [(few, _WITH_CORNERS), (linked, FROM_PICTURES), (followed, FROM_PICTURES)]
        with run.clock.measure("adjustment"):
            points = [_triangulated_points(run, registered, some, limits) for some, limits in sets]
            check_agreement(sum(len(part.xyz) for part in points), spread.num_tracks)
            run.progress("adjustment", 0, 1)
            model = replace(registered.model, points=ModelPoints.concatenate(points))
            iterative = len(model.images) >= _ITERATIVE_IMAGES and not is_fast
            adjusted = adjust_posed(run, model, iterative=iterative)
            is_long = any(map(has_long_focal_length, adjusted.model.cameras.values()))
            converged = None
            if is_assumed and refine and not is_long:
                converged = _converged(run, adjusted, iterative=iterative)
                adjusted = converged or adjusted
            run.progress("adjustment", 1, 1)
            trimmed = without_sparse_images(adjusted.model)
        names = image_set.images.names
        photos = names[image_set.photos.start :]
        seams = model_seams(trimmed.model, names, photos)
        with run.clock.measure("adjustment"):
            final = with_own_cameras(run, trimmed.model)
        kept = adjusted.kept_points[trimmed.kept_points][final.kept_points]
        num_motion, num_links = (len(part.xyz) for part in points[:2])
        result = final.model
        write_posed_model(partial / f"adjusted{suffix}.npz", result)
        return AdjustedResult(
            poses=f"adjusted{suffix}.npz",
            num_registered=len(result.images),
            num_motion_points=int((kept < num_motion).sum()),
            num_link_points=int(((kept >= num_motion) & (kept < num_motion + num_links)).sum()),
            doubtful_seams=tuple(seams.pairs[i] for i in seams.doubtful),
            few_point_seams=tuple(seams.pairs[i] for i in seams.few_points),
            scale_lost_seams=tuple(seams.pairs[i] for i in seams.worst_scale_lost),
            usual_scaled=seams.usual_scaled,
            # No warning about a lost scale: the model is split there, see `parts`.
            seams_warning=seams.disconnected_warning,
            keeps_assumed_focal_length=is_assumed and converged is None,
            has_long_focal_length=refine
            and any(map(has_long_focal_length, result.cameras.values())),
        )

    given = (refine, options.poses.mapper_threads, run.context.seed)
    return run_stage(
        run.stages,
        f"adjustment{suffix}",
        [
            poses.digest,
            given,
            options.match.camera.single_camera,
            tracks.has_picture_positions,
            tracks.masks_digest,
        ],
        AdjustedResult,
        products=[f"adjusted{suffix}.npz"],
        make=make,
    )


def _converged(run: Run, adjusted: Adjusted, *, iterative: bool) -> Adjusted | None:
    """A model adjusted further; None if even then it does not determine all focal lengths."""
    further = adjust_posed(
        run,
        adjusted.model,
        log="focal_length.log",
        max_steps=_ASSUMED_STEPS,
        tolerance=_ASSUMED_TOLERANCE,
        iterative=iterative,
    )
    if max(focal_length_errors(further.model).values()) >= FOCAL_LENGTH_ERROR:
        return None
    return Adjusted(further.model, adjusted.kept_points[further.kept_points])


def _triangulated_points(
    run: Run, registered: PosedImages, tracks: Tracks, options: TriangulateOptions
) -> ModelPoints:
    """Triangulated points of tracks in the registered images, without colours."""
    return triangulate_in(run, registered, tracks, options).model_points()
