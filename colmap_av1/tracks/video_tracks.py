"""From a video to its tracks: open or make its AV1 stream, chain its motion, refine the tracks."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import BitstreamError, ImageError, VideoError, WriteError, cannot_write
from colmap_av1.motion.frame_motion import FrameMotion
from colmap_av1.motion.info import Structure, read_info
from colmap_av1.motion.reading import count_with_repeats, first_showings, frame_times, read_motion
from colmap_av1.options import (
    EncodeOptions,
    MatchOptions,
    ReadOptions,
    SourceOptions,
    TrackingOptions,
)
from colmap_av1.tracks.overlays import remove_overlays
from colmap_av1.tracks.refine import refine_spread_tracks, refine_tracks
from colmap_av1.tracks.tracks import Tracks, build_tracks_and_ends
from colmap_av1.util.arrays import Floats, Picture
from colmap_av1.util.files import remove_leftovers, scratch_folder
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.coded_size import coded_size, with_downscale
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import Display
from colmap_av1.video.encode import EncodeReport, encode_for_motion, stream_of
from colmap_av1.video.facts import Video, read_video
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import FileState

# What pictures are decoded for, in warnings.
_REFINED = "tracks are refined"
# Overlay tracks are reported if they are at least this share of all tracks.
_NOTABLE_SHARE = 0.01
# Approximate number of tracks in each frame whose ends are sampled if observations are kept in some
# frames only, and the number of pixels of a 4x4 unit of motion, which is assumed to have one track.
_ENDS_PER_FRAME = 2000
_PIXELS_PER_TRACK = 16


@dataclass(frozen=True)
class VideoSource:
    """Where the motion and the pictures of a video come from.

    Attributes:
        stream: the AV1 video whose motion is read. A converted stream also has the frames that an
            edit list of the original video hides, and may be smaller.
        pictures: the video whose pictures become images: the same video, or the original video of
            a converted stream.
        is_kept: whether the stream is kept after the run.
        conversion: description of the conversion; None if there was none.
        is_reused: whether another run converted the video, and kept the stream.
        kept: store of decoded pictures; None: pictures are decoded each time.
    """

    stream: Video
    pictures: Video
    is_kept: bool = True
    conversion: str | None = None
    is_reused: bool = False
    kept: KeptPictures | None = None

    @property
    def is_downscaled(self) -> bool:
        """Whether the stream's pictures are smaller than those that become images."""
        return self.stream.picture_size != self.pictures.picture_size

    @property
    def files(self) -> tuple[FileState, ...]:
        """The states of its files at the start, each file once."""
        return tuple(dict.fromkeys([self.stream.state, self.pictures.state]))


@dataclass(frozen=True)
class TrackedVideo:
    """The tracks of a video, and facts found while building them.

    Attributes:
        tracks: tracks through the shown frames, observed in all of them or in some only.
        num_coded_frames: number of frames with block data, including hidden ones.
        inter_share: float32 [num_frames] share of inter units in each frame that players show; the
            smallest share among the frame and the hidden frames before it.
        warnings: messages for the user, for example about damage of the stream.
        read_out: time in milliseconds in which the shutter reads the rows of a picture, if the
            tracks are corrected for it; None if they are not.
        sampled_ends: if `tracks` are observed in some frames only, the first and the last
            observation in any frame of a sample of all tracks.
    """

    tracks: Tracks
    num_coded_frames: int
    inter_share: NDArray[np.float32]
    warnings: tuple[str, ...]
    read_out: float | None = None
    sampled_ends: Tracks | None = None

    @property
    def ends(self) -> Tracks:
        """The tracks, or a sample of them, with their first and last observations in any frame."""
        return self.tracks if self.sampled_ends is None else self.sampled_ends


