"""The stages of `reconstruct`: each leaves what the next and a later run go on from."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.database.writing import write_matches
from colmap_av1.errors import ImageError, ModelError, OptionError
from colmap_av1.images.camera import make_camera
from colmap_av1.images.choosing import ChosenImages, choose_images
from colmap_av1.images.files import write_images
from colmap_av1.matching.image_matches import (
    MatchedImages,
    pair_images,
    shared_focal_length,
    verify_images,
)
from colmap_av1.model.colmap_model import ModelImage, posed_images, read_model, write_model
from colmap_av1.model.dense_points import (
    Colours,
    chaining_for_points,
    model_points,
    seen_in,
    triangulate_tracks,
)
from colmap_av1.model.mapper import adjust_model, map_poses
from colmap_av1.model.triangulate import Points
from colmap_av1.model.undistort import on_pinhole, pinhole_camera, undistortion
from colmap_av1.options import DensityOptions, ReconstructOptions, TriangulateOptions
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks, keep_frames, keep_long_tracks, least_length
from colmap_av1.tracks.video_tracks import (
    VideoSource,
    decoded_pictures,
    times_of_frames,
    track_video,
)
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.facts import read_display
from colmap_av1.video.unchanged import FileState, check_unchanged, file_states

_Image = NDArray[np.uint8]
# A mapper may leave a bogus model of two images where it finds no start.
_LEAST_IMAGES = 3
# Of an image, below which a mapper that finds no start may lack them.
_FEW_TRACKS = 100
# Tracks that the poses are adjusted on, and the error in pixels from which on they count less: half
# of them come to 0.3 or 0.4 at most, those beyond have drifted.
_ADJUSTED = DensityOptions(
    preset="sparse", max_tracks_per_image=1000, spacing=12.0, min_length=3, max_sigma=0.0
)
_LOSS_SCALE = 0.25
# Poses are told by rays, however unsure the points are that these meet in.
_FOR_POSES = TriangulateOptions(max_depth_error=None)


@dataclass(frozen=True)
class Run:
    """What every stage is given.

    Attributes:
        source: the video.
        files: its files as they were at the start.
        output: the folder that is made.
        stages: the folder in it that holds what later runs go on from.
        options: options of every stage.
        clock: gets the time of each stage.
        progress: told about each stage.
    """

    source: VideoSource
    files: dict[Path, FileState]
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
        if len(chosen.names) < _LEAST_IMAGES:
            raise ImageError(
                f"{len(chosen.names)} of {tracks.num_frames} frames become images: a model needs "
                f"{_LEAST_IMAGES} or more"
            )
        unfit = next((n for n in chosen.names if "/" in n or n.count(".") != 1), None)
        if unfit is not None:
            raise OptionError(f"image '{unfit}': trainers want a flat name with one dot")
        with (partial / "tracks.npz").open("wb") as file:
            # Names are kept by np.savez as they are.
            np.savez(file, **vars(tracks), names=np.array(chosen.names), frames=chosen.frames)
        check_unchanged(run.files)
        return {
            "num_frames": tracks.num_frames,
            "num_images": len(chosen.names),
            "num_tracks": len(tracks.offsets) - 1,
            "warnings": list(tracked.warnings),
        }

    given = (options.images, options.read, options.tracks, options.refine, options.encode)
    frame_list = options.images.frame_list
    listed = list(file_states(Path(frame_list)).values()) if frame_list is not None else None
    return run_stage(
        run.stages,
        "tracks",
        [*run.files.values(), given, listed],
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
    """The tracks that may tell of the poses; short ones are for points only."""
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
        paired = pair_images(video, sparse, chosen, options.match, clock=clock, progress=progress)
        size = (tracks.width, tracks.height)
        pixel_aspect = read_display(video).pixel_aspect
        focal_length = shared_focal_length(paired, size, pixel_aspect, options.match, clock=clock)
        camera = make_camera(options.match.camera, *size, pixel_aspect, focal_length)
        matched = verify_images(paired, camera, options.match, clock=clock, progress=progress)
        with clock.measure("database"):
            write_matches(
                partial / "database.db",
                chosen.names,
                camera,
                matched.keypoints,
                pairs=matched.pairs,
                matches=matched.matches,
                geometries=matched.geometries,
            )
        return {
            "num_pose_tracks": len(sparse.offsets) - 1,
            "guessed": not camera.has_prior_focal_length,
            **_pair_facts(matched),
        }

    given = (density, options.match.pairs, options.match.verify, options.match.camera)
    return run_stage(
        run.stages,
        "matches",
        [tracked.key, given],
        into=run.output,
        products=["database.db"],
        make=make,
    )


def _pair_facts(matched: MatchedImages) -> dict[str, Any]:
    """What tells why a mapper finds no start."""
    kinds = [geometry.config.name for geometry in matched.geometries]
    return {
        "forward_motion": matched.forward_motion,
        "num_pairs": len(kinds),
        "num_flat_pairs": kinds.count("PLANAR_OR_PANORAMIC"),
        "num_verified_pairs": len(kinds) - kinds.count("DEGENERATE"),
        "keypoints_per_image": sum(len(k.xy) for k in matched.keypoints) / len(matched.keypoints),
    }


def pose_stage(run: Run, matched: Kept, num_images: int) -> Kept:
    """Let COLMAP's mapper find the poses."""
    options, clock, progress = run.options, run.clock, run.progress
    mapping = options.mapping
    forward = bool(matched.facts["forward_motion"])
    mapper = mapping.mapper
    if mapper == "auto":
        mapper = "incremental" if matched.facts["guessed"] else "global"
    refine = _refines_intrinsics(options)

    def make(partial: Path) -> dict[str, Any]:
        with clock.measure("poses"):
            # pycolmap brings a database to its own layout.
            copy = partial / "mapped.db"
            shutil.copyfile(run.output / "database.db", copy)
            mapped = map_poses(
                copy,
                partial / "poses",
                mapper=mapper,
                refine_intrinsics=refine,
                forward_motion=forward,
                seed=options.match.verify.seed,
                num_threads=mapping.mapper_threads,
                log=run.stages / "mapper.log",
                num_images=num_images,
                progress=progress,
            )
        if max(mapped.num_images, default=0) < _LEAST_IMAGES:
            raise ModelError(_why_no_start(matched.facts, mapper))
        return {
            "num_registered": mapped.num_images[0],
            "other_models": [n for n in mapped.num_images[1:] if n >= _LEAST_IMAGES],
            "mapper": mapper,
            "poses": "poses",
        }

    how = (mapping.mapper_threads, options.match.verify.seed, pycolmap.__version__)
    given = (mapper, refine, forward, *how)
    return run_stage(
        run.stages,
        "poses",
        [matched.key, given],
        into=run.stages,
        products=["poses"],
        make=make,
    )


