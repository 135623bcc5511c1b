"""From a video to the tracks of its images: chain, mask, choose, refine."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError, OptionError, VideoError
from colmap_av1.images.choosing import ChosenImages, choose_images
from colmap_av1.images.masks import VideoMasks
from colmap_av1.options import ImageOptions, ReadOptions, TrackingOptions
from colmap_av1.tracks.fast_frames import fast_frames
from colmap_av1.tracks.tracks import Tracks, least_length
from colmap_av1.tracks.video_tracks import (
    TrackedVideo,
    VideoSource,
    count_frames,
    decodable_frames,
    refine_in_images,
    times_of_frames,
    track_video,
)
from colmap_av1.util.arrays import Bools, Picture
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.display import Display, shown_size, turned_back

# Smallest number of observations of a track if only images are kept.
MIN_IMAGES = 2


@dataclass(frozen=True)
class VideoTracks:
    """Tracks and images of a video, as far as matching and the estimate of poses use them.

    Attributes:
        tracks: its tracks, in pixels of the images.
        chosen: the frames that are images.
        inter_share: see `TrackedVideo`.
        fast: bool [num_frames] where the camera moves fast, see `fast_frames`.
        read_out: see `TrackedVideo`.
        digest: digest of the stage that stores them; empty if they are not stored.
    """

    tracks: Tracks
    chosen: ChosenImages
    inter_share: NDArray[np.float32]
    fast: Bools
    read_out: float | None
    digest: str = ""

    def doubted_at(self, frames: Sequence[int]) -> VideoTracks:
        """A copy in which the motion of some frames is unreliable, as if they were intra-coded."""
        share = self.inter_share.copy()
        share[list(frames)] = 0.0
        return replace(self, inter_share=share)


@dataclass(frozen=True)
class TrackedImages:
    """The tracks of a video and the frames that are images.

    Attributes:
        video: the tracks without masked pixels, in pixels of the shown pictures.
        chosen: the images.
        fast: bool [num_frames] where the camera moves fast, see `fast_frames`.
    """

    video: TrackedVideo
    chosen: ChosenImages
    fast: Bools

    @property
    def tracks(self) -> Tracks:
        """The tracks of the video."""
        return self.video.tracks

    @property
    def for_matching(self) -> VideoTracks:
        """What matching and the estimate of poses use."""
        video = self.video
        return VideoTracks(video.tracks, self.chosen, video.inter_share, self.fast, video.read_out)

    def with_tracks(self, tracks: Tracks) -> TrackedImages:
        """The same with other tracks."""
        return replace(self, video=replace(self.video, tracks=tracks))


@dataclass(frozen=True)
class ImageChoice:
    """How the images of a video are chosen.

    Attributes:
        options: the options.
        existing: names of existing images.
        folder: folder of the images; None: no picture is decoded.
        display: how images show the pictures; None: as players do.
        of_model: the existing images are those of a model, see `choose_images`.
    """

    options: ImageOptions
    existing: Sequence[str] = ()
    folder: Path | None = None
    display: Display | None = None
    of_model: bool = False

    @property
    def needs_tracks(self) -> bool:
        """Whether images are chosen from the tracks, and not before the motion is chained."""
        return self.options.select == "parallax"


def track_chosen_images(
    source: VideoSource,
    options: TrackingOptions,
    choice: ImageChoice,
    *,
    masks: VideoMasks | None,
    one_size: bool = True,
    every_frame: bool,
    context: RunContext,
) -> TrackedImages:
    """Choose the images of a video, and chain its motion into tracks.

    Args:
        source: the video.
        options: how motion is read and chained, and tracks are refined.
        choice: how images are chosen.
        masks: masks of the video; None: all pixels are used.
        one_size: raise an error if frames differ in size, see `track_video`.
        every_frame: keep the observations in all frames. Otherwise, only those in the images are
            kept if neither refinement nor the choice needs others, which takes less memory.
        context: measures the stages of `track_video`, "choice" and "refinement".

    Raises:
        ImageError: see `track_images` and `choose_images`.
        OptionError: see `track_images` and `choose_images`.
        VideoError: see `track_images`.
        BitstreamError: see `track_images`.
    """
    track = functools.partial(
        track_images,
        source,
        options,
        masks=masks,
        display=choice.display,
        one_size=one_size,
        context=context,
    )

    def choose(num_frames: int, tracks: Tracks | None = None) -> ChosenImages:
        return choose_images(
            num_frames,
            choice.options,
            existing=choice.existing,
            folder=choice.folder,
            times=lambda: times_of_frames(source, num_frames, options.read),
            decode=lambda wanted: decode_pictures(
                source, num_frames, options.read, choice.display, wanted=wanted, context=context
            ),
            tracks=tracks,
            of_model=choice.of_model,
        )

    def choose_by_tracks(tracked: TrackedVideo) -> ChosenImages:
        needed = tracked.tracks if choice.needs_tracks else None
        return choose(tracked.tracks.num_frames, needed)

    if every_frame or choice.needs_tracks or options.refine.refine != "none":
        return track(choose_by_tracks)
    # The headers of a damaged stream may promise more frames than can be read. The images are then
    # chosen from the frames with tracks.
    num_frames = count_frames(source, options.read)
    try:
        with context.clock.measure("choice"), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            chosen = choose(num_frames)
    except (ImageError, OptionError):
        return track(choose_by_tracks)

    def choose_again(tracked: TrackedVideo) -> ChosenImages:
        if tracked.tracks.num_frames < num_frames:
            return choose_by_tracks(tracked)
        for warning in caught:
            warnings.warn(str(warning.message), stacklevel=2)
        return chosen

    frames = chosen.frames if len(chosen.frames) < num_frames else None
    found = track(choose_again, frames=frames)
    if frames is None or np.isin(found.chosen.frames, frames).all():
        return found
    # The new choice has frames whose observations were not kept.
    return track(lambda _: found.chosen, frames=found.chosen.frames)


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

    Masks of frames are applied first. All masks are applied again at the end, since refinement
    moves observations and images may have their own masks.

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
    min_length = least_length(options.tracks) if frames is None else MIN_IMAGES
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
            ends = masks.on_frames(ends, min_length=2)
        # If one end of a track is masked or hidden, its length is not known.
        video = replace(video, sampled_ends=ends.keep_long(2))
    if masks is not None:
        video = replace(
            video,
            tracks=masks.on_frames(video.tracks, min_length),
            inter_share=masks.on_motion(video.inter_share),
        )
    fast = fast_frames(video.ends)
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
    return TrackedImages(video, chosen, fast)


def decode_pictures(
    source: VideoSource,
    num_frames: int,
    options: ReadOptions,
    display: Display | None,
    *,
    wanted: Collection[int] | None,
    context: RunContext,
) -> Iterator[tuple[int, Picture]]:
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
