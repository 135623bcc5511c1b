"""The videos and photos of a run, opened once and distinguished by names."""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.errors import OptionError, VideoError
from colmap_av1.geometry.masks import Mask
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.image_set import ImageSet, number_images
from colmap_av1.images.masks import Masks, VideoMasks, read_masks
from colmap_av1.images.names import plain_name
from colmap_av1.images.photos import Photo, photo_files, read_photos
from colmap_av1.options import CameraOptions, MatchOptions
from colmap_av1.options.images import LONGEST_NAME
from colmap_av1.util.digests import file_digest
from colmap_av1.video.facts import Video, count_shown, read_video
from colmap_av1.video.metadata.lens import implausible_focal_length
from colmap_av1.video.metadata.positions import implausible_position
from colmap_av1.video.metadata.spherical import check_is_plane, spherical_warnings
from colmap_av1.video.unchanged import FileState

_Path = str | os.PathLike[str]


@dataclass(frozen=True)
class Inputs:
    """The videos and photos of a run.

    Attributes:
        videos: the videos, in the given order.
        labels: the folder of each video's images in the folder of all images; '' for a single
            video.
        photos: the photos.
        masks: their masks; None: all pixels are used.
        warnings: warnings about them.
    """

    videos: tuple[Video, ...]
    labels: tuple[str, ...]
    photos: tuple[Photo, ...] = ()
    masks: Masks | None = None
    warnings: tuple[str, ...] = ()

    @property
    def states(self) -> tuple[FileState, ...]:
        """The states of all files at the start."""
        return (*(video.state for video in self.videos), *(photo.state for photo in self.photos))

    def keep_videos_of(self, names: Collection[str]) -> Inputs:
        """Keep the videos of which a model has images; a warning names the others.

        If nothing connects the videos, a mapper makes a separate model of each. If the model has
        images of none of them, all are kept.

        Args:
            names: names of the model's images.
        """
        kept = [any(name.startswith(f"{label}/") for name in names) for label in self.labels]
        if all(kept) or not any(kept):
            return self
        unused = [str(v) for v, is_kept in zip(self.videos, kept, strict=True) if not is_kept]
        return replace(
            self,
            videos=tuple(itertools.compress(self.videos, kept)),
            labels=tuple(itertools.compress(self.labels, kept)),
            warnings=(*self.warnings, f"the model has no image of {', '.join(unused)}"),
        )

    @property
    def masks_of_videos(self) -> list[VideoMasks | None]:
        """The masks of each video; None for a video without masks."""
        return [self.masks.of_video(label) if self.masks else None for label in self.labels]

    def image_set(
        self,
        chosen: Sequence[ChosenImages],
        num_frames: Sequence[int],
        photos: Sequence[Photo] | None = None,
    ) -> ImageSet:
        """The image set, with its masks.

        Args:
            chosen: the images of each video.
            num_frames: number of frames of each video.
            photos: the photos that become images; None: all.

        Raises:
            ImageError: some images of a video have a mask, and others have none.
        """
        photos = photos if photos is not None else self.photos
        masks = self._masks_of_images(chosen, photos)
        names = [photo.name for photo in photos]
        return number_images(self.labels, chosen, num_frames, names, masks=masks)

    def _masks_of_images(
        self, chosen: Sequence[ChosenImages], photos: Sequence[Photo]
    ) -> list[list[Mask | None]]:
        """The masks of the images of each video, then of the photos; None for images without."""
        if self.masks is None:
            return []
        of_videos: list[list[Mask | None]] = [
            list[Mask | None](masks.of(own)) if masks is not None else [None] * len(own.names)
            for own, masks in zip(chosen, self.masks_of_videos, strict=True)
        ]
        return [*of_videos, [self.masks.of_photo(photo.name, photo.size) for photo in photos]]

    def with_names(self, of_videos: Sequence[Sequence[str]]) -> list[str]:
        """See `notes_of_videos`."""
        return notes_of_videos(self.videos, of_videos)

    def conversion(self, of_videos: Sequence[str | None]) -> str | None:
        """Description of how videos were converted; None if none was."""
        given = [[words] if words is not None else [] for words in of_videos]
        return "; ".join(self.with_names(given)) or None

    @property
    def name(self) -> str:
        """Name of all videos for messages."""
        return ", ".join(str(video) for video in self.videos)


def notes_of_videos(videos: Sequence[Video], of_videos: Sequence[Sequence[str]]) -> list[str]:
    """Notes about each video, prefixed with its name if there are several videos."""
    several = len(videos) > 1
    return [
        f"{video}: {note}" if several else note
        for video, notes in zip(videos, of_videos, strict=True)
        for note in notes
    ]


def paths_of(video: _Path | Sequence[_Path]) -> list[Path]:
    """The paths of a video, or of several."""
    return [Path(v) for v in ([video] if isinstance(video, str | os.PathLike) else video)]


