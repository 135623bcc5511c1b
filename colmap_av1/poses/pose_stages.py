"""The stages of the joint estimate: COLMAP's mapper, resection, bundle adjustment."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import has_long_focal_length
from colmap_av1.geometry.colmap_model import (
    ModelImage,
    ModelPoints,
    joined_points,
    read_model,
    write_model,
)
from colmap_av1.geometry.posed_model import (
    PosedModel,
    posed_model,
    read_posed_model,
    write_posed_model,
)
from colmap_av1.geometry.resection import interpolate_poses, resect, sightings_of
from colmap_av1.geometry.track_points import seen_in, to_model_points
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import DensityOptions, MapOptions, TriangulateOptions
from colmap_av1.poses.adjusting import (
    LOSS_SCALES,
    OBSERVATIONS,
    SECOND_DISTORTION,
    adjust_posed,
    refines_intrinsics,
    with_second_distortion,
)
from colmap_av1.poses.mapper import FEW_SEEN, map_poses, without_unseen_images
from colmap_av1.poses.match_stage import MatchesResult
from colmap_av1.poses.posed_images import (
    FOR_POSES,
    PosedImages,
    PosesResult,
    check_agreement,
    read_posed_images,
    registered_by_video,
    triangulate_in,
)
from colmap_av1.poses.run import Run
from colmap_av1.poses.seams import model_seams
from colmap_av1.poses.start_tracks import START_TRACKS, keep_start_tracks
from colmap_av1.poses.track_stage import LEAST_IMAGES, pose_tracks
from colmap_av1.poses.zoom import with_own_cameras
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.digests import digest_of
from colmap_av1.util.progress import progress_in
from colmap_av1.util.stages import Kept, run_stage

# With fewer tracks per image than this, a failed initialization is blamed on the tracks.
_FEW_TRACKS = 100
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
# The selection of tracks for resection, and the fewest views of a point by key images.
_RESECTED = DensityOptions(
    preset="sparse", max_tracks_per_image=500, spacing=16.0, min_images=3, max_sigma=0.0
)
_FEWEST_VIEWS = 3
# Corners determine the pose of an image, so motion tracks with larger errors are rejected. Corners
# and links keep large errors, because these are errors of the poses: of a rolling shutter, or where
# the model is bent.
_WITH_CORNERS = replace(FOR_POSES, max_reprojection_error=0.3)
FROM_PICTURES = replace(FOR_POSES, max_reprojection_error=8.0)


@dataclass(frozen=True)
class MappedResult(PosesResult):
    """Result of `pose_stage`.

    Attributes:
        mapper: the mapper of COLMAP that estimated the poses.
        other_models: files of further models, which are not connected to the first.
    """

    mapper: str
    other_models: tuple[str, ...]


@dataclass(frozen=True)
class AdjustedResult(PosesResult):
    """Result of `adjustment_stage`.

    Attributes:
        num_motion_points: number of points of motion tracks. They come first; points of corners
            and links follow.
        doubtful_seams: names of the images before and after each of `Seams.doubtful`.
        few_point_seams: names of the images before and after each of `Seams.few_points`.
        scale_lost_seams: names of the images before and after each of `Seams.worst_scale_lost`.
        usual_scaled: see `Seams.usual_scaled`.
        seams_warning: see `Seams.disconnected_warning`.
        has_long_focal_length: whether the focal length of a camera was refined, and is longer than
            in most videos.
    """

    num_motion_points: int
    doubtful_seams: tuple[tuple[str, str], ...]
    few_point_seams: tuple[tuple[str, str], ...]
    scale_lost_seams: tuple[tuple[str, str], ...]
    usual_scaled: float
    seams_warning: str | None
    has_long_focal_length: bool


def pose_stage(
    run: Run, matched: Kept[MatchesResult], image_set: ImageSet, keyed: ImageSet
) -> Kept[MappedResult]:
    """Estimate the poses of the key images with COLMAP's mapper."""
    options, clock, progress = run.options, run.clock, run.progress
    mapping = options.mapping
    found_before = matched.result
    forward = found_before.forward_motion
    mappers: list[Literal["incremental", "global"]]
    if mapping.mapper != "auto":
        mappers = [mapping.mapper]
    else:
        # The global mapper needs the focal length. A zoom would mislead its estimate.
        mappers = (
            ["incremental"] if found_before.assumes_focal_length else ["global", "incremental"]
        )
    links = found_before.links
    reasons = {reason for gap in links.gaps for reason in gap.reasons}
    depends_on_links = links.num_between or reasons & {"contradicted", "few tracks"}
    # Where poses depend on links, walks with fast turns bend if the mapper ends early.
    ends_early = mapping.adjust and not depends_on_links
    attempts = [
        MapOptions(
            mapper=mapper,
            forward_motion=forward and mapper == "incremental",
            refine_intrinsics=refines_intrinsics(options),
            seed=options.match.run.seed,
            num_threads=mapping.mapper_threads,
        )
        for mapper in mappers
    ]

    def map_with(map_options: MapOptions, database: Path) -> list[PosedModel]:
        with tempfile.TemporaryDirectory() as models:
            sizes = map_poses(
                database,
                Path(models),
                map_options,
                image_path=None,
                log=run.stages / "mapper.log",
                num_images=len(keyed.images.names),
                progress=progress,
                ends_early=ends_early,
            )
            found = [
                posed_model(read_model(Path(models) / str(number)), with_points=True)
                for number, size in enumerate(sizes)
                if size >= LEAST_IMAGES
            ]
        return [with_second_distortion(run, model) for model in found]

    def make(partial: Path) -> MappedResult:
        with clock.measure("poses"):
            for attempt in attempts:
                # pycolmap migrates the databases that it opens to its own layout.
                database = partial / f"{attempt.mapper}.db"
                shutil.copyfile(run.output / "database.db", database)
                if attempt.mapper == "global" and mapping.adjust:
                    keep_start_tracks(database)
                try:
                    found = map_with(attempt, database)
                except ModelError:
                    if attempt is attempts[-1]:
                        raise
                    continue
                if found:
                    break
        if not found:
            raise ModelError(_why_no_initial_pair(found_before, attempt.mapper))
        found = _largest_first(found, image_set, keyed)
        (partial / "poses").mkdir()
        files = [f"poses/{number}.npz" for number in range(len(found))]
        for file, model in zip(files, found, strict=True):
            write_posed_model(partial / file, PosedModel(model.cameras, model.images))
        return MappedResult(
            poses=files[0],
            num_registered=len(found[0].images),
            registered=registered_by_video(found[0].by_name, keyed),
            mapper=attempt.mapper,
            other_models=tuple(files[1:]),
        )

    return run_stage(
        run.stages,
        "poses",
        [
            matched.digest,
            attempts,
            START_TRACKS,
            mapping.adjust,
            ends_early,
            SECOND_DISTORTION,
            pycolmap.__version__,
        ],
        MappedResult,
        into=run.stages,
        products=["poses"],
        make=make,
    )


