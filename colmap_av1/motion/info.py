"""The structure of a stream, and whether its motion is good for matching."""

from __future__ import annotations

import contextlib
import math
import os
import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from colmap_av1.errors import BitstreamError, VideoError
from colmap_av1.motion.frame_motion import FrameMotion
from colmap_av1.motion.reading import count_with_repeats, first_showings, read_motion
from colmap_av1.options import ReadOptions
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.video.container import open_stream
from colmap_av1.video.display import Display
from colmap_av1.video.facts import Video, read_video

_KEY_FRAME, _INTRA_ONLY_FRAME = 0, 2

# A stream below these values gives few or poor tracks. Typical values are 85 % inter units for
# ordinary motion and about 50 % at 28 px per frame, 0.8 bits per pixel at crf 20 and 0.3 at crf 35.
_MIN_INTER_SHARE = 0.35
_MIN_BITS_PER_PIXEL = 0.03
_MIN_KEY_FRAME_DISTANCE = 12
# The picture hardly moves if it moves by less than this in nearly all frames. Half of the frames
# repeat the one before if a higher frame rate was made from a lower one.
_MIN_MOTION, _NEARLY_ALL = 0.1, 0.9
# Tracks break where the picture moves faster than this share of its longer side per frame, as at a
# fast turn. Walks with such turns have more than this share of such frames, other clips none.
_FAST_MOTION, _MAX_FAST_SHARE = 0.08, 0.05


