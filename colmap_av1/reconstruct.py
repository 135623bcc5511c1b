"""From a video to a dense model: poses from few sure tracks, points from all of them."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.choice import ChosenImages, choose_images
from colmap_av1.database import make_camera, write_matches
from colmap_av1.density import select_tracks
from colmap_av1.errors import ModelError, OptionError
from colmap_av1.files import whole_file
from colmap_av1.images import size_of_images, write_images
from colmap_av1.mapper import adjust_model, map_poses
from colmap_av1.match import (
    MatchedImages,
    VideoSource,
    check_options,
    open_source,
    pair_images,
    shared_focal_length,
    track_video,
    verify_images,
)
from colmap_av1.model import ModelImage, ModelPoints, read_model, write_model
from colmap_av1.options import (
    DensifyOptions,
    DensityOptions,
    MapperOptions,
    MatchOptions,
    ReconstructOptions,
    TriangulateOptions,
)
from colmap_av1.progress import Clock, Progress, no_progress
from colmap_av1.stages import Kept, open_stages, run_stage
from colmap_av1.tracks import Tracks, keep_observations, scale_tracks
from colmap_av1.triangulate import (
    Points,
    Sightings,
    Views,
    check_triangulate_options,
    triangulate,
)
from colmap_av1.undistort import on_pinhole, pinhole_camera, undistortion
from colmap_av1.video import decode_frames, frame_times, picture_size, read_display

_Image = NDArray[np.uint8]

# Tracks that agree with the poses of a model of the same video, at least.
_LEAST_AGREEING = 0.5
# Tracks that the poses are adjusted on, and the error in pixels from which on they count less.
_ADJUSTED = DensityOptions(
    preset="sparse", max_tracks_per_image=1000, spacing=12.0, min_length=3, max_sigma=0.0
)
_LOSS_SCALE = 0.5
# Share of pairs that a homography explains from which on depth is doubtful.
_MANY_FLAT = 0.9


@dataclass(frozen=True)
class ReconstructReport:
    """What `reconstruct` made.

    Attributes:
        output: the folder with `images/` and `sparse/0/`, as trainers open it.
        video: the video.
        database: COLMAP database of the tracks that the poses come from.
        num_frames: shown frames of the video.
        num_images: frames chosen as images.
        num_registered: images with a pose; only these are written.
        other_models: images of further models the mapper made, which are left out.
        num_tracks: tracks of the video.
        num_pose_tracks: tracks that the poses come from.
        num_points: 3D points.
        num_observations: observations of all points.
        mean_error: mean reprojection error of the points in pixels.
        focal_length: of the output's camera, in pixels.
        mapper: which of COLMAP's mappers found the poses.
        forward_motion: the camera moves along its axis, see `MatchReport`.
        resumed: stages that an earlier run had finished.
        seconds: wall time of each stage of this run.
        warnings: what the user should know.
    """

    output: Path
    video: Path
    database: Path
    num_frames: int
    num_images: int
    num_registered: int
    other_models: tuple[int, ...]
    num_tracks: int
    num_pose_tracks: int
    num_points: int
    num_observations: int
    mean_error: float
    focal_length: float
    mapper: str
    forward_motion: bool
    resumed: tuple[str, ...]
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class DensifyReport:
    """What `densify` made.

    Attributes:
        output: folder of the dense model.
        model: the model whose poses it has.
        num_images: images of the model.
        num_tracks: tracks of the video that its images see often enough.
        agreeing: share of these that agree with the poses.
        num_points: 3D points.
        num_model_points: those of the given model.
        mean_error: mean reprojection error of the points in pixels.
        seconds: wall time of each stage.
        warnings: what the user should know.
    """

    output: Path
    model: Path
    num_images: int
    num_tracks: int
    agreeing: float
    num_points: int
    num_model_points: int
    mean_error: float
    seconds: dict[str, float]
    warnings: tuple[str, ...]


def reconstruct(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: ReconstructOptions | None = None,
    progress: Progress | None = None,
) -> ReconstructReport:
    """Make a dense model of a video, in a folder that trainers of Gaussian splats open.

    The poses come from COLMAP's mapper on a spread choice of long, sure tracks; then every
    track is triangulated on them. The folder gets `images/` and `sparse/0/*.bin` with one
    PINHOLE camera, undistorted and of the video's size, and beside them `database.db` and
    `report.json`. A run that was stopped goes on after its last finished stage; a changed
    option redoes what depends on it.

    Args:
        video: a video; one that is not AV1 is converted first.
        output: the folder; new, empty, or that of an earlier run.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        VideoError: the video cannot be read, or has no motion to match.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: images cannot be chosen or written.
        ModelError: no poses are found, or the output cannot be written.
        OptionError: an option has a value that cannot work, or the folder holds other things.
    """
    options = options if options is not None else ReconstructOptions()
    progress = progress if progress is not None else no_progress
    video, output = Path(video), Path(output)
    clock = Clock()
    check_options(options.match, picture_size(video))
    _check_reconstruct_options(options)
    stages = open_stages(output)

    source = open_source(video, options.match, clock=clock, progress=progress)
    run = _Run(source, output, stages, options, clock, progress)
    tracked = _track_stage(run)
    tracks, chosen = _read_tracks(stages)
    matched = _match_stage(run, tracks, chosen, tracked)
    posed = _pose_stage(run, matched, len(chosen.names))
    kept = {"tracks": tracked, "matches": matched, "poses": posed}
    if options.mapping.adjust:
        kept["adjustment"] = posed = _adjustment_stage(run, tracks, chosen, posed)
    kept["model"] = _model_stage(run, tracks, chosen, posed)
    facts = {name: fact for stage in kept.values() for name, fact in stage.facts.items()}
    notes = [*facts.pop("warnings"), *_notes(facts)]
    reported: dict[str, Any] = {
        f.name: facts[f.name] for f in dataclasses.fields(ReconstructReport) if f.name in facts
    }
    reported["other_models"] = tuple(facts["other_models"])
    report = ReconstructReport(
        output=output,
        video=video,
        database=output / "database.db",
        resumed=tuple(name for name, stage in kept.items() if stage.resumed),
        seconds=clock.seconds,
        warnings=tuple(notes),
        **reported,
    )
    _write_report(report)
    return report


def densify(
    model: str | os.PathLike[str],
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    image_path: str | os.PathLike[str] | None = None,
    options: DensifyOptions | None = None,
    progress: Progress | None = None,
) -> DensifyReport:
    """Triangulate the tracks of a video on the poses of a model that is there.

    Poses, cameras and image names stay as they are; the points are new.

    Args:
        model: folder of a COLMAP model of this video's frames, from whatever mapper.
        video: a video; one that is not AV1 is converted first.
        output: new or empty folder for the dense model.
        image_path: folder of the model's images, to tell by what they show which frames they
            are where their names leave doubt.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        ModelError: there is no readable model with poses, it is not of this video, or the
            dense one cannot be written.
        VideoError: the video cannot be read.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: the model's images do not say which frames they are.
        OptionError: an option has a value that cannot work, or the folder is not empty.
    """
    options = options if options is not None else DensifyOptions()
    progress = progress if progress is not None else no_progress
    model, video, output = Path(model), Path(video), Path(output)
    clock = Clock()
    video_size = picture_size(video)
    check_options(options.match, video_size)
    check_triangulate_options(options.triangulate)
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise OptionError(f"{output}: is there and not empty: give a new folder")
    reconstruction = read_model(model)
    by_name = {i.name: i for i in reconstruction.images.values() if i.has_pose}
    cameras = {i.camera_id: reconstruction.cameras[i.camera_id] for i in by_name.values()}
    sizes = {
        name: (int(cameras[i.camera_id].width), int(cameras[i.camera_id].height))
        for name, i in by_name.items()
    }
    size = size_of_images(sizes, video_size, read_display(video).pixel_aspect)

    source = open_source(video, options.match, clock=clock, progress=progress)
    tracked = track_video(source, options.match, one_size=True, clock=clock, progress=progress)
    with clock.measure("choice"):
        chosen = choose_images(
            tracked.tracks,
            options.match.images,
            existing=list(by_name),
            folder=Path(image_path) if image_path is not None else None,
            times=lambda: frame_times(source.stream),
            decode=lambda: _pictures(source, options.match),
        )
    tracks = scale_tracks(tracked.tracks, size)
    images = [
        ModelImage(
            int(by_name[name].image_id),
            name,
            int(by_name[name].camera_id),
            np.asarray(by_name[name].cam_from_world().matrix()),
        )
        for name in chosen.names
    ]
    seen, view = _seen_in(tracks, chosen.frames)
    with clock.measure("points"):
        points = _triangulate_all(
            *(seen, view, [cameras[i.camera_id] for i in images]),
            *([i.cam_from_world for i in images], None),
            options=options.triangulate,
            num_threads=options.match.verify.num_threads,
            progress=progress,
        )
    agreeing = points.num_agreeing / max(points.num_tracks, 1)
    if agreeing < _LEAST_AGREEING or len(points.xyz) == 0:
        raise ModelError(
            f"{model}: only {agreeing:.0%} of the video's tracks agree with the model's poses and "
            f"{len(points.xyz)} give a point: give the video that the model's images come from, "
            "and see that their names count its frames (--first_number, --frame_list)"
        )
    with clock.measure("colours"):
        colours = _Colours(seen, view, points, len(images))
        image_of_frame = {int(frame): i for i, frame in enumerate(chosen.frames)}
        for frame, picture in _pictures(source, options.match):
            progress("colours", frame + 1, tracks.num_frames)
            if frame in image_of_frame:
                colours.add(image_of_frame[frame], picture)
            if frame >= chosen.frames[-1]:
                break
    with clock.measure("writing"):
        partial = output.with_name(f".{output.name}.{os.getpid()}.partial")
        try:
            partial.mkdir(parents=True)
            xy = seen.xy[points.observation].astype(np.float64)
            write_model(partial, cameras, images, _model_points(points, colours.mean(), view, xy))
            if output.exists():
                output.rmdir()
            partial.replace(output)
        except OSError as error:
            raise ModelError(f"{output}: cannot be written: {error.strerror}") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    return DensifyReport(
        output=output,
        model=model,
        num_images=len(images),
        num_tracks=points.num_tracks,
        agreeing=agreeing,
        num_points=len(points.xyz),
        num_model_points=reconstruction.num_points3D(),
        mean_error=float(points.error.mean()),
        seconds=clock.seconds,
        warnings=tracked.warnings,
    )


@dataclass(frozen=True)
class _Run:
    """What every stage is given.

    Attributes:
        source: the video.
        output: the folder that is made.
        stages: the folder in it that holds what later runs go on from.
        options: options of every stage.
        clock: gets the time of each stage.
        progress: told about each stage.
    """

    source: VideoSource
    output: Path
    stages: Path
    options: ReconstructOptions
    clock: Clock
    progress: Progress


def _check_reconstruct_options(options: ReconstructOptions) -> None:
    check_triangulate_options(options.triangulate)
    kinds = get_args(MapperOptions.__annotations__["mapper"]) or ("auto", "incremental", "global")
    if options.mapping.mapper not in kinds:
        raise OptionError(f"mapper is {options.mapping.mapper!r}: give {', '.join(kinds)}")
    if options.mapping.pose_tracks_per_image < 50:
        raise OptionError(
            f"pose_tracks_per_image is {options.mapping.pose_tracks_per_image}: give 50 or more"
        )
    if not options.match.camera.single_camera:
        raise OptionError("single_camera is 0: a trainer's folder has one camera, leave it at 1")
    name = options.match.images.image_name
    if name.count(".") != 1:
        raise OptionError(f"image_name '{name}': trainers want no dot but that of the extension")


def _track_stage(run: _Run) -> Kept:
    source, options = run.source, run.options.match
    clock, progress = run.clock, run.progress

    def make(partial: Path) -> dict[str, Any]:
        tracked = track_video(source, options, one_size=True, clock=clock, progress=progress)
        tracks = tracked.tracks
        with clock.measure("choice"):
            chosen = choose_images(
                tracks,
                options.images,
                existing=(),
                folder=partial,
                times=lambda: frame_times(source.stream),
                decode=lambda: _pictures(source, options),
            )
        unfit = next((n for n in chosen.names if "/" in n or n.count(".") != 1), None)
        if unfit is not None:
            raise OptionError(f"image '{unfit}': trainers want a flat name with one dot")
        with (partial / "tracks.npz").open("wb") as file:
            # Names are kept by np.savez as they are.
            np.savez(file, **vars(tracks), names=np.array(chosen.names), frames=chosen.frames)
        return {
            "num_frames": tracks.num_frames,
            "num_images": len(chosen.names),
            "num_tracks": len(tracks.offsets) - 1,
            "warnings": list(tracked.warnings),
        }

    given = (options.images, options.read, options.tracks, options.refine, options.encode)
    frame_list = options.images.frame_list
    listed = _identity(Path(frame_list)) if frame_list is not None else None
    return run_stage(
        run.stages,
        "tracks",
        [*map(_identity, (source.stream, source.pictures)), given, listed],
        into=run.stages,
        products=["tracks.npz"],
        make=make,
    )


def _identity(path: Path) -> tuple[str, int, int]:
    """What tells a file apart from one that takes its place."""
    status = path.stat()
    return str(path.resolve()), status.st_size, status.st_mtime_ns


def _read_tracks(stages: Path) -> tuple[Tracks, ChosenImages]:
    with np.load(stages / "tracks.npz") as file:
        arrays = {field.name: file[field.name] for field in dataclasses.fields(Tracks)}
        chosen = ChosenImages([str(name) for name in file["names"]], file["frames"])
    for name in ("num_frames", "width", "height"):
        arrays[name] = int(arrays[name])
    return Tracks(**arrays), chosen


def _match_stage(run: _Run, tracks: Tracks, chosen: ChosenImages, tracked: Kept) -> Kept:
    options, clock, progress = run.options, run.clock, run.progress
    density = DensityOptions(
        preset="sparse",
        max_tracks_per_image=options.mapping.pose_tracks_per_image,
        spacing=options.mapping.pose_spacing,
        # What drifts still ties distant images together; poses bend without.
        max_sigma=0.0,
    )

    def make(partial: Path) -> dict[str, Any]:
        with clock.measure("pairs"):
            seen = np.isin(tracks.frame, chosen.frames)
            sparse = select_tracks(keep_observations(tracks, seen), density)
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


def _pose_stage(run: _Run, matched: Kept, num_images: int) -> Kept:
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
                num_threads=options.match.verify.num_threads,
                log=run.stages / "mapper.log",
                num_images=num_images,
                progress=progress,
            )
        if not mapped.num_images:
            raise ModelError(_why_no_start(matched.facts, mapper))
        return {
            "num_registered": mapped.num_images[0],
            "other_models": list(mapped.num_images[1:]),
            "mapper": mapper,
            "poses": "poses",
        }

    given = (mapper, refine, forward, options.match.verify.seed, pycolmap.__version__)
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
    if facts["num_verified_pairs"] < facts["num_pairs"] / 2 or facts["keypoints_per_image"] < 100:
        return (
            f"{told}: too few tracks, {facts['keypoints_per_image']:.0f} an image and "
            f"{facts['num_verified_pairs']} of {facts['num_pairs']} pairs that agree with a rigid "
            "scene: 'colmap-av1 info' says what the stream lacks, --reencode 1 converts it anew"
        )
    if facts["num_flat_pairs"] > facts["num_verified_pairs"] / 2:
        return (
            f"{told}: too little parallax, in {facts['num_flat_pairs']} of "
            f"{facts['num_verified_pairs']} pairs the camera only turns or the scene is flat: film "
            "while moving sideways, or give a longer part of the video"
        )
    if facts["guessed"]:
        return (
            f"{told}: the focal length is a guess and may be far off, or the parallax too little: "
            f"give --camera_model and --camera_params, or try --mapper {other}"
        )
    return (
        f"{told}: the parallax between images that share tracks is too little, or the intrinsics "
        f"do not fit: give --camera_model and --camera_params, or try --mapper {other}"
    )


def _adjustment_stage(run: _Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    """Adjust the poses on more tracks than the mapper can take: long ones, spread over the images.

    The mapper's own adjustments have no robust loss, and drop what drifts.
    """
    options = run.options
    refine = _refines_intrinsics(options)

    def make(partial: Path) -> dict[str, Any]:
        placed = _read_placed(run, posed, chosen)
        seen = keep_observations(tracks, np.isin(tracks.frame, placed.frames))
        chosen_tracks = select_tracks(seen, _ADJUSTED)
        with run.clock.measure("adjustment"):
            seen, view = _seen_in(chosen_tracks, placed.frames)
            points = _triangulate_all(
                *(seen, view, [placed.camera] * len(placed.images)),
                *([i.cam_from_world for i in placed.images], None),
                options=TriangulateOptions(),
                num_threads=options.match.verify.num_threads,
                progress=no_progress,
            )
            _check_any_point(points)
            folder = partial / "adjusted"
            folder.mkdir()
            black = np.zeros((len(points.xyz), 3), np.uint8)
            xy = seen.xy[points.observation].astype(np.float64)
            cameras = {int(placed.camera.camera_id): placed.camera}
            write_model(folder, cameras, placed.images, _model_points(points, black, view, xy))
            run.progress("adjustment", 0, 1)
            adjust_model(
                folder,
                refine_intrinsics=refine,
                loss_scale=_LOSS_SCALE,
                seed=options.match.verify.seed,
                num_threads=options.match.verify.num_threads,
                log=run.stages / "adjustment.log",
            )
            run.progress("adjustment", 1, 1)
        return {"poses": "adjusted"}

    given = (_ADJUSTED, _LOSS_SCALE, refine, options.match.verify.seed, pycolmap.__version__)
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


def _read_placed(run: _Run, posed: Kept, chosen: ChosenImages) -> _Placed:
    poses = read_model(run.stages / posed.facts["poses"])
    by_name = {i.name: i for i in poses.images.values() if i.has_pose}
    index = [i for i, name in enumerate(chosen.names) if name in by_name]
    names = [chosen.names[i] for i in index]
    camera = poses.cameras[by_name[names[0]].camera_id]
    images = [
        ModelImage(
            i + 1,
            name,
            int(camera.camera_id),
            np.asarray(by_name[name].cam_from_world().matrix()),
        )
        for i, name in enumerate(names)
    ]
    return _Placed(images, chosen.frames[index], camera)


def _check_any_point(points: Points) -> None:
    if len(points.xyz) == 0:
        raise ModelError(
            f"none of the {points.num_tracks} tracks agrees with the poses: try the other "
            "--mapper, or give --camera_params"
        )


def _model_stage(run: _Run, tracks: Tracks, chosen: ChosenImages, posed: Kept) -> Kept:
    options, clock, progress = run.options, run.clock, run.progress
    source = run.source
    num_threads = options.match.verify.num_threads

    def make(partial: Path) -> dict[str, Any]:
        placed = _read_placed(run, posed, chosen)
        distorted, frames = placed.camera, placed.frames
        camera = pinhole_camera(distorted)
        images = [replace(image, camera_id=1) for image in placed.images]
        names = [image.name for image in images]
        seen, view = _seen_in(tracks, frames)
        with clock.measure("points"):
            points = _triangulate_all(
                *(seen, view, [distorted] * len(images)),
                *([i.cam_from_world for i in images], camera),
                options=options.triangulate,
                num_threads=num_threads,
                progress=progress,
            )
        _check_any_point(points)
        colours = _Colours(seen, view, points, len(images))
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
                num_threads=num_threads,
                operating_point=options.match.read.operating_point,
                change=change,
                progress=lambda done: progress("images", done, len(names)),
            )
        with clock.measure("writing"):
            folder = partial / "sparse" / "0"
            folder.mkdir(parents=True)
            xy = on_pinhole(distorted, camera, seen.xy[points.observation])
            write_model(
                folder, {1: camera}, images, _model_points(points, colours.mean(), view, xy)
            )
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


def _seen_in(tracks: Tracks, frames: NDArray[np.int32]) -> tuple[Tracks, NDArray[np.int64]]:
    """The tracks in some frames only, and the index into `frames` of each observation."""
    place = np.full(tracks.num_frames, -1, dtype=np.int64)
    place[frames] = np.arange(len(frames))
    seen = keep_observations(tracks, place[tracks.frame] >= 0)
    return seen, place[seen.frame]


def _triangulate_all(
    tracks: Tracks,
    view: NDArray[np.int64],
    cameras: Sequence[Any],
    poses: Sequence[NDArray[np.float64]],
    pinhole: Any | None,
    *,
    options: TriangulateOptions,
    num_threads: int | None,
    progress: Progress,
) -> Points:
    """Triangulate all tracks; errors are in pixels of `pinhole`, else of each image's camera."""
    rays = np.full((len(view), 2), np.nan)
    camera_of_view = np.array([int(camera.camera_id) for camera in cameras])
    for camera in {int(camera.camera_id): camera for camera in cameras}.values():
        own = camera_of_view[view] == int(camera.camera_id)
        rays[own] = np.asarray(camera.cam_from_img(tracks.xy[own].astype(np.float64)))
    shown = [pinhole if pinhole is not None else camera for camera in cameras]
    focal = np.array([[c.focal_length_x, c.focal_length_y] for c in shown])
    num_tracks = len(tracks.offsets) - 1
    return triangulate(
        Sightings(tracks.offsets, view, rays, tracks.sigma),
        Views(np.stack(poses), focal),
        options,
        num_threads=num_threads,
        progress=lambda done: progress("points", done, num_tracks),
    )