def _largest_first(
    models: list[PosedModel], image_set: ImageSet, keyed: ImageSet
) -> list[PosedModel]:
    """Sort models by the number of images whose nearest key image they have."""
    return sorted(models, key=lambda model: -num_nearest(model, image_set, keyed))


def num_nearest(model: PosedModel, image_set: ImageSet, keyed: ImageSet) -> int:
    """The number of images whose nearest key image is in a model.

    Args:
        model: a model of key images.
        image_set: all images.
        keyed: all key images.
    """
    key = keyed.images.frames
    nearest = np.searchsorted((key[1:] + key[:-1]) / 2, image_set.images.frames)
    is_in_model = np.isin(keyed.images.names, list(model.by_name))
    return int(np.count_nonzero(is_in_model[nearest]))


def with_model_first(
    run: Run, mapped: Kept[MappedResult], keyed: ImageSet, file: str
) -> Kept[MappedResult]:
    """The models of the mapper, with another one as the first.

    Args:
        run: the run.
        mapped: the models, see `pose_stage`.
        keyed: the key images.
        file: the file of the new first model.
    """
    placed = read_posed_model(run.stages / file).by_name
    others = [own for own in (mapped.result.poses, *mapped.result.other_models) if own != file]
    result = replace(
        mapped.result,
        poses=file,
        num_registered=len(placed),
        registered=registered_by_video(placed, keyed),
        other_models=tuple(others),
    )
    return replace(mapped, result=result, digest=digest_of([mapped.digest, file]))


