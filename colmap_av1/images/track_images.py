"""From a video to the tracks of its images: chain, mask, choose, refine."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.images.choosing import ChosenImages, choose_images
from colmap_av1.images.masks import VideoMasks
from colmap_av1.options import ImageOptions, ReadOptions, TrackingOptions
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.tracks.video_tracks import (
    TrackedVideo,
    VideoSource,
    decodable_frames,
    refine_in_images,
    times_of_frames,
    track_video,
)
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.display import Display, shown_size, turned_back

_Image = NDArray[np.uint8]

# Smallest number of observations of a track if only images are kept.
_MIN_IMAGES = 2


@dataclass(frozen=True)
class TrackedImages:
    """The tracks of a video and the frames that are images.

    Attributes:
        video: the tracks without masked pixels, in pixels of the shown pictures.
        chosen: the images.
    """

    video: TrackedVideo
    chosen: ChosenImages

    @property
    def tracks(self) -> Tracks:
        """The tracks of the video."""
        return self.video.tracks

    def with_tracks(self, tracks: Tracks) -> TrackedImages:
        """The same with other tracks."""
        return replace(self, video=replace(self.video, tracks=tracks))


def track_images(
    source: VideoSource,
    options: TrackingOptions,
    choose: Callable[[TrackedVideo], ChosenImages],
    *,
    masks: VideoMasks | None,
    display: Display | None = None,
    one_size: bool = True,
    frames: NDArray[np.int32] | None = None,
    refine: bool = True,
    context: RunContext,
) -> TrackedImages:
    """Chain the motion of a video into tracks, mask them, choose images and refine tracks there.

    Masks of frames are applied before images are chosen. All masks are applied again at the end,
    since refinement moves observations and images may have their own masks.

    Args:
        source: the video.
        options: how motion is read and chained, and tracks are refined.
        choose: chooses the images from the masked tracks.
        masks: masks of the video; None: all pixels are used.
        display: how images show the pictures; None: as players do.
        one_size: raise an error if frames differ in size, see `track_video`.
        frames: int32 [n] candidate frames for images; observations are kept in the images only.
            None: observations are kept in all frames.
        refine: correct tracks of downscaled motion that are not refined yet, see
            `refine_in_images`.
        context: measures the stages of `track_video`, "choice" and "refinement".

    Raises:
        VideoError: the video shows no frame, or its frames differ in size from its container.
        BitstreamError: the stream is damaged before its second frame, or anywhere if
            `options.read.strict` is set.
        ImageError: shown frames differ in size but must not, no images can be chosen, or an image
            has no mask.
        OptionError: an option does not fit the video or its images.
    """
    min_length = least_length(options.tracks) if frames is None else _MIN_IMAGES
    video = track_video(
        source,
        options,
        one_size=one_size,
        frames=frames,
        context=context,
    )
    video = replace(video, tracks=_as_displayed(video.tracks, source, display))
    if video.sampled_ends is not None:
        ends = _as_displayed(video.sampled_ends, source, display)
        if masks is not None:
            ends = masks.on_frames(ends, min_length=1)
        video = replace(video, sampled_ends=ends)
    if masks is not None:
        video = replace(
            video,
            tracks=masks.on_frames(video.tracks, min_length),
            inter_share=masks.on_motion(video.inter_share),
        )
    with context.clock.measure("choice"):
        chosen = choose(video)
        if frames is not None:
            tracks = video.tracks.keep_frames(chosen.frames).keep_long(min_length)
            video = replace(video, tracks=tracks)
    if refine and options.refine.refine == "none":
        video = refine_in_images(
            video,
            source,
            chosen.frames,
            options.read,
            display=display,
            context=context,
        )
    if masks is not None:
        video = replace(video, tracks=masks.on_tracks(video.tracks, chosen, min_length))
    return TrackedImages(video, chosen)


def choose_from_video(
    source: VideoSource,
    tracks: Tracks,
    options: ImageOptions,
    read: ReadOptions,
    *,
    existing: Sequence[str] = (),
    folder: Path | None,
    display: Display | None = None,
    context: RunContext,
) -> ChosenImages:
    """Choose the images of a video, see `choose_images`.

    Args:
        source: the video.
        tracks: tracks through all its frames.
        options: how images are chosen.
        read: how pictures are decoded.
        existing: names of existing images.
        folder: folder of the images; None: no picture is decoded.
        display: how images show the pictures; None: as players do.
        context: its progress is called in the stage "recognising".
    """
    return choose_images(
        tracks,
        options,
        existing=existing,
        folder=folder,
        times=lambda: times_of_frames(source, tracks.num_frames),
        decode=lambda wanted: decode_pictures(
            source,
            tracks.num_frames,
            read,
            display,
            wanted=wanted,
            context=context,
        ),
    )


def decode_pictures(
    source: VideoSource,
    num_frames: int,
    options: ReadOptions,
    display: Display | None,
    *,
    wanted: Collection[int] | None,
    context: RunContext,
) -> Iterator[tuple[int, _Image]]:
    """Decode frames that have tracks, with progress in the stage "recognising".

    Args:
        source: the video.
        num_frames: number of frames that have tracks.
        options: how the video is decoded.
        display: how pictures are cropped and rotated; None: as players do.
        wanted: indices of the frames to yield; None: all.
        context: its progress is called.
    """
    pictures = decodable_frames(
        source.pictures,
        num_frames if wanted is None else min(num_frames, max(wanted) + 1),
        options,
        display,
        wanted=wanted,
        use="pictures are used",
    )
    for index, picture in pictures:
        context.progress("recognising", index + 1, num_frames)
        yield index, picture


def _as_displayed(tracks: Tracks, source: VideoSource, display: Display | None) -> Tracks:
    """The tracks in pixels of the pictures as images show them.

    Raises:
        VideoError: the frames differ in size from the container.
    """
    pictures, size = source.pictures, source.pictures.picture_size
    if display is not None and display.turn != pictures.display.turn:
        back = turned_back(pictures.display)
        tracks, size = tracks.as_displayed(back), shown_size(size, back)
    if (tracks.width, tracks.height) != size:
        raise VideoError(
            f"{source.stream}: its pictures are {tracks.width}x{tracks.height}, those of "
            f"{pictures} {size[0]}x{size[1]}: convert it with another --encoder"
        )
    return tracks