def _refines_intrinsics(options: ReconstructOptions) -> bool:
    if options.mapping.refine_intrinsics is not None:
        return options.mapping.refine_intrinsics
    return options.match.camera.camera_params is None


def _why_no_start(facts: dict[str, Any], mapper: str) -> str:
    """Why a mapper found no two images to start with, and what to try."""
    told = f"COLMAP's {mapper} mapper finds no start"
    other = "incremental" if mapper == "global" else "global"
    most_agree = facts["num_verified_pairs"] >= facts["num_pairs"] / 2
    if most_agree and facts["num_flat_pairs"] > facts["num_verified_pairs"] / 2:
        return (
            f"{told}: too little parallax, in {facts['num_flat_pairs']} of "
            f"{facts['num_verified_pairs']} pairs the camera only turns or the scene is flat: film "
            "while moving sideways, or give a longer part of the video"
        )
    if not most_agree or facts["keypoints_per_image"] < _FEW_TRACKS:
        return (
            f"{told}: too few tracks, {facts['keypoints_per_image']:.0f} an image and "
            f"{facts['num_verified_pairs']} of {facts['num_pairs']} pairs that agree with a rigid "
            "scene: 'colmap-av1 info' says what the stream lacks, --reencode 1 converts it anew"
        )
    if facts["guessed"]:
        return (
            f"{told}: the focal length is a guess and may be far off, or the parallax too little, "
            "as where the camera moves along its axis: "
            f"give --camera_model and --camera_params, or try --mapper {other}"
        )
    return (
        f"{told}: the parallax between images that share tracks is too little, or the intrinsics "
        f"do not fit: give --camera_model and --camera_params, or try --mapper {other}"
    )