def _why_no_initial_pair(found: MatchesResult, mapper: str) -> str:
    """Why a mapper found no initial pair, and the remedy."""
    failure = f"COLMAP's {mapper} mapper finds no initial pair"
    other = "incremental" if mapper == "global" else "global"
    most_agree = found.num_verified_pairs >= found.num_pairs / 2
    if most_agree and found.num_flat_pairs > found.num_verified_pairs / 2:
        return (
            f"{failure}: too little parallax, in {found.num_flat_pairs} of "
            f"{found.num_verified_pairs} pairs the camera only rotates or the scene is flat: "
            "move sideways while filming, or give a longer part of the video"
        )
    if not most_agree or found.keypoints_per_image < _FEW_TRACKS:
        return (
            f"{failure}: too few tracks, {found.keypoints_per_image:.0f} per image and "
            f"{found.num_verified_pairs} of {found.num_pairs} verified pairs: "
            "'colmap-av1 info' tells what the stream lacks, --reencode 1 converts it again"
        )
    if found.assumes_focal_length:
        return (
            f"{failure}: the focal length is a default and may be far off, or there is too little "
            "parallax, as when the camera moves along its optical axis: "
            f"give --camera_model and --camera_params, or try --mapper {other}"
        )
    return (
        f"{failure}: too little parallax between images that share tracks, or wrong intrinsics: "
        f"give --camera_model and --camera_params, or try --mapper {other}"
    )


def resection_stage(
    run: Run, tracks: Tracks, image_set: ImageSet, keyed: ImageSet, posed: Kept[PosesResult]
) -> Kept[PosesResult]:
    """Estimate the poses of the images between the key images by resection."""

    def make(partial: Path) -> PosesResult:
        known = read_posed_images(run, posed, keyed)
        with run.clock.measure("resection"):
            placed = _resect(run, tracks, image_set, known)
        model = PosedModel(known.cameras, placed)
        write_posed_model(partial / "placed.npz", model)
        return PosesResult("placed.npz", len(placed), registered_by_video(model.by_name, image_set))

    return run_stage(
        run.stages,
        "resection",
        [posed.digest, _RESECTED, run.options.match.run.seed],
        PosesResult,
        into=run.stages,
        products=["placed.npz"],
        make=make,
    )


def _resect(run: Run, tracks: Tracks, image_set: ImageSet, known: PosedImages) -> list[ModelImage]:
    """The key images with a pose, and the images between them that get one."""
    run_options = run.options.match.run
    seen_thrice = pose_tracks(run, tracks).keep_observed_in(known.frames, _FEWEST_VIEWS)
    spread = select_tracks(seen_thrice.keep_frames(image_set.images.frames), _RESECTED)
    seen, view = seen_in(spread, known.frames)
    points = triangulate_in(run, known, seen, view, options=FOR_POSES)
    check_agreement(len(points.xyz), points.num_tracks)
    pose_of = {
        frame: (image.camera_id, image.cam_from_world)
        for frame, image in zip(known.frames.tolist(), known.images, strict=True)
    }
    for video in sorted(
        {int(sequence) for sequence in known.sequence if sequence < len(image_set.videos)}
    ):
        own = np.flatnonzero(known.sequence == video)
        frames = known.frames[own]
        images = image_set.images_of(video)
        left = np.setdiff1d(image_set.images.frames[images.start : images.stop], frames)
        if len(left) == 0:
            continue
        camera_id = known.images[own[0]].camera_id
        camera = known.cameras[camera_id]
        guesses = interpolate_poses(
            np.array([known.images[i].cam_from_world for i in own]), frames, left
        )
        found = resect(
            sightings_of(points, seen, spread, left, [camera] * len(left)),
            guesses,
            np.full(len(left), camera.mean_focal_length()),
            seed=run_options.seed,
            num_threads=run_options.num_threads,
            progress=progress_in(run.progress, "resection", len(left)),
        )
        pose_of |= {
            frame: (camera_id, pose)
            for frame, pose in zip(left.tolist(), found, strict=True)
            if pose is not None
        }
    return [
        ModelImage(i + 1, name, *pose_of[frame])
        for i, (name, frame) in enumerate(
            zip(image_set.images.names, image_set.images.frames.tolist(), strict=True)
        )
        if frame in pose_of
    ]


