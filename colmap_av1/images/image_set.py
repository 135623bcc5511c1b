"""The image set of several videos and photos, and the pictures of its images."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask, joined_masks
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.files import read_image
from colmap_av1.images.orientation import ShownImages
from colmap_av1.options import ReadOptions
from colmap_av1.tracks.video_tracks import decodable_frames
from colmap_av1.util.arrays import Ints, Picture
from colmap_av1.video.facts import Video
from colmap_av1.video.kept_pictures import KeptPictures

# Yields the pictures of images, given by their indices, in ascending order.
Pictures = Callable[[list[int]], Iterator[tuple[int, Picture]]]


@dataclass(frozen=True)
class ImageSet:
    """The frames of videos and the photos that become images.

    Every video is a sequence of frames, and every photo is a sequence of one frame. Frames are
    numbered through all sequences, in the order of the sequences.

    Attributes:
        videos: the folder of each video's images, which is its name in messages; '' for a single
            video. The videos are the first sequences.
        images: names of the images, and their frames, numbered through all sequences.
        sequence: int32 [num_images] the sequence of each image, ascending.
        first_frame: int64 [num_sequences + 1] first frame of each sequence, and `num_frames`.
        masks: which pixels of each image are used; None for all.
    """

    videos: tuple[str, ...]
    images: ChosenImages
    sequence: NDArray[np.int32]
    first_frame: Ints
    masks: tuple[Mask | None, ...]

    @property
    def num_frames(self) -> int:
        """Number of frames of all sequences."""
        return int(self.first_frame[-1])

    @property
    def num_sequences(self) -> int:
        """Number of videos and photos."""
        return len(self.first_frame) - 1

    @property
    def masked(self) -> float | None:
        """Share of the images' pixels that masks exclude; None without masks."""
        if all(mask is None for mask in self.masks):
            return None
        return 1.0 - sum(m.share if m is not None else 1.0 for m in self.masks) / len(self.masks)

    @property
    def photos(self) -> range:
        """The images that are photos, which follow those of the videos."""
        first = int(np.searchsorted(self.sequence, len(self.videos)))
        return range(first, len(self.sequence))

    def images_of(self, sequence: int) -> range:
        """The images of a sequence."""
        first, last = np.searchsorted(self.sequence, [sequence, sequence + 1])
        return range(int(first), int(last))

    def some(self, index: Sequence[int] | Ints) -> ImageSet:
        """Select images by their indices, which must ascend."""
        chosen = np.asarray(index, dtype=np.int64)
        masks = tuple(self.masks[i] for i in chosen)
        taken = self.sequence[chosen]
        return replace(self, images=self.images.some(index), sequence=taken, masks=masks)

    def masked_by(self, others: Mapping[str, Mask]) -> ImageSet:
        """The images with their masks joined with those of their names in `others`, if any."""
        masks = zip(self.masks, self.images.names, strict=True)
        return replace(
            self, masks=tuple(joined_masks(mask, others.get(name)) for mask, name in masks)
        )

    def of_video(self, video: int) -> ChosenImages:
        """The images of a video, with frames numbered within the video."""
        own = self.images_of(video)
        names = self.images.names[own.start : own.stop]
        frames = self.images.frames[own.start : own.stop] - self.first_frame[video]
        return ChosenImages(names, frames.astype(np.int32))


def number_images(
    videos: Sequence[str],
    chosen: Sequence[ChosenImages],
    num_frames: Sequence[int],
    photos: Sequence[str] = (),
    *,
    masks: Sequence[Sequence[Mask | None]] = (),
) -> ImageSet:
    """Number the images of videos and photos through all sequences.

    Args:
        videos: the folder of each video's images in the folder of all images; '' for none.
        chosen: the images of each video, with names relative to its folder.
        num_frames: number of frames of each video.
        photos: names of the photos, relative to the folder of all images.
        masks: masks of the images of each video, then of the photos; empty: no masks.
    """
    first = np.concatenate([[0], np.cumsum([*num_frames, *(1 for _ in photos)])]).astype(np.int64)
    names = [
        f"{video}/{name}" if video else name
        for video, own in zip(videos, chosen, strict=True)
        for name in own.names
    ]
    frames = [own.frames + first[video] for video, own in enumerate(chosen)]
    counts = [*(len(own.names) for own in chosen), *(1 for _ in photos)]
    found = [mask for own in masks for mask in own]
    return ImageSet(
        tuple(videos),
        ChosenImages(
            [*names, *photos],
            np.concatenate([*frames, first[len(chosen) : -1]]).astype(np.int32),
        ),
        np.repeat(np.arange(len(counts), dtype=np.int32), counts),
        first,
        tuple(found or [None] * sum(counts)),
    )


@dataclass(frozen=True)
class ShownVideo(ShownImages):
    """A video and how its images show it; pictures of another size are resized.

    Attributes:
        video: the video.
        kept: store of decoded pictures; None: pictures are decoded each time.
    """

    video: Video
    kept: KeptPictures | None = None

    @staticmethod
    def as_played(video: Video, kept: KeptPictures | None = None) -> ShownVideo:
        """The video with its pictures as players show them."""
        size = video.picture_size
        return ShownVideo.in_images(ShownImages(video.display, size, size), video, kept)

    @staticmethod
    def in_images(shown: ShownImages, video: Video, kept: KeptPictures | None = None) -> ShownVideo:
        """The video with its pictures as images show them."""
        return ShownVideo(shown.display, shown.video_size, shown.size, video, kept)

    def pictures(
        self, num_frames: int, options: ReadOptions, *, wanted: Collection[int], use: str
    ) -> Iterator[tuple[int, Picture]]:
        """The pictures of some frames, see `decodable_frames`."""
        decoded = decodable_frames(
            self.video,
            num_frames,
            options,
            self.display,
            wanted=wanted,
            use=use,
            kept=self.kept,
        )
        for frame, picture in decoded:
            if picture.shape[1::-1] == self.size:
                yield frame, picture
            else:
                resized = cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA)
                yield frame, np.asarray(resized, np.uint8)


def pictures_of(
    image_set: ImageSet,
    videos: Sequence[ShownVideo],
    photos: Sequence[Path],
    options: ReadOptions,
) -> Pictures:
    """A function that yields the pictures of images.

    Args:
        image_set: the images, of some frames and some photos.
        videos: the videos.
        photos: the files of all photos.
        options: how videos are decoded.

    Returns:
        A function that decodes the videos of the requested images, each up to the last of these.
        The pictures after damage of a video are missing, with a warning.
    """

    def pictures(wanted: list[int]) -> Iterator[tuple[int, Picture]]:
        left = set(wanted)
        for number, shown in enumerate(videos):
            own = image_set.of_video(number)
            first = image_set.images_of(number).start
            image_of = {
                int(frame): first + index
                for index, frame in enumerate(own.frames)
                if first + index in left
            }
            if image_of:
                decoded = shown.pictures(
                    max(image_of) + 1, options, wanted=image_of, use="pictures are used"
                )
                for frame, picture in decoded:
                    yield image_of[frame], picture
        for number, photo in enumerate(photos, start=len(videos)):
            for index in image_set.images_of(number):
                if index in left:
                    yield index, read_image(photo)

    return pictures