@dataclass(frozen=True)
class StreamReport:
    """Facts about an AV1 stream.

    Attributes:
        path: the file.
        container: FFmpeg's name of the container.
        width: picture width in pixels as stored.
        height: picture height in pixels.
        display: how players show the pictures.
        frame_rate: frames per second; None if unknown.
        num_coded: number of frames with block data.
        num_shown: number of frames that the bitstream shows.
        num_cut: number of these frames that an edit list hides.
        num_hidden: number of coded frames that are never shown.
        num_intra_frames: number of key frames and intra-only frames.
        inter_share: share of inter units in all frames after the first.
        reference_distances: share of references by signed display distance, counted in
            units; negative distances are in the past.
        hidden_reference_share: share of references to frames that are never shown.
        median_motion: median length of the units' displacements in pixels per shown frame; NaN
            if no unit refers to a shown frame.
        fast_share: share of the frames in which the picture moves by more than 8 % of its longer
            side per shown frame.
        bytes_per_frame: size of the stream per shown frame.
        bits_per_pixel: the same in bits per pixel.
        reasons: why the stream is poor for matching; empty if it is good.
    """

    path: Path
    container: str
    width: int
    height: int
    display: Display
    frame_rate: float | None
    num_coded: int
    num_shown: int
    num_cut: int
    num_hidden: int
    num_intra_frames: int
    inter_share: float
    reference_distances: dict[int, float]
    hidden_reference_share: float
    median_motion: float
    fast_share: float
    bytes_per_frame: float
    bits_per_pixel: float
    reasons: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether the stream is good for matching."""
        return not self.reasons


def read_info(
    video: str | os.PathLike[str],
    *,
    options: ReadOptions = ReadOptions(),
    progress: Progress = no_progress,
) -> StreamReport:
    """Read a whole stream and judge how good its motion is for matching.

    Args:
        video: the video file.
        options: how the bitstream is read.
        progress: called with the stage "motion" and the number of coded frames so far.

    Raises:
        VideoError: the video cannot be read or shows no frame.
        BitstreamError: the stream is damaged and `options.strict` is set.

    Examples:
        >>> from colmap_av1 import read_info
        >>> report = read_info("video.mp4")
        >>> report.num_shown, report.num_intra_frames, report.good
        (60, 1, True)
    """
    counts = _count(read_motion(video, options), progress)
    structure = counts.structure
    if structure.num_shown == 0:
        raise VideoError(f"{video}: shows no frames: give another video")
    # Frames that are shown again are not coded frames, and a stream may end with them.
    structure.num_shown = count_with_repeats(first_showings(video, options), structure.num_shown)
    # The bitstream is read first because only its parser limits the frame size.
    opened = read_video(video)
    if opened.doubtful_times is not None:
        warnings.warn(f"{video}: {opened.doubtful_times}", stacklevel=2)
    num_presented = structure.num_shown
    if opened.presented is not None:
        num_presented = int((opened.presented < structure.num_shown).sum())
    width, height = opened.stored_size
    bytes_per_frame = _num_bytes(opened) / structure.num_shown
    bits_per_pixel = 8 * bytes_per_frame / max(1, width * height)
    references = sum(counts.references.values()) + counts.hidden_references
    median_motion = float(np.median(counts.motion)) if counts.motion else math.nan
    fast = _FAST_MOTION * max(width, height)
    fast_share = float(np.mean(np.array(counts.motion) > fast)) if counts.motion else 0.0
    reasons = list(structure.reasons(bits_per_pixel))
    if counts.motion and np.quantile(counts.motion, _NEARLY_ALL) < _MIN_MOTION:
        reasons.append(
            f"the picture moves by {median_motion:.2f} px per frame: the camera hardly moves, "
            "there is no parallax"
        )
    if fast_share > _MAX_FAST_SHARE:
        reasons.append(
            f"the picture moves by more than {fast:.0f} px per frame in {fast_share:.0%} of the "
            "frames: tracks break there; turn more slowly, or film more frames per second"
        )
    if len(counts.first_of_size) > 1:
        sizes = ", ".join(f"{w}x{h}" for w, h in counts.first_of_size)
        where = sorted(counts.first_of_size.values())[1]
        reasons.append(
            f"the picture size changes at frame {where} ({sizes}): encode it at one size"
        )
    return StreamReport(
        path=opened.path,
        container=opened.container,
        width=width,
        height=height,
        display=opened.display,
        frame_rate=opened.frame_rate,
        num_coded=structure.num_coded,
        num_shown=structure.num_shown,
        num_cut=structure.num_shown - num_presented,
        num_hidden=counts.num_hidden,
        num_intra_frames=structure.num_intra_frames,
        inter_share=structure.inter_share,
        reference_distances={
            distance: units / references for distance, units in sorted(counts.references.items())
        },
        hidden_reference_share=counts.hidden_references / references if references else 0.0,
        median_motion=median_motion,
        fast_share=fast_share,
        bytes_per_frame=bytes_per_frame,
        bits_per_pixel=bits_per_pixel,
        reasons=tuple(reasons),
    )


@dataclass
class Structure:
    """Counts that describe how a stream is coded, as far as it matters for matching.

    Attributes:
        num_coded: number of frames with block data.
        num_shown: number of frames that the bitstream shows.
        num_intra_frames: number of key frames and intra-only frames.
        later_units: number of units in all frames after the first.
        inter_units: number of these units that refer to another frame.
        inter_share_of: share of inter units in each shown frame, by its display index.
    """

    num_coded: int = 0
    num_shown: int = 0
    num_intra_frames: int = 0
    later_units: int = 0
    inter_units: int = 0
    inter_share_of: dict[int, float] = field(default_factory=dict)

    @property
    def inter_share(self) -> float:
        """Share of inter units in all frames after the first."""
        return self.inter_units / self.later_units if self.later_units else 0.0

    def add(self, frame: FrameMotion) -> None:
        """Count a frame. Frames are given in bitstream order."""
        self.num_coded += 1
        self.num_shown = max(self.num_shown, frame.display_index + 1)
        self.num_intra_frames += frame.header["frame_type"] in (_KEY_FRAME, _INTRA_ONLY_FRAME)
        inter = (frame.is_inter != 0) & (frame.use_intrabc == 0)
        inter_units = int(np.count_nonzero(inter))
        if frame.display_index >= 0:
            self.inter_share_of[frame.display_index] = inter_units / frame.is_inter.size
        if self.num_coded > 1:
            self.later_units += frame.is_inter.size
            self.inter_units += inter_units

    def reasons(self, bits_per_pixel: float) -> tuple[str, ...]:
        """Why a stream with this structure and rate is poor for matching; empty if it is good."""
        if self.num_shown < 3:
            frames = "1 frame is" if self.num_shown == 1 else f"{self.num_shown} frames are"
            return (f"only {frames} shown: a track needs more",)
        if self.inter_units == 0:
            return ("every frame is intra coded, so there is no motion: encode it with -g 9999",)
        reasons = []
        if self.inter_share < _MIN_INTER_SHARE:
            reasons.append(
                f"only {self.inter_share:.0%} of the units after the first frame are inter coded: "
                "the camera moves too far between frames, or the scene is dynamic"
            )
        if self.num_shown < _MIN_KEY_FRAME_DISTANCE * (self.num_intra_frames - 1):
            reasons.append(
                f"a key frame every {self.num_shown / self.num_intra_frames:.1f} frames cuts "
                "every track: encode it with -g 9999"
            )
        if bits_per_pixel < _MIN_BITS_PER_PIXEL:
            reasons.append(
                f"{bits_per_pixel:.3f} bits per pixel is a low rate with coarse motion vectors: "
                "encode the source with a lower -crf"
            )
        return tuple(reasons)


@dataclass
class _Counts:
    structure: Structure = field(default_factory=Structure)
    num_hidden: int = 0
    references: Counter[int] = field(default_factory=Counter)
    hidden_references: int = 0
    # The median length of the displacements of each shown frame, in pixels per shown frame.
    motion: list[float] = field(default_factory=list)
    # The display index of the first shown frame of each size (width, height).
    first_of_size: dict[tuple[int, int], int] = field(default_factory=dict)


def _count(motion: Iterable[FrameMotion], progress: Progress) -> _Counts:
    counts = _Counts()
    for frame in motion:
        counts.structure.add(frame)
        if frame.display_index < 0:
            counts.num_hidden += 1
        else:
            counts.first_of_size.setdefault((frame.width, frame.height), frame.display_index)
        _count_references(frame, counts)
        progress("motion", counts.structure.num_coded, None)
    return counts


def _count_references(frame: FrameMotion, counts: _Counts) -> None:
    if frame.display_index < 0:
        return
    inter = frame.use_intrabc == 0
    speeds = []
    for list_index in (0, 1):
        reference = frame.ref_frame[..., list_index]
        used = (reference > 0) & inter
        if not used.any():
            continue
        units = np.bincount(reference[used], minlength=8)
        for name in np.flatnonzero(units):
            shown = int(frame.ref_display_index[name])
            if shown < 0:
                counts.hidden_references += int(units[name])
            else:
                counts.references[shown - frame.display_index] += int(units[name])
        displacement = frame.displacement(list_index)[used]
        distance = np.abs(frame.ref_display_index[reference[used]] - frame.display_index)
        length = np.hypot(displacement[:, 0], displacement[:, 1])
        valid = (frame.ref_display_index[reference[used]] >= 0) & (distance > 0)
        valid &= np.isfinite(length)
        speeds.append(length[valid] / distance[valid])
    if speeds and len(speed := np.concatenate(speeds)):
        counts.motion.append(float(np.median(speed)))


def _num_bytes(video: Video) -> int:
    """Size of the stream in bytes, up to the first damage if there is one."""
    total = 0
    with open_stream(video) as stream, contextlib.suppress(BitstreamError):
        for packet in stream.packets():
            total += len(packet.data)
    return total
