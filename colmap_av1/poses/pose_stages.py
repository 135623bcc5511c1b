"""The stages of `reconstruct` that estimate poses: COLMAP's mapper, then bundle adjustment."""

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
    write_posed_model,
)
from colmap_av1.geometry.resection import interpolate_poses, resect, sightings_of
from colmap_av1.geometry.track_points import seen_in, to_model_points
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import DensityOptions, MapOptions, ReconstructOptions, TriangulateOptions
from colmap_av1.poses.mapper import FEW_SEEN, adjust_model, map_poses, without_unseen_images
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
from colmap_av1.poses.track_stage import LEAST_IMAGES, pose_tracks
from colmap_av1.poses.zoom import with_own_cameras
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import progress_in
from colmap_av1.util.stages import Kept, run_stage

# Of an image, below which a mapper that finds no start may lack them.
_FEW_TRACKS = 100
# Tracks of an image that the global mapper starts from, the longest ones, and share of the error
# that steps lower or end, where an adjustment follows: half the time of 200, to the same poses. But
# what links videos or images is short, and all of it needed; revisits make long tracks longer.
START_TRACKS = 100
TOLERANCE = 1e-4
# Tracks that the poses are adjusted on, and the error in pixels from which on they count less: half
# of them come to 0.3 or 0.4 at most, those beyond have drifted. A larger one comes first: at the
# end of a video, say, the mapper may leave images that are off by more with all they see.
_ADJUSTED = DensityOptions(
    preset="sparse", max_tracks_per_image=500, spacing=12.0, min_images=3, max_sigma=0.0
)
LOSS_SCALES = (1.0, 0.25)
# Beside corners, one in so many of them: each is less exact, and all may be off one way. They
# drift, by three times as much over twenty images as over three, and bend what corners hold
# straight: so they are cut to pieces of so many images.
_BESIDE = 2
_MOST_BESIDE = 8
# Tracks that images between key images are placed by, and views of these that make their points.
_RESECTED = DensityOptions(
    preset="sparse", max_tracks_per_image=500, spacing=16.0, min_images=3, max_sigma=0.0
)
_FEWEST_VIEWS = 3
# Beside corners, which say where an image is, motion that is off by more tells nothing. A corner is
# where the picture shows it, and where a shutter bends this, all of it is to count; a link, too:
# where poses do not hold together it is as far off as they are.
_BESIDE_CORNERS = replace(FOR_POSES, max_reprojection_error=0.3)
FROM_PICTURES = replace(FOR_POSES, max_reprojection_error=8.0)


@dataclass(frozen=True)
class MappedResult(PosesResult):
    """What `pose_stage` found.

    Attributes:
        mapper: which of COLMAP's mappers found the poses.
        other_models: files of further models, whose images nothing connects with the first.
    """

    mapper: str
    other_models: tuple[str, ...]


@dataclass(frozen=True)
class AdjustedResult(PosesResult):
    """What `adjustment_stage` found.

    Attributes:
        num_motion_points: points of motion tracks, which come first; those of corners and links
            follow.
        doubtful_seams: names of neighbouring images that few points join.
        thin_seams: names of those that few points join at this place, see `Seams.thin`.
        turns: names of those between which the camera turns and the scale is lost, see
            `Seams.turns`.
        usual_scaled: number of points that carry the scale across a usual seam.
        seams_warning: what the user should know of them.
    """

    num_motion_points: int
    doubtful_seams: tuple[tuple[str, str], ...]
    thin_seams: tuple[tuple[str, str], ...]
    turns: tuple[tuple[str, str], ...]
    usual_scaled: float
    seams_warning: str | None


