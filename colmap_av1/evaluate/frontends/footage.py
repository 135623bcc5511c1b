"""The images of a video that every front-end is given."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_av1.errors import VideoError
from colmap_av1.geometry.cameras import make_camera
from colmap_av1.images.files import existing_images, write_images
from colmap_av1.images.names import image_names
from colmap_av1.images.preparing import PreparedImages, prepare_images, write_prepared
from colmap_av1.matching.image_matches import pair_images, verify_images
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    MatchOptions,
    PairOptions,
)
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import least_length
from colmap_av1.util.digests import digest_if_there, file_digest
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.stages import run_stage_in
from colmap_av1.video.facts import Video, read_video
from colmap_av1.video.unchanged import unchanged


@dataclass(frozen=True)
class Footage:
    """What every front-end is given.

    Attributes:
        video: a video.
        image_path: folder that holds the images, decoded from the video or what it was made of.
        names: the images' file names, in display order.
        frames: the video's frames that are images.
        num_frames: shown frames of the video.
        size: (width, height) of the images.
        pixel_aspect: width of a pixel over its height.
        camera: the camera of all images.
        forward_motion: the camera moves along its axis, see `MatchReport`.
        warnings: what was noticed while the images were chosen.
        existed: others wrote the images, which may be scaled.
    """

    video: Path
    image_path: Path
    names: list[str]
    frames: tuple[int, ...]
    num_frames: int
    size: tuple[int, int]
    pixel_aspect: float
    camera: CameraOptions
    forward_motion: bool = False
    warnings: tuple[str, ...] = ()
    existed: bool = False


def prepare_footage(
    video: Path, folder: Path, *, num_frames: int, image_step: int, camera: CameraOptions
) -> Footage:
    """Write the video's frames as the images that every front-end gets.

    Args:
        video: an AV1 video.
        folder: gets `images/`; what is there of the same video is kept.
        num_frames: number of frames of the video.
        image_step: distance between the frames that are images.
        camera: the camera of all images.

    Raises:
        VideoError: the video cannot be read.
        ImageError: the video has fewer frames.
    """
    frames = tuple(range(0, num_frames, image_step))
    opened = read_video(video)
    footage = Footage(
        video=video,
        image_path=folder / "images",
        names=image_names(ImageOptions().file_name, frames),
        frames=frames,
        num_frames=num_frames,
        size=opened.picture_size,
        pixel_aspect=opened.display.pixel_aspect,
        camera=camera,
    )

    def make() -> dict[str, Any]:
        footage.image_path.mkdir()
        write_images(opened, footage.image_path, footage.names, frames)
        return {}

    run_stage_in(folder, [file_digest(video), frames], make, products=[footage.image_path])
    return footage


def choose_footage(
    video: Video,
    folder: Path,
    *,
    options: MatchOptions,
    image_path: Path | None = None,
    progress: Progress = no_progress,
) -> Footage:
    """Choose the video's frames that are images, as `match` does, and write them.

    Args:
        video: a video; one that is not AV1 is converted first.
        folder: what is there of the same video and options is kept.
        options: those of the images, of reading and of the camera are used.
        image_path: folder of images that exist or are written; None: `images/` in the folder.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        ColmapAv1Error: as `match` says.
    """
    images = image_path if image_path is not None else folder / "images"

    def make() -> dict[str, Any]:
        context = RunContext.of(options.run, progress=progress)
        existed = bool(existing_images(images, options.images.file_name))
        with unchanged(video.state) as check_video:
            prepared = prepare_images(
                video,
                images,
                options,
                listed={},
                beside=folder / "result.json",
                context=context,
            )
            chosen = prepared.tracked.chosen
            check_video()
            write_prepared(prepared, images, options.reading, progress)
        return {
            "names": chosen.names,
            "frames": chosen.frames.tolist(),
            "num_frames": prepared.tracked.tracks.num_frames,
            "size": prepared.size,
            "pixel_aspect": prepared.pixel_aspect,
            "forward_motion": _is_forward_motion(prepared, video.path, options),
            "warnings": prepared.tracked.video.warnings,
            "existed": existed,
        }

    given = (options.images, options.camera, options.read, options.encode, options.tracks)
    depends_on = [
        file_digest(video.path),
        given,
        images,
        digest_if_there(options.images.frame_list),
        [file_digest(images / n) for n in existing_images(images, options.images.file_name)],
    ]
    facts = run_stage_in(folder, depends_on, make, products=[images]).result
    for name in ("frames", "size", "warnings"):
        facts[name] = tuple(facts[name])
    return Footage(video=video.path, image_path=images, camera=options.camera, **facts)


def frame_list(footage: Footage, path: Path, names: Collection[str] | None = None) -> str:
    """Write which frames the images are, as `frame_list` of ImageOptions reads it.

    Args:
        footage: the images.
        path: the file.
        names: the images that are listed; all if None.

    Returns:
        The file's path.
    """
    each = zip(footage.frames, footage.names, strict=True)
    path.write_text("".join(f"{f} {n}\n" for f, n in each if names is None or n in names))
    return str(path)


def _is_forward_motion(prepared: PreparedImages, video: Path, options: MatchOptions) -> bool:
    """Whether the camera moves along its axis; decided only with known intrinsics."""
    if options.camera.camera_params is None:
        return False
    tracks, chosen = prepared.tracked.tracks, prepared.tracked.chosen
    seen = tracks.keep_frames(chosen.frames)
    camera = make_camera(options.camera, *prepared.size, prepared.pixel_aspect)
    context = RunContext.of(options.run)
    try:
        paired = pair_images(
            video,
            select_tracks(seen, DensityOptions(preset="sparse")),
            chosen,
            PairOptions(offsets=(1,), growth=1.0),
            min_length=least_length(options.tracks),
            context=context,
        )
    except VideoError:  # no two images share tracks; other front-ends may still match them
        return False
    return verify_images(paired, camera, options.verify, context).forward_motion