def adjustment_stage(run: Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    """Adjust the poses on more tracks than the mapper can take: long ones, spread over the images.

    The mapper's own adjustments have no robust loss, and drop what drifts.
    """
    options = run.options
    refine = _refines_intrinsics(options)

    def make(partial: Path) -> dict[str, Any]:
        placed = _read_placed(run, posed, chosen)
        spread = select_tracks(keep_frames(tracks, placed.frames), _ADJUSTED)
        with run.clock.measure("adjustment"):
            seen, view = seen_in(spread, placed.frames)
            points = _triangulate(
                *(run, placed, seen, view), pinhole=None, options=_FOR_POSES, progress=no_progress
            )
            folder = partial / "adjusted"
            folder.mkdir()
            black = np.zeros((len(points.xyz), 3), np.uint8)
            xy = seen.xy[points.observation].astype(np.float64)
            cameras = {int(placed.camera.camera_id): placed.camera}
            write_model(folder, cameras, placed.images, model_points(points, black, view, xy))
            run.progress("adjustment", 0, 1)
            adjust_model(
                folder,
                refine_intrinsics=refine,
                loss_scale=_LOSS_SCALE,
                seed=options.match.verify.seed,
                num_threads=options.mapping.mapper_threads,
                log=run.stages / "adjustment.log",
            )
            run.progress("adjustment", 1, 1)
        return {"poses": "adjusted"}

    how = (options.mapping.mapper_threads, options.match.verify.seed, pycolmap.__version__)
    given = (_ADJUSTED, _LOSS_SCALE, refine, *how)
    return run_stage(
        run.stages,
        "adjustment",
        [posed.key, given],
        into=run.stages,
        products=["adjusted"],
        make=make,
    )


@dataclass(frozen=True)
class _Placed:
    """The images that have a pose, of one camera.

    Attributes:
        images: the images, in display order.
        frames: int32 [n] their frames.
        camera: their pycolmap.Camera.
    """

    images: list[ModelImage]
    frames: NDArray[np.int32]
    camera: Any


def _read_placed(run: Run, posed: Kept, chosen: ChosenImages) -> _Placed:
    poses = read_model(run.stages / posed.facts["poses"])
    posed_by_name = posed_images(poses)
    index = [i for i, name in enumerate(chosen.names) if name in posed_by_name]
    found = [posed_by_name[chosen.names[i]] for i in index]
    camera = poses.cameras[found[0].camera_id]
    images = [replace(image, image_id=i + 1) for i, image in enumerate(found)]
    return _Placed(images, chosen.frames[index], camera)


def _triangulate(
    run: Run,
    placed: _Placed,
    seen: Tracks,
    view: NDArray[np.int64],
    *,
    pinhole: Any | None,
    options: TriangulateOptions,
    progress: Progress,
) -> Points:
    """Points of tracks in the images that have a pose, one at least; see `triangulate_tracks`."""
    points = triangulate_tracks(
        *(seen, view, [placed.camera] * len(placed.images)),
        *([image.cam_from_world for image in placed.images], pinhole),
        options=options,
        num_threads=run.options.match.verify.num_threads,
        progress=progress,
    )
    if len(points.xyz) == 0:
        raise ModelError(
            f"none of the {points.num_tracks} tracks agrees with the poses: try the other "
            "--mapper, or give --camera_params"
        )
    return points


def model_stage(run: Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    """Triangulate all tracks and write the images and the model that trainers open."""
    options, clock, progress = run.options, run.clock, run.progress
    source = run.source

    def make(partial: Path) -> dict[str, Any]:
        placed = _read_placed(run, posed, chosen)
        distorted, frames = placed.camera, placed.frames
        camera = pinhole_camera(distorted)
        images = [replace(image, camera_id=1) for image in placed.images]
        names = [image.name for image in images]
        seen, view = seen_in(tracks, frames)
        with clock.measure("points"):
            points = _triangulate(
                *(run, placed, seen, view),
                pinhole=camera,
                options=options.triangulate,
                progress=progress,
            )
        colours = Colours(seen, view, points, len(images))
        undistort = undistortion(distorted, camera)
        image_of_frame = {int(frame): i for i, frame in enumerate(frames)}

        def change(frame: int, picture: _Image) -> _Image:
            colours.add(image_of_frame[frame], picture)
            return undistort(picture) if undistort is not None else picture

        with clock.measure("images"):
            write_images(
                source.pictures,
                partial / "images",
                names,
                frames.tolist(),
                num_threads=options.match.verify.num_threads,
                operating_point=options.match.read.operating_point,
                change=change,
                progress=lambda done: progress("images", done, len(names)),
            )
        check_unchanged(run.files)
        with clock.measure("writing"):
            folder = partial / "sparse" / "0"
            folder.mkdir(parents=True)
            xy = on_pinhole(distorted, camera, seen.xy[points.observation])
            write_model(folder, {1: camera}, images, model_points(points, colours.mean(), view, xy))
        return {
            "num_points": len(points.xyz),
            "num_observations": len(points.observation),
            "mean_error": float(points.error.mean()),
            "focal_length": float(camera.params[0]),
            "agreeing": points.num_agreeing / max(points.num_tracks, 1),
        }

    given = (options.triangulate, options.match.images.image_name)
    return run_stage(
        run.stages,
        "model",
        [posed.key, given],
        into=run.output,
        products=["images", "sparse"],
        make=make,
    )