class _Colours:
    """Mean colour of points over the pictures that see them, picture by picture."""

    def __init__(
        self, tracks: Tracks, view: NDArray[np.int64], points: Points, num_images: int
    ) -> None:
        self._size = np.array([tracks.width, tracks.height])
        self._sum = np.zeros((len(points.xyz), 3))
        self._count = np.zeros(len(points.xyz))
        image = view[points.observation]
        point = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
        order = np.argsort(image, kind="stable")
        self._bounds = np.searchsorted(image[order], np.arange(num_images + 1))
        self._point = point[order]
        self._xy = tracks.xy[points.observation[order]]

    def add(self, image: int, picture: _Image) -> None:
        """Look at the picture (BGR, of any scale) of an image."""
        own = slice(self._bounds[image], self._bounds[image + 1])
        size = np.array(picture.shape[1::-1])
        x, y = np.clip((self._xy[own] * size / self._size).astype(np.int64), 0, size - 1).T
        # A point is seen in an image once, or twice where two of its tracks' parts meet.
        np.add.at(self._sum, self._point[own], picture[y, x, ::-1])
        np.add.at(self._count, self._point[own], 1.0)

    def mean(self) -> _Image:
        """Colours uint8 [num_points, 3], red first."""
        mean = self._sum / np.maximum(self._count, 1.0)[:, None]
        return np.round(mean).astype(np.uint8)