def adjustment_stage(
    run: Run,
    tracks: Tracks,
    links: Tracks,
    image_set: ImageSet,
    posed: Kept[PosesResult],
    *,
    masked: str | None = None,
    follow: Callable[[Tracks, PosedImages], Tracks] | None = None,
    corners: Callable[[Tracks, PosedImages], tuple[Tracks, PosedImages]] | None = None,
    is_fast: bool = False,
    number: int = 1,
) -> Kept[AdjustedResult]:
    """Bundle-adjust the poses with a robust loss, on long tracks that cover the images evenly.

    All links get points: without them places that are seen again would drift apart. Corners of the
    pictures correct poses that motion misleads, as at a jerk of the camera. `adjust_posed` selects
    observations of points that have many.

    Args:
        run: the run.
        tracks: the tracks of all sequences.
        links: links as tracks.
        image_set: the images.
        posed: the stage with the initial poses.
        masked: digest of the stage that found dynamic objects, if `tracks` and `links` exclude
            them.
        follow: refines the selected tracks in the registered images.
        corners: finds corners in the pictures of the registered images, and corrects poses that
            contradict them.
        is_fast: the camera turns fast somewhere, so that the scale may be poorly determined.
        number: number of the mapping that the poses come from.
    """
    options = run.options
    suffix = f"_{number}" if number > 1 else ""
    refine = refines_intrinsics(options)

    def make(partial: Path) -> AdjustedResult:
        placed = read_posed_images(run, posed, image_set)
        # Not kept in a variable: the long tracks need several times the memory of the selection.
        spread = select_tracks(pose_tracks(run, tracks).keep_frames(placed.frames), _ADJUSTED)
        if follow is not None:
            with run.clock.measure("refinement"):
                spread = follow(spread, placed)
        linked = links.keep_frames(placed.frames)
        sets = [(spread, FOR_POSES), (linked, FOR_POSES)]
        if corners is not None:
            with run.clock.measure("refinement"):
                followed, placed = corners(Tracks.concatenate(spread, linked), placed)
            few = spread.every_nth(_NTH_WITH_CORNERS).split_to_length(_LENGTH_WITH_CORNERS)
            sets = [(few, _WITH_CORNERS), (Tracks.concatenate(linked, followed), FROM_PICTURES)]
        with run.clock.measure("adjustment"):
            points = [_black_points(run, placed, *own) for own in sets]
            check_agreement(sum(len(own.xyz) for own in points), spread.num_tracks)
            run.progress("adjustment", 0, 1)
            model = PosedModel(placed.cameras, placed.images, joined_points(points))
            iterative = len(model.images) >= _ITERATIVE_IMAGES and not is_fast
            adjusted = adjust_posed(run, model, iterative=iterative)
            run.progress("adjustment", 1, 1)
            model = adjusted.model
            with tempfile.TemporaryDirectory() as name:
                write_model(Path(name), model.cameras, model.images, model.points)
                registered = without_unseen_images(Path(name))
        names = image_set.images.names
        photos = names[image_set.images_of(len(image_set.videos)).start :]
        seams = model_seams(registered, photos, names)
        # `posed_model` sorts points by their ids, which start at 1 in the order of `model`.
        result = posed_model(registered, with_points=True)
        ids = np.array(sorted(registered.points3D), np.int64)
        is_motion = adjusted.kept_points[ids - 1] < len(points[0].xyz)
        with run.clock.measure("adjustment"):
            own = with_own_cameras(run, result)
        result, is_motion = own.model, is_motion[own.kept_points]
        write_posed_model(partial / f"adjusted{suffix}.npz", result)
        return AdjustedResult(
            poses=f"adjusted{suffix}.npz",
            num_registered=len(result.images),
            registered=registered_by_video(result.by_name, image_set),
            num_motion_points=int(is_motion.sum()),
            doubtful_seams=tuple(seams.pairs[i] for i in seams.doubtful),
            few_point_seams=tuple(seams.pairs[i] for i in seams.few_points),
            scale_lost_seams=tuple(seams.pairs[i] for i in seams.worst_scale_lost),
            usual_scaled=seams.usual_scaled,
            # No warning about a lost scale: the model is split there, see `parts`.
            seams_warning=seams.disconnected_warning,
            has_long_focal_length=refine
            and any(map(has_long_focal_length, result.cameras.values())),
        )

    settings = (
        _ADJUSTED,
        _NTH_WITH_CORNERS,
        _LENGTH_WITH_CORNERS,
        (_WITH_CORNERS, FROM_PICTURES) if corners is not None else (FOR_POSES,),
        LOSS_SCALES,
        OBSERVATIONS,
        FEW_SEEN,
        refine,
        options.mapping.mapper_threads,
        options.match.run.seed,
        options.match.camera.single_camera,
        pycolmap.__version__,
    )
    return run_stage(
        run.stages,
        f"adjustment{suffix}",
        [posed.digest, settings, masked],
        AdjustedResult,
        into=run.stages,
        products=[f"adjusted{suffix}.npz"],
        make=make,
    )


def _black_points(
    run: Run, placed: PosedImages, tracks: Tracks, options: TriangulateOptions
) -> ModelPoints:
    """Triangulated points of tracks in the registered images, all black."""
    seen, view = seen_in(tracks, placed.frames)
    points = triangulate_in(run, placed, seen, view, options=options)
    return to_model_points(points, view, seen.xy[points.observation].astype(np.float64))
