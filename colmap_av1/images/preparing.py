"""Prepare the images of a video: choose its frames, and express its tracks in their pixels."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.images.blur import blur_warning
from colmap_av1.images.choosing import check_frame_list, existing_images
from colmap_av1.images.files import check_image_folder, check_images_there, image_size, write_images
from colmap_av1.images.image_set import ImageSet, ShownVideo
from colmap_av1.images.inputs import Inputs
from colmap_av1.images.masks import VideoMasks
from colmap_av1.images.names import names_of_all
from colmap_av1.images.orientation import ShownImages, shown_images
from colmap_av1.images.photos import copy_photos
from colmap_av1.images.recognising import check_content, frames_near
from colmap_av1.images.track_images import (
    ImageChoice,
    TrackedImages,
    decode_pictures,
    track_chosen_images,
)
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    MatchOptions,
    ReadOptions,
)
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.video_tracks import VideoSource, open_source
from colmap_av1.util.progress import Clock, Progress
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

    def with_selected_tracks(self, density: DensityOptions, clock: Clock) -> PreparedImages:
        """Keep only the tracks in the images that are selected for matching.

        Args:
            density: which tracks are selected.
            clock: gets the stage "pairs".
        """
        tracked = self.tracked
        with clock.measure("pairs"):
            tracks = select_tracks(tracked.tracks.keep_frames(tracked.chosen.frames), density)
        return replace(self, tracked=tracked.with_tracks(tracks))


@dataclass(frozen=True)
class PreparedInputs:
    """The images of all videos and photos before matching.

    Attributes:
        inputs: the videos and photos.
        videos: the images of each video.
        image_set: all images, numbered consecutively.
    """

    inputs: Inputs
    videos: Sequence[PreparedImages]
    image_set: ImageSet

    @property
    def shown(self) -> tuple[ShownVideo, ...]:
        """The videos, whose pictures are shown in the size of the images."""
        return tuple(
            ShownVideo.in_images(own.shown, own.source.pictures, own.source.kept)
            for own in self.videos
        )


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
    prepared = PreparedImages(
        source=source,
        shown=shown,
        tracked=found.with_tracks(found.tracks.scale_to(size)),
        existed=bool(existing),
    )
    if folder is not None:
        names, frames = found.chosen.names, found.chosen.frames.tolist()
        check_image_folder(folder, names, size)
        files = [(folder / name, frame) for name, frame in zip(names, frames, strict=True)]
        kept = [(file, frame) for file, frame in files if file.exists()]
        if not existing and kept:
            # Another program may have numbered other frames than the pattern does.
            some = [kept[0], kept[min(_CHECKED, len(kept) - 1)]]
            _check_files(prepared, some, options.reading, context)
    return prepared


def _check_files(
    prepared: PreparedImages,
    images: Sequence[tuple[Path, int]],
    read: ReadOptions,
    context: RunContext,
) -> None:
    """Check that image files show their frames of the video.

    Args:
        prepared: the images of the video.
        images: each file, and the frame that it should show, in ascending order of frames.
        read: how the video is decoded.
        context: its progress is called.

    Raises:
        ImageError: an image shows something else.
    """
    files, frames = [file for file, _ in images], [frame for _, frame in images]
    pictures = decode_pictures(
        prepared.source,
        prepared.tracked.tracks.num_frames,
        read,
        prepared.shown.display,
        wanted=frames_near(frames),
        context=context,
    )
    check_content(files, frames, pictures)


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
    prepared: PreparedInputs,
    folder: Path,
    read: ReadOptions,
    context: RunContext,
    *,
    before: Collection[Path],
) -> tuple[int, list[str]]:
    """Write the images of videos, see `write_prepared`, and copy the photos.

    Args:
        prepared: the images.
        folder: folder for all images.
        read: how the videos are decoded.
        context: its progress is called in the stages "images" and "recognising".
        before: files in the folder when this run began.

    Returns:
        The number of images and photos written, and warnings about the images.

    Raises:
        ImageError: another run has written images since this one began, of another video.
    """
    of_videos = [
        (own, folder / label)
        for own, label in zip(prepared.videos, prepared.inputs.labels, strict=True)
    ]
    for own, own_folder in of_videos:
        chosen = own.tracked.chosen
        for name, frame in zip(chosen.names, chosen.frames.tolist(), strict=True):
            path = own_folder / name
            if path not in before and path.exists():
                _check_files(own, [(path, frame)], read, context)
                break
    num_written = copy_photos(prepared.inputs.photos, folder)
    warnings = list[str]()
    for own, own_folder in of_videos:
        num_written += write_prepared(own, own_folder, read, context.progress)
        warning = blur_warning([own_folder / name for name in own.tracked.chosen.names])
        warnings += [warning] if warning is not None else []
    return num_written, warnings
