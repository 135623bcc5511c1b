"""The video, images and camera that every front-end gets."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.images.choosing import existing_images
from colmap_av1.images.preparing import PreparedImages, prepare_images, write_prepared
from colmap_av1.matching.matched_images import pair_by_tracks, verify_images
from colmap_av1.matching.pairs import schedule_pairs
from colmap_av1.options import CameraOptions, DensityOptions, MatchOptions, PairOptions
from colmap_av1.tracks.video_tracks import open_source
from colmap_av1.util.digests import digest_if_there, file_digest
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.facts import Video
from colmap_av1.video.unchanged import unchanged


@dataclass(frozen=True, kw_only=True)
class FootageImages:
    """The frames of a video that become images.

    Attributes:
        names: file names of the images, in display order.
        frames: frame index of each image.
        num_frames: number of shown frames of the video.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        forward_motion: whether the camera moves along its optical axis, see `MatchReport`.
        warnings: warnings from choosing the images.
    """

    names: list[str]
    frames: tuple[int, ...]
    num_frames: int
    size: tuple[int, int]
    pixel_aspect: float
    forward_motion: bool = False
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Footage(FootageImages):
    """The input of every front-end.

    Attributes:
        video: the video.
        image_path: folder of the images, decoded from the video or from its original.
        camera: camera options of all images.
    """

    video: Path
    image_path: Path
    camera: CameraOptions


@dataclass(frozen=True)
class Conversion:
    """The cost of converting a video to AV1.

    Attributes:
        seconds: wall time.
        cpu_seconds: CPU time.
    """

    seconds: float
    cpu_seconds: float


def convert(
    video: Video, folder: Path, options: MatchOptions, progress: Progress = no_progress
) -> Conversion | None:
    """Convert a video to AV1 and keep the stream, unless it is there already.

    Args:
        video: the video.
        folder: folder for the cost, which is measured once.
        options: only those of reading and encoding, and `keep_stream`, are used.
        progress: called with the stage "encoding".

    Returns:
        The cost; None if it is unknown, because another run kept the stream, or if the video needs
        no conversion.

    Raises:
        ColmapAv1Error: see `match`.
    """

    def make() -> Conversion | None:
        context = RunContext.of(options.run, progress)
        with open_source(video, options.source, next_to=folder, context=context) as source:
            is_new = source.conversion is not None and not source.is_reused
        if not is_new:
            return None
        clock = context.clock
        return Conversion(clock.seconds["encoding"], clock.cpu_seconds["encoding"])

    # Other code than that of the conversion does not change the cost of the stream that is kept.
    depends_on = [file_digest(video.path), options.encode, options.reencode]
    kind = Conversion | None
    return run_stage_in(folder, depends_on, kind, make, products=[], made_by=("video",)).result


def choose_footage(
    video: Video,
    folder: Path,
    *,
    options: MatchOptions,
    image_path: Path | None = None,
    progress: Progress = no_progress,
) -> Footage:
    """Choose the frames of a video that become images, as `match` does, and write them.

    Args:
        video: a video; a video that is not AV1 is converted first.
        folder: folder for the results; results of the same video and options are kept.
        options: options of images, reading, encoding, tracks and the camera.
        image_path: folder of existing images, or to write images to; None: `images/` in the
            folder.
        progress: called with a stage's name, the amount of work done, and the total if known.

    Raises:
        ColmapAv1Error: see `match`.
    """
    images = image_path if image_path is not None else folder / "images"

    def make() -> FootageImages:
        context = RunContext.of(options.run, progress)
        with unchanged(video.state) as check_video:
            prepared = prepare_images(
                video,
                images,
                options,
                listed={},
                next_to=folder / "result.json",
                context=context,
            )
            chosen = prepared.tracked.chosen
            check_video()
            write_prepared(prepared, images, options.reading, progress)
        return FootageImages(
            names=chosen.names,
            frames=tuple(chosen.frames.tolist()),
            num_frames=prepared.tracked.tracks.num_frames,
            size=prepared.shown.size,
            pixel_aspect=prepared.shown.pixel_aspect,
            forward_motion=_is_forward_motion(prepared, options),
            warnings=prepared.tracked.video.warnings,
        )

    given = (
        options.images,
        options.camera,
        options.read,
        options.encode,
        options.reencode,
        options.tracks,
        options.refine,
        options.verify,
    )
    # A folder that is not given only holds images that this stage wrote.
    existing = list[str]()
    if image_path is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # `prepare_images` gives them
            existing = existing_images(images, options.images, video.picture_size)
    depends_on = [
        file_digest(video.path),
        given,
        images,
        digest_if_there(options.images.frame_list),
        [file_digest(images / name) for name in existing],
    ]
    chosen = run_stage_in(folder, depends_on, FootageImages, make, products=[images]).result
    return Footage(**vars(chosen), video=video.path, image_path=images, camera=options.camera)


def frame_list(footage: Footage, path: Path) -> str:
    """Write the frame and name of each image, in the format of `ImageOptions.frame_list`.

    Args:
        footage: the images.
        path: the file.

    Returns:
        The file's path.
    """
    each = zip(footage.frames, footage.names, strict=True)
    path.write_text("".join(f"{frame} {name}\n" for frame, name in each))
    return str(path)


def _is_forward_motion(prepared: PreparedImages, options: MatchOptions) -> bool:
    """Whether the camera moves along its optical axis."""
    camera = make_camera(options.camera, *prepared.shown.size, prepared.shown.pixel_aspect)
    context = RunContext.of(options.run)
    sparse = prepared.with_selected_tracks(DensityOptions(preset="sparse"), context.clock).tracked
    choose = partial(schedule_pairs, options=PairOptions(offsets=(1,), growth=1.0))
    paired = pair_by_tracks(sparse.tracks, sparse.chosen.frames, choose)
    cameras = [camera] * len(paired.keypoints)
    return verify_images(paired, cameras, options.verify, context).forward_motion