@contextmanager
def open_source(
    video: Video, options: SourceOptions, *, next_to: Path, context: RunContext
) -> Iterator[VideoSource]:
    """Open the AV1 stream of a video, from which motion is read; convert the video if necessary.

    A converted stream exists while the body runs, unless the options name a file to keep it.

    Args:
        video: a video of any codec.
        options: whether and how the video is converted.
        next_to: the output file or folder, in whose parent folder a temporary stream is written.
        context: measures the stage "encoding" if the video is converted.

    Raises:
        VideoError: the video cannot be converted.
        EncodeError: no AV1 encoder works.
        WriteError: the stream cannot be written.
        OptionError: `keep_stream` names an existing file that is not a kept stream.
    """
    # A killed run may have left its stream here, even if this video needs no conversion.
    remove_leftovers(next_to.resolve().parent, next_to.resolve().name)
    if video.codec == "av1" and not (
        options.reencode and read_info(video, options=options.read).reasons
    ):
        yield VideoSource(video, video)
        return
    strict = options.read.strict
    how = with_downscale(options.encode, video.picture_size)
    if options.keep_stream is not None:
        with context.clock.measure("encoding"):
            made = stream_of(
                video,
                options.keep_stream,
                strict=strict,
                options=how,
                progress=context.progress,
            )
        yield _made_source(video, made, how, is_kept=True)
        return
    with _scratch(next_to) as folder:
        with context.clock.measure("encoding"):
            made = encode_for_motion(
                video,
                folder / "stream.mp4",
                strict=strict,
                options=how,
                progress=context.progress,
            )
        yield _made_source(video, made, how, is_kept=False)


def _made_source(
    video: Video, made: EncodeReport, options: EncodeOptions, *, is_kept: bool
) -> VideoSource:
    """The source of a converted video.

    Raises:
        VideoError: the pictures of the stream do not have the expected size.
    """
    stream = read_video(made.output)
    size, wanted = (
        "{}x{}".format(*pixels)
        for pixels in (stream.picture_size, coded_size(video.picture_size, options))
    )
    if size != wanted:
        raise VideoError(
            f"{stream}: its pictures are {size} instead of {wanted}: convert {video} with another "
            "--encoder"
        )
    shown = "{}x{}".format(*video.picture_size)
    conversion = f"{video.codec} at {shown} to AV1 at {size} by {made.encoder}"
    if video.is_interlaced:
        conversion += ", deinterlaced"
    return VideoSource(stream, video, is_kept, conversion, made.reused)


def with_stream_kept(options: MatchOptions, folder: Path, name: str = "") -> MatchOptions:
    """The same options with `keep_stream` set to a file in a folder, unless it is set already.

    Args:
        options: any options.
        folder: the folder.
        name: name of the video, if there are several.
    """
    if options.keep_stream is not None:
        return options
    file = f"stream_{name}.mp4" if name else "stream.mp4"
    return replace(options, keep_stream=str(folder.absolute() / file))


@contextmanager
def _scratch(next_to: Path) -> Iterator[Path]:
    """A temporary folder for a stream that is not kept."""
    with ExitStack() as made:
        try:
            folder = made.enter_context(scratch_folder(next_to))
        except OSError as error:
            where = next_to.absolute().parent
            raise WriteError(f"{cannot_write(where, error)}; or give --keep_stream") from error
        yield folder