def pose_stage(
    run: Run, matched: Kept[MatchesResult], image_set: ImageSet, keyed: ImageSet
) -> Kept[MappedResult]:
    """Estimate the poses of the key images, some of all, by COLMAP's mapper."""
    options, clock, progress = run.options, run.clock, run.progress
    mapping = options.mapping
    found_before = matched.result
    forward = found_before.forward_motion
    mappers: list[Literal["incremental", "global"]]
    if mapping.mapper != "auto":
        mappers = [mapping.mapper]
    else:
        # The global mapper needs the focal length, and a zoom misleads its estimate.
        mappers = ["incremental"] if found_before.guessed else ["global", "incremental"]
    links = found_before.links
    reasons = {reason for gap in links.gaps for reason in gap.reasons}
    hangs = links.num_between or reasons & {"contradicted", "few tracks"}
    start_tracks = None if hangs else START_TRACKS
    tolerance = TOLERANCE if mapping.adjust and not hangs else None
    hows = [
        MapOptions(
            mapper=mapper,
            forward_motion=forward and mapper == "incremental",
            refine_intrinsics=refines_intrinsics(options),
            seed=options.match.run.seed,
            num_threads=mapping.mapper_threads,
        )
        for mapper in mappers
    ]

    def map_with(how: MapOptions, database: Path) -> list[PosedModel]:
        with tempfile.TemporaryDirectory() as models:
            sizes = map_poses(
                database,
                Path(models),
                how,
                image_path=None,
                log=run.stages / "mapper.log",
                num_images=len(keyed.images.names),
                progress=progress,
                start_tracks=start_tracks,
                tolerance=tolerance,
            )
            return [
                posed_model(read_model(Path(models) / str(number)))
                for number, size in enumerate(sizes)
                if size >= LEAST_IMAGES
            ]

    def make(partial: Path) -> MappedResult:
        with clock.measure("poses"):
            # pycolmap brings a database to its own layout.
            copy = partial / "mapped.db"
            shutil.copyfile(run.output / "database.db", copy)
            for how in hows:
                found = map_with(how, copy)
                if found:
                    break
        if not found:
            raise ModelError(_why_no_start(found_before, how.mapper))
        found = _largest_first(found, image_set, keyed)
        (partial / "poses").mkdir()
        files = [f"poses/{number}.npz" for number in range(len(found))]
        for file, model in zip(files, found, strict=True):
            write_posed_model(partial / file, model)
        return MappedResult(
            poses=files[0],
            num_registered=len(found[0].images),
            registered=registered_by_video(found[0].by_name, keyed),
            mapper=how.mapper,
            other_models=tuple(files[1:]),
        )

    return run_stage(
        run.stages,
        "poses",
        [matched.digest, hows, start_tracks, tolerance, pycolmap.__version__],
        MappedResult,
        into=run.stages,
        products=["poses"],
        make=make,
    )


def _largest_first(
    models: list[PosedModel], image_set: ImageSet, keyed: ImageSet
) -> list[PosedModel]:
    """The models by how many images, key images or between these, they stand for."""
    if len(models) < 2:
        return models
    key = keyed.images.frames
    nearest = np.searchsorted((key[1:] + key[:-1]) / 2, image_set.images.frames)
    stands_for = np.bincount(nearest, minlength=len(key))
    size = [
        sum(
            int(count)
            for name, count in zip(keyed.images.names, stands_for, strict=True)
            if name in images
        )
        for images in (model.by_name for model in models)
    ]
    return [models[k] for k in sorted(range(len(models)), key=lambda k: -size[k])]


def refines_intrinsics(options: ReconstructOptions) -> bool:
    """Whether focal length and distortion are refined: by default those that are not given."""
    if options.mapping.refine_intrinsics is not None:
        return options.mapping.refine_intrinsics
    return options.match.camera.camera_params is None


def _why_no_start(found: MatchesResult, mapper: str) -> str:
    """Why a mapper found no initial pair, and what to try."""
    no_start = f"COLMAP's {mapper} mapper finds no initial pair"
    other = "incremental" if mapper == "global" else "global"
    most_agree = found.num_verified_pairs >= found.num_pairs / 2
    if most_agree and found.num_flat_pairs > found.num_verified_pairs / 2:
        return (
            f"{no_start}: too little parallax, in {found.num_flat_pairs} of "
            f"{found.num_verified_pairs} pairs the camera only rotates or the scene is flat: "
            "film while moving sideways, or give a longer part of the video"
        )
    if not most_agree or found.keypoints_per_image < _FEW_TRACKS:
        return (
            f"{no_start}: too few tracks, {found.keypoints_per_image:.0f} an image and "
            f"{found.num_verified_pairs} of {found.num_pairs} pairs that agree with a rigid "
            "scene: 'colmap-av1 info' says what the stream lacks, --reencode 1 converts it anew"
        )
    if found.guessed:
        return (
            f"{no_start}: the focal length is a guess and may be far off, or the parallax too "
            "little, as where the camera moves along its axis: "
            f"give --camera_model and --camera_params, or try --mapper {other}"
        )
    return (
        f"{no_start}: the parallax between images that share tracks is too little, or the "
        f"intrinsics do not fit: give --camera_model and --camera_params, or try --mapper {other}"
    )