def read_inputs(
    video: _Path | Sequence[_Path],
    photos: _Path | None,
    options: MatchOptions,
    *,
    for_trainers: bool = False,
) -> Inputs:
    """Open the videos and read the metadata of the photos of a run.

    Args:
        video: a video, or several.
        photos: folder of photos; None: no photos.
        options: options of the run, checked against the number of videos and photos.
        for_trainers: give photos names that trainers accept, see `read_photos`.

    Raises:
        VideoError: a video cannot be read, is given twice, or shows all directions.
        BitstreamError: no frame of a video can be decoded.
        ImageError: the photos or masks cannot be read, or do not fit.
        OptionError: an option does not fit.
    """
    paths = paths_of(video)
    if not paths:
        raise OptionError("no video is given: give one or several")
    folder = Path(photos) if photos is not None else None
    _check_options(len(paths), folder, options)
    files, warning = photo_files(folder) if folder is not None else ([], None)
    videos = tuple(read_video(path, options.read.operating_point) for path in paths)
    for own in videos:
        check_is_plane(own.path, own.projection, own.picture_size[0])
    _check_different(videos)
    _check_rates(videos, options.camera)
    places = []
    if len(videos) > 1:  # the images of a single video have no folder
        places = [os.path.splitext(os.path.abspath(v.path))[0] for v in videos]
    if folder is not None:
        places.append(os.path.abspath(folder))
    labels = labels_of(places)
    found = (
        read_photos(folder, files, labels[-1], for_trainers=for_trainers)
        if folder is not None
        else []
    )
    _check_one_camera(videos, found, options.camera)
    of_videos = tuple(labels[: len(videos)]) if len(videos) > 1 else ("",)
    _check_lengths(videos, of_videos)
    spherical = [
        text for v in videos for text in spherical_warnings(v.path, v.projection, v.picture_size)
    ]
    doubtful = [
        (v.doubtful_times, implausible_position(v.tags), implausible_focal_length(v.tags))
        for v in videos
    ]
    doubts = notes_of_videos(
        videos, [[note for note in own if note is not None] for own in doubtful]
    )
    notes = (*spherical, *doubts, *((warning,) if warning is not None else ()))
    inputs = Inputs(videos, of_videos, tuple(found), None, notes)
    if options.masks.mask_path is None:
        return inputs
    counts = [count_shown(video) for video in videos]
    names = [photo.name for photo in found]
    masks = read_masks(Path(options.masks.mask_path), of_videos, counts, names)
    for photo in found:
        masks.of_photo(photo.name, photo.size)  # checks the size of the mask
    return replace(inputs, masks=masks)


def labels_of(places: Sequence[str]) -> list[str]:
    """Distinct names for files or folders: their own, with their parent folders if necessary.

    Args:
        places: absolute paths, without extensions.

    Raises:
        OptionError: the names are not distinct with all parent folders either.
    """
    if not places:
        return []
    parts = [[plain_name(part) for part in Path(place).parts[1:]] or ["root"] for place in places]
    for count in range(1, max(map(len, parts)) + 1):
        labels = ["_".join(part[-count:]) for part in parts]
        # Some file systems ignore case.
        if len({label.lower() for label in labels}) == len(labels):
            return labels
    lower = [label.lower() for label in labels]
    twice = next(place for i, place in enumerate(places) if lower[i] in lower[:i])
    raise OptionError(f"{twice}: another video or folder has nearly this name: rename one")


def _check_options(num_videos: int, photos: Path | None, options: MatchOptions) -> None:
    if photos is not None and options.links.links == "none":
        raise OptionError(
            "links 'none': photos have no motion and are connected by links only: leave out "
            "--links or --photos"
        )
    if num_videos == 1:
        return
    if options.images.frame_list is not None:
        raise OptionError(
            "frame_list lists the frames of one video, but several are given: choose images by "
            "--every, --fps or --num_images, which apply to each video"
        )
    if options.keep_stream is not None:
        raise OptionError(
            "keep_stream names one file, but several videos are given: leave it out, or convert "
            "them with 'colmap-av1 encode' first"
        )


def _check_different(videos: Sequence[Video]) -> None:
    for index, video in enumerate(videos):
        for other in videos[:index]:
            if _are_same(video, other):
                raise VideoError(f"{video} and {other} are the same video: give it once")


def _check_rates(videos: Sequence[Video], options: CameraOptions) -> None:
    """Reject a read-out time in milliseconds if the frame rate of a video is unknown."""
    shutter = options.rolling_shutter
    unknown = next((video for video in videos if video.frame_rate is None), None)
    if unknown is not None and shutter not in ("none", "estimate"):
        raise OptionError(
            f"rolling_shutter is {shutter} milliseconds, but the frame rate of {unknown} is "
            "unknown: leave it out, or give a copy of the video with a frame rate"
        )


def _check_lengths(videos: Sequence[Video], labels: Sequence[str]) -> None:
    """Reject names that are too long for files such as tracks_NAME.json."""
    for video, label in zip(videos, labels, strict=True):
        if len(os.fsencode(f"tracks_{label}.json")) > LONGEST_NAME:
            raise OptionError(f"{video}: its name is too long for names of outputs: rename it")


def _are_same(a: Video, b: Video) -> bool:
    if a.state.found is None or b.state.found is None:
        return False
    if a.state.found[0] == b.state.found[0]:
        return True
    # Digests are computed only for files of the same length.
    return a.state.found[1] == b.state.found[1] and file_digest(a.path) == file_digest(b.path)


def _check_one_camera(
    videos: Sequence[Video], photos: Sequence[Photo], camera: CameraOptions
) -> None:
    """Reject a shared camera, or given intrinsics, for pictures of several sizes."""
    sizes = {str(video): video.picture_size for video in videos}
    if camera.single_camera:
        sizes |= {str(photo.path): photo.size for photo in photos}
    elif camera.camera_params is None:
        return
    first, size = next(iter(sizes.items()))
    odd = next((name for name, other in sizes.items() if other != size), None)
    if odd is None:
        return
    what = "single_camera is 1" if camera.single_camera else "camera_params apply to one size"
    raise OptionError(
        f"{what}, but {first} is {size[0]}x{size[1]} and {odd} {sizes[odd][0]}x{sizes[odd][1]}: "
        "leave it out, or give pictures of one camera"
    )