def track_video(
    source: VideoSource,
    options: TrackingOptions,
    *,
    one_size: bool,
    frames: NDArray[np.int32] | None = None,
    context: RunContext,
) -> TrackedVideo:
    """Chain the motion of a video into tracks as it is read, and refine them.

    Args:
        source: the video.
        options: how motion is read and chained, and tracks are refined.
        one_size: raise an error if shown frames differ in size, as refinement does.
        frames: int32 [n] frames, as numbered by players, whose observations are kept; None: all.
        context: measures the stages "motion" and "tracks", and with refinement "decoding" and
            "refinement".

    Raises:
        VideoError: the video shows no frame.
        BitstreamError: the stream is damaged before its second frame, or anywhere if
            `options.read.strict` is set.
        ImageError: shown frames differ in size but must not.
    """
    clock, progress = context.clock, context.progress
    motion: Iterable[FrameMotion] = read_motion(source.stream, options.read)
    if one_size or options.refine.refine != "none":
        motion = _of_one_size(motion)
    structure = Structure()
    motion = _counted(clock.iterate("motion", motion), structure)

    def count(stage: str, done: int, total: int | None) -> None:
        progress("motion", done, source.stream.likely_num_packets)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        with clock.measure("tracks"):
            presented = source.pictures.presented
            stored = frames if frames is None or presented is None else presented[frames]
            first = first_showings(source.stream, options.read)
            coded = None
            if stored is not None:
                coded = np.unique(first[stored[stored < len(first)]])
            width, height = source.stream.picture_size
            one_in = max(1, width * height // (_PIXELS_PER_TRACK * _ENDS_PER_FRAME))
            tracks, ends = build_tracks_and_ends(
                motion,
                options.tracks,
                count,
                frames=coded,
                tracks_per_sample=0 if coded is None else one_in,
            )
            first = first[: count_with_repeats(first, tracks.num_frames)]
            structure.num_shown = len(first)
            tracks, ends = tracks.with_repeats(first, stored), ends.with_repeats(first)
            if stored is not None:  # the first showing of a frame may not be among the frames
                tracks = tracks.keep_frames(stored[stored < tracks.num_frames])
            num_frames, num_tracks = tracks.num_frames, tracks.num_tracks
            tracks, ends = remove_overlays(tracks, ends), remove_overlays(ends)
            overlay_share = (num_tracks - tracks.num_tracks) / max(num_tracks, 1)
            num_pixels = num_frames * width * height
            tracks, ends = _as_shown(tracks, source), _as_shown(ends, source)
        if options.refine.refine != "none":
            with clock.measure("refinement"):
                pictures = clock.iterate(
                    "decoding",
                    decodable_frames(
                        source.pictures, tracks.num_frames, options.read, use=_REFINED
                    ),
                )
                tracks = refine_tracks(
                    tracks,
                    pictures,
                    options.refine,
                    lambda done: progress("refinement", done, tracks.num_frames),
                )
    notes = [str(w.message) for w in caught]
    # The size of the whole file is an upper bound of the rate, so a low rate is truly low.
    bits_per_pixel = 8 * source.stream.path.stat().st_size / num_pixels
    notes += _notes(source, overlay_share, structure.reasons(bits_per_pixel))
    inter_share = _inter_share(structure, first, presented)
    return TrackedVideo(
        tracks,
        structure.num_coded,
        inter_share,
        tuple(notes),
        sampled_ends=None if frames is None else ends,
    )


def _as_shown(tracks: Tracks, source: VideoSource) -> Tracks:
    """Convert tracks in the stream's pictures to tracks in pixels of the shown pictures."""
    shown = tracks.as_displayed(source.stream.display, source.pictures.presented)
    if source.stream is source.pictures:
        return shown
    return shown.scale_to(source.pictures.picture_size)


def _notes(source: VideoSource, overlay_share: float, reasons: Sequence[str]) -> list[str]:
    """Messages for the user about a video and its tracks."""
    notes = []
    if overlay_share >= _NOTABLE_SHARE:
        notes.append(
            f"removed {overlay_share:.0%} of the tracks, which stand still while the picture "
            "moves: overlays such as logos and dashboards, or plain areas of a noisy video"
        )
    if reasons and source.stream is source.pictures:
        notes.append(f"{'; '.join(reasons)}; or use --reencode 1 to convert the video first")
    dynamic_range = source.pictures.dynamic_range
    if dynamic_range is not None:
        notes.append(
            f"the video has high dynamic range ({dynamic_range}): images keep its values, which "
            "look pale; give a video of standard range for the colours that players show"
        )
    return notes


def _inter_share(
    structure: Structure, first: NDArray[np.int32], presented: NDArray[np.int32] | None
) -> NDArray[np.float32]:
    """Share of inter units in each frame that players show, see `TrackedVideo`.

    A picture that is shown again has the share of its first showing, or 1 if that has no motion.
    """
    num_frames = len(first)
    share = np.array([structure.inter_share_of.get(i, 0.0) for i in first.tolist()], np.float32)
    share[(share == 0) & (first != np.arange(num_frames))] = 1
    if presented is None:
        return share
    presented = presented[presented < num_frames]
    if len(presented) == 0:
        return share[:0]
    # Each range begins after the previous shown frame and ends with the shown frame.
    starts = np.concatenate([presented[:1], presented[:-1] + 1])
    ends = presented + 1
    return np.array([share[a:b].min() for a, b in zip(starts, ends, strict=True)], np.float32)


def count_frames(source: VideoSource, options: ReadOptions) -> int:
    """Number of frames of a video that players show, according to the headers of its stream.

    The container gives too large a number if the file is cut short.
    """
    num_shown = len(first_showings(source.stream, options))
    presented = source.pictures.presented
    return num_shown if presented is None else int((presented < num_shown).sum())


def times_of_frames(source: VideoSource, num_frames: int, options: ReadOptions) -> Floats | None:
    """Times in seconds of the frames that players show: float64 [num_frames]; None if unknown."""
    times = frame_times(source.stream, options)
    presented = source.pictures.presented
    if times is not None and presented is not None:
        times = times[presented[presented < len(times)]]
    return None if times is None or len(times) < num_frames else times[:num_frames]


def refine_in_images(
    tracked: TrackedVideo,
    source: VideoSource,
    frames: NDArray[np.int32],
    options: ReadOptions,
    *,
    display: Display | None = None,
    context: RunContext,
) -> TrackedVideo:
    """Correct the tracks that poses are estimated from if motion was coded in smaller pictures.

    Poses are then as accurate as with motion at full size. If the stream has full size, the tracks
    are not changed.

    Args:
        tracked: tracks of the video.
        source: the video.
        frames: int32 [n] frames that become images, ascending.
        options: how the video is decoded.
        display: how images show the pictures; None: as players do.
        context: measures the stage "refinement".

    Raises:
        BitstreamError: the video is damaged and `options.strict` is set.
    """
    if not source.is_downscaled:
        return tracked
    with context.clock.measure("refinement"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        wanted = frozenset(frames.tolist())
        num_frames = int(frames[-1]) + 1
        pictures = decodable_frames(
            source.pictures,
            num_frames,
            options,
            display,
            use=_REFINED,
            wanted=wanted,
            kept=source.kept,
        )
        tracks = refine_spread_tracks(
            tracked.tracks,
            frames,
            pictures,
            lambda done: context.progress("refinement", done, len(frames)),
        )
    notes = (*tracked.warnings, *(str(w.message) for w in caught))
    return replace(tracked, tracks=tracks, warnings=notes)


def decodable_frames(
    video: Video,
    num_frames: int,
    options: ReadOptions,
    display: Display | None = None,
    *,
    use: str,
    wanted: Collection[int] | None = None,
    kept: KeptPictures | None = None,
) -> Iterator[tuple[int, Picture]]:
    """Decode the pictures of the frames that have tracks, and stop with a warning at damage.

    Args:
        video: the video.
        num_frames: number of frames that have tracks.
        options: how the video is decoded.
        display: how pictures are cropped and rotated; None: as players do.
        use: what the pictures are used for; the warning contains it.
        wanted: indices of the frames to yield; None: all.
        kept: store of decoded pictures; what it holds is not decoded again.

    Raises:
        BitstreamError: the video is damaged and `options.strict` is set.
    """
    decoded = decode_frames(
        video,
        operating_point=options.operating_point,
        num_threads=options.num_threads,
        display=display,
        wanted=wanted,
        kept=kept,
    )
    count = 0
    try:
        for index, image in decoded:
            if index < num_frames:
                yield index, image
                count += 1
            if index + 1 >= num_frames:  # damage of later frames does not matter
                return
    except BitstreamError as error:
        if options.strict:
            raise
        warnings.warn(f"{error}; {use} in {count} frames only", stacklevel=2)
    finally:
        decoded.close()


def _counted(motion: Iterable[FrameMotion], structure: Structure) -> Iterator[FrameMotion]:
    """Yield the same frames and count them."""
    for frame in motion:
        structure.add(frame)
        yield frame


def _of_one_size(motion: Iterable[FrameMotion]) -> Iterator[FrameMotion]:
    """Yield the same frames; shown frames must have one size to share a camera."""
    size: tuple[int, int] | None = None
    for frame in motion:
        if frame.display_index >= 0:
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                raise ImageError(
                    f"the video changes its size from {size[0]}x{size[1]} to "
                    f"{frame.width}x{frame.height}, so its frames cannot be images of one camera: "
                    "leave out the image folder and --refine, or re-encode the video at one size"
                )
        yield frame