def _model_points(
    points: Points,
    rgb: _Image,
    view: NDArray[np.int64],
    xy: NDArray[np.float64],
) -> ModelPoints:
    return ModelPoints(points.xyz, rgb, points.error, points.offsets, view[points.observation], xy)


def _pictures(source: VideoSource, options: MatchOptions) -> Iterator[tuple[int, _Image]]:
    return decode_frames(
        source.pictures,
        operating_point=options.read.operating_point,
        num_threads=options.verify.num_threads,
    )


def _notes(facts: dict[str, Any]) -> list[str]:
    notes = []
    if facts["num_registered"] < facts["num_images"]:
        notes.append(
            f"{facts['num_images'] - facts['num_registered']} of {facts['num_images']} images have "
            "no pose and are left out"
        )
    if facts["other_models"]:
        sizes = ", ".join(map(str, facts["other_models"]))
        notes.append(f"the mapper made further models, of {sizes} images, which are left out")
    if facts["num_flat_pairs"] > _MANY_FLAT * facts["num_verified_pairs"]:
        notes.append(
            f"in {facts['num_flat_pairs']} of {facts['num_verified_pairs']} pairs the camera only "
            "turns or the scene is flat: the depth of the points may mean nothing; film while "
            "moving sideways"
        )
    if facts["agreeing"] < _LEAST_AGREEING:
        notes.append(
            f"only {facts['agreeing']:.0%} of the tracks agree with the poses, which may be wrong: "
            "try the other --mapper, or give --camera_params"
        )
    return notes


def _write_report(report: ReconstructReport) -> None:
    text = json.dumps(dataclasses.asdict(report), indent=1, default=str)
    path = report.output / "report.json"
    try:
        with whole_file(path) as partial:
            partial.write_text(text + "\n")
    except OSError as error:
        raise ModelError(f"{path}: cannot be written: {error.strerror}") from error