def resection_stage(
    run: Run, tracks: Tracks, image_set: ImageSet, keyed: ImageSet, posed: Kept[PosesResult]
) -> Kept[PosesResult]:
    """Place the images between the key images by the points of tracks that they see."""

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
    """The images that have a pose, and those between them that get one; see `resection_stage`."""
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
    moved: str | None = None,
    follow: Callable[[Tracks, PosedImages], Tracks] | None = None,
    corners: Callable[[Tracks, PosedImages], tuple[Tracks, PosedImages]] | None = None,
    number: int = 1,
) -> Kept[AdjustedResult]:
    """Bundle-adjust the poses on more tracks than the mapper gets: long ones, spread over images.

    Links take part whole: without them places seen again would drift apart once more. Corners of
    the pictures say where an image is whose motion misleads, as where the camera jerks.

    The mapper's own adjustments have no robust loss, and drop what drifts.

    Args:
        run: what every stage is given.
        tracks: the tracks of all sequences.
        links: links as tracks.
        image_set: the images.
        posed: the stage that left the poses.
        moved: digest of the stage that found what moves, where tracks and links are without it.
        follow: corrects the chosen tracks in the images that have a pose.
        corners: looks for corners of these images' pictures, which take part whole, and corrects
            poses that these contradict.
        number: of the mapping that the poses come from.
    """
    options = run.options
    suffix = f"_{number}" if number > 1 else ""
    refine = refines_intrinsics(options)

    def make(partial: Path) -> AdjustedResult:
        placed = read_posed_images(run, posed, image_set)
        # The long tracks of all images are several times as large as those chosen: they go at once.
        spread = select_tracks(pose_tracks(run, tracks).keep_frames(placed.frames), _ADJUSTED)
        if follow is not None:
            with run.clock.measure("refinement"):
                spread = follow(spread, placed)
        linked = links.keep_frames(placed.frames)
        sets = [(spread, FOR_POSES), (linked, FOR_POSES)]
        if corners is not None:
            with run.clock.measure("refinement"):
                followed, placed = corners(Tracks.concatenate(spread, linked), placed)
            few = spread.every_nth(_BESIDE).split_to_length(_MOST_BESIDE)
            sets = [(few, _BESIDE_CORNERS), (Tracks.concatenate(linked, followed), FROM_PICTURES)]
        with run.clock.measure("adjustment"), tempfile.TemporaryDirectory() as model:
            folder = Path(model)
            points = [_black_points(run, placed, *own) for own in sets]
            check_agreement(sum(len(own.xyz) for own in points), spread.num_tracks)
            write_model(folder, placed.cameras, placed.images, joined_points(points))
            run.progress("adjustment", 0, 1)
            adjust_in(run, folder)
            run.progress("adjustment", 1, 1)
            adjusted = without_unseen_images(folder)
        seams = model_seams(adjusted)
        result = posed_model(adjusted, with_points=True)
        # Point ids count from 1, in the order of the points.
        is_motion = np.array(list(adjusted.points3D)) <= len(points[0].xyz)
        with run.clock.measure("adjustment"):
            result = with_own_cameras(run, result, LOSS_SCALES, refine_intrinsics=refine)
        write_posed_model(partial / f"adjusted{suffix}.npz", result)
        return AdjustedResult(
            poses=f"adjusted{suffix}.npz",
            num_registered=len(result.images),
            registered=registered_by_video(result.by_name, image_set),
            num_motion_points=int(is_motion.sum()),
            doubtful_seams=tuple(seams.pairs[i] for i in seams.doubtful),
            thin_seams=tuple(seams.pairs[i] for i in seams.thin),
            turns=tuple(seams.pairs[i] for i in seams.turns),
            usual_scaled=seams.usual_scaled,
            # A model whose scale is lost somewhere is split there, see `parts`.
            seams_warning=seams.weak_warning,
        )

    how = (options.mapping.mapper_threads, options.match.run.seed, pycolmap.__version__)
    kinds = (_BESIDE_CORNERS, FROM_PICTURES) if corners is not None else (FOR_POSES,)
    given = (_ADJUSTED, _BESIDE, _MOST_BESIDE, kinds, LOSS_SCALES, FEW_SEEN, refine, *how)
    single_camera = options.match.camera.single_camera
    return run_stage(
        run.stages,
        f"adjustment{suffix}",
        [posed.digest, given, moved, single_camera],
        AdjustedResult,
        into=run.stages,
        products=[f"adjusted{suffix}.npz"],
        make=make,
    )


def adjust_in(run: Run, folder: Path) -> None:
    """Bundle-adjust the model in a folder, as the options of the run say; it is overwritten."""
    adjust_model(
        folder,
        refine_intrinsics=refines_intrinsics(run.options),
        loss_scales=LOSS_SCALES,
        seed=run.options.match.run.seed,
        num_threads=run.options.mapping.mapper_threads,
        log=run.stages / "adjustment.log",
    )


def _black_points(
    run: Run, placed: PosedImages, tracks: Tracks, options: TriangulateOptions
) -> ModelPoints:
    """Points of tracks in the images that have a pose, without colours."""
    seen, view = seen_in(tracks, placed.frames)
    points = triangulate_in(run, placed, seen, view, options=options)
    return to_model_points(points, view, seen.xy[points.observation].astype(np.float64))
