"""Prepare the images of a video: choose its frames, and express its tracks in their pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.images.blur import blur_warning
from colmap_av1.images.choosing import check_frame_list, existing_images
from colmap_av1.images.files import check_image_folder, check_images_there, image_size, write_images
from colmap_av1.images.masks import VideoMasks
from colmap_av1.images.names import names_of_all
from colmap_av1.images.orientation import ShownImages, shown_images
from colmap_av1.images.recognising import check_content, frames_near
from colmap_av1.images.track_images import (
    ImageChoice,
    TrackedImages,
    decode_pictures,
    track_chosen_images,
)
from colmap_av1.options import CameraOptions, ImageOptions, MatchOptions, ReadOptions
from colmap_av1.tracks.video_tracks import VideoSource, open_source
from colmap_av1.util.progress import Progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.facts import Video, count_shown
from colmap_av1.video.unchanged import unchanged

# Index of the second image of an earlier run whose content is checked. Checking the last one would
# decode the whole video.
_CHECKED = 10


@dataclass(frozen=True)
class PreparedImages:
    """The images of a video before matching.

    Attributes:
        source: the video; a stream that is not kept no longer exists.
        shown: how the images show it.
        tracked: the tracks, in pixels of the images, and the images.
        existed: whether there were images, so that their names need not show the frames.
    """

    source: VideoSource
    shown: ShownImages
    tracked: TrackedImages
    existed: bool


def check_fit(
    camera: CameraOptions, images: ImageOptions, size: tuple[int, int], pixel_aspect: float
) -> None:
    """Check the options for the images of a video before any work.

    Args:
        camera: camera options.
        images: how the images are chosen.
        size: (width, height) of the images.
        pixel_aspect: width of the images' pixels over their height.

    Raises:
        ImageError: the list of frames cannot be read.
        OptionError: the camera's parameters do not fit the images.
    """
    make_camera(camera, *size, pixel_aspect)
    check_frame_list(images)


def prepare_images(
    video: Video,
    folder: Path | None,
    options: MatchOptions,
    *,
    listed: Mapping[str, tuple[int, int]],
    masks: VideoMasks | None = None,
    next_to: Path,
    context: RunContext,
) -> PreparedImages:
    """Chain the motion of a video into tracks and find or choose the frames that are images.

    Args:
        video: a video.
        folder: folder of the images, which may exist; None: no images are written.
        options: all are used except those of density, pairs and verification.
        listed: (width, height) of images in an existing database, by name.
        masks: masks of the pictures; None: all pixels are used.
        next_to: the output file, see `open_source`.
        context: measures the choice of images and the stages of `track_video`.

    Raises:
        VideoError: the video cannot be read.
        BitstreamError: the stream is damaged before its second frame, or anywhere if
            `options.read.strict` is set.
        ImageError: images, names or masks do not fit the video.
        OptionError: an option does not fit the video or its images.
    """
    # All checks run before the long work.
    sizes = dict(listed)
    if folder is not None and not listed:
        there = existing_images(folder, options.images, video.picture_size)
        sizes = {name: image_size(folder / name) for name in there}
    shown = shown_images(video, sizes, folder)
    size, existing = shown.size, list(sizes)
    check_fit(options.camera, options.images, size, shown.pixel_aspect)
    if folder is not None:
        check_image_folder(folder, existing or options.images.file_name, size)
        if size != shown.video_size:
            check_images_there(folder, existing)
    if masks is not None:
        names = existing or names_of_all(options.images, count_shown(video))
        masks.check([size, shown.video_size], names, options.images)

    with (
        open_source(video, options.source, next_to=next_to, context=context) as source,
        unchanged(source.stream.state),
    ):
        found = track_chosen_images(
            source,
            options.tracking,
            ImageChoice(options.images, existing, folder, shown.display),
            masks=masks,
            one_size=folder is not None,
            every_frame=options.camera.needs_every_frame,
            context=context,
        )
    if folder is not None:
        names, frames = found.chosen.names, found.chosen.frames.tolist()
        check_image_folder(folder, names, size)
        kept = [(n, f) for n, f in zip(names, frames, strict=True) if (folder / n).exists()]
        if not existing and kept:
            # Another program may have numbered other frames than the pattern does.
            some = dict([kept[0], kept[min(_CHECKED, len(kept) - 1)]])
            pictures = decode_pictures(
                source,
                found.tracks.num_frames,
                options.reading,
                shown.display,
                wanted=frames_near(some.values()),
                context=context,
            )
            check_content([folder / name for name in some], list(some.values()), pictures)
    return PreparedImages(
        source=source,
        shown=shown,
        tracked=found.with_tracks(found.tracks.scale_to(size)),
        existed=bool(existing),
    )


def write_prepared(
    prepared: PreparedImages, folder: Path, read: ReadOptions, progress: Progress
) -> int:
    """Write the images of a video, see `write_images`.

    Args:
        prepared: the images.
        folder: folder for the images.
        read: how the video is decoded.
        progress: called in the stage "images".

    Returns:
        The number of images written; the others existed.
    """
    chosen = prepared.tracked.chosen
    return write_images(
        prepared.source.pictures,
        folder,
        chosen.names,
        chosen.frames.tolist(),
        num_threads=read.num_threads,
        operating_point=read.operating_point,
        display=prepared.shown.display,
        kept=prepared.source.kept,
        progress=lambda done: progress("images", done, len(chosen.names)),
    )


def write_all_prepared(
    videos: Iterable[tuple[str, PreparedImages]],
    folder: Path,
    read: ReadOptions,
    progress: Progress,
) -> tuple[int, list[str]]:
    """Write the images of videos, see `write_prepared`.

    Args:
        videos: the subfolder of each video's images, and the prepared images.
        folder: folder for all images.
        read: how the videos are decoded.
        progress: called in the stage "images".

    Returns:
        The number of images written, and warnings about the images.
    """
    num_written, warnings = 0, list[str]()
    for label, own in videos:
        num_written += write_prepared(own, folder / label, read, progress)
        warning = blur_warning([folder / label / name for name in own.tracked.chosen.names])
        warnings += [warning] if warning is not None else []
    return num_written, warnings
