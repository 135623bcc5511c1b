"""Draw motion and tracks over the frames of a video."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.motion.reading import count_with_repeats, first_showings, read_motion
from colmap_av1.options import ReadOptions, TrackOptions, ViewOptions
from colmap_av1.tracks.tracks import Tracks, build_tracks
from colmap_av1.util.arrays import Bools, Ints, Picture
from colmap_av1.util.files import check_new_file
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.video.container import open_stream
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.facts import read_video
from colmap_av1.video.unchanged import unchanged
from colmap_av1.view.pictures import bgr, existing_pictures, open_pictures, side_by_side

# Side in pixels of the units in which motion is drawn.
_UNIT = 4
_GREY = 128
# Quantile of the speeds that is drawn in full colour. With the maximum, a few fast tracks would
# make the rest pale.
_FULL_COLOUR_QUANTILE = 0.95
_DEFAULT_FRAME_RATE = 25.0
# Number of fractional bits of drawing coordinates in OpenCV.
SHIFT = 4
# Width of the colour wheel in pixels.
_WHEEL_SIZE = 48
# Motion below this speed, in pixels per frame, is never drawn in full colour.
_LEAST_FULL_SPEED = 0.25
# One track is drawn for each cell and this many frames.
_FRAMES_PER_CHOICE = 8
# Number of observations after which a track has the colour of an old one.
_OLD_AGE = 32


def view_video(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: ViewOptions = ViewOptions(),
    tracks: TrackOptions = TrackOptions(),
    read: ReadOptions = ReadOptions(),
    progress: Progress = no_progress,
    overwrite: bool = False,
) -> int:
    """Draw motion and tracks over the frames of a video.

    Motion: each 4x4 unit with a track is coloured by the direction of its motion, more saturated
    if it is faster; the wheel in the corner is the key. Units without a track are grey, because
    their motion is not trusted. Tracks: each is a dot with a tail along its previous positions,
    blue for a young track, red for an old one.

    Args:
        video: an AV1 video.
        output: an .mp4 file, or a folder for one PNG per frame.
        options: what is drawn.
        tracks: how the motion is chained.
        read: how the bitstream is read.
        progress: called with the stage's name, the number of items done, and their total if known.
        overwrite: replace existing files.

    Returns:
        The number of frames drawn.

    Raises:
        OptionError: the output exists and `overwrite` is not set.
        WriteError: it cannot be written.
        VideoError: the file cannot be read as a video, is not AV1, or changes meanwhile.
        BitstreamError: the stream is damaged, and `strict` is set or fewer than two frames precede
            the damage.
    """
    path, operating_point = Path(output), read.operating_point
    count = 0
    with open_stream(video) as stream:
        file = stream.file
    with unchanged(file.state) as check_video:
        if path.suffix and path.suffix.lower() != ".mp4" and not path.is_dir():
            raise OptionError(
                f"{path}: give an output that ends in .mp4, or a folder for PNG files"
            )
        for existing in existing_pictures(path):
            check_new_file(existing, [video], overwrite=overwrite)
        total = file.likely_num_packets
        chained = build_tracks(
            read_motion(video, read), tracks, lambda stage, done, _: progress(stage, done, total)
        )
        first = first_showings(video, read)
        chained = chained.with_repeats(first[: count_with_repeats(first, chained.num_frames)])
        # The motion was read first: its reader limits the frame size, and the decoder does not.
        opened = read_video(video, operating_point)
        chained = chained.as_displayed(opened.display, opened.presented)
        drawing = _prepare(chained, options)
        panels = [draw for name, draw in _PANELS.items() if options.draw in ("both", name)]
        check_video()
        with open_pictures(path, opened.frame_rate or _DEFAULT_FRAME_RATE) as write:
            for index, picture in decode_frames(opened, operating_point=operating_point):
                if index >= chained.num_frames:
                    break
                write(side_by_side([draw(picture, drawing, index) for draw in panels]))
                count += 1
                progress("pictures", count, chained.num_frames)
            check_video()
    return count


@dataclass(frozen=True)
class _Drawing:
    """Tracks, prepared for drawing.

    Attributes:
        tracks: all tracks.
        options: what is drawn.
        by_frame: the observations in each frame.
        age: int64 [num_observations] number of earlier observations of the same track.
        velocity: float32 [num_observations, 2] pixels per frame since the previous observation; at
            the start of a track, until the next one.
        full_speed: speed in pixels per frame that is drawn in full colour.
        has_tail: bool [num_observations] whether the track is drawn as a dot with a tail.
    """

    tracks: Tracks
    options: ViewOptions
    by_frame: list[Ints]
    age: Ints
    velocity: NDArray[np.float32]
    full_speed: float
    has_tail: Bools


def _prepare(tracks: Tracks, options: ViewOptions) -> _Drawing:
    length = tracks.lengths
    step = np.diff(tracks.xy, axis=0, prepend=tracks.xy[:1])
    interval = np.diff(tracks.frame, prepend=tracks.frame[:1])
    starts = tracks.offsets[:-1][length > 1]
    step[starts], interval[starts] = step[starts + 1], interval[starts + 1]
    velocity = (step / np.maximum(interval, 1)[:, None]).astype(np.float32)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    full_speed = float(np.quantile(speed, _FULL_COLOUR_QUANTILE)) if speed.size else 0.0
    return _Drawing(
        tracks=tracks,
        options=options,
        by_frame=tracks.by_frame(),
        age=np.arange(tracks.num_observations) - np.repeat(tracks.offsets[:-1], length),
        velocity=velocity,
        full_speed=max(full_speed, _LEAST_FULL_SPEED),
        has_tail=np.repeat(_is_spread(tracks, options.spacing), length),
    )


def _is_spread(tracks: Tracks, spacing: int) -> Bools:
    """Choose the tracks to draw as dots with tails, bool [num_tracks].

    Chosen is the longest of the tracks that start in a cell of `spacing` pixels within
    `_FRAMES_PER_CHOICE` frames.
    """
    length = tracks.lengths
    start = tracks.offsets[:-1]
    cell = np.floor(tracks.xy[start] / max(spacing, 1)).astype(np.int64)
    time = tracks.frame[start] // _FRAMES_PER_CHOICE
    key = np.lexsort((-length, cell[:, 0], cell[:, 1], time))
    place = np.column_stack([time, cell])[key]
    first = np.ones(len(key), dtype=bool)
    first[1:] = np.any(place[1:] != place[:-1], axis=1)
    chosen = np.zeros(len(key), dtype=bool)
    chosen[key[first]] = True
    return chosen


def _draw_motion(picture: Picture, drawing: _Drawing, frame: int) -> Picture:
    """Colour every unit with a track by the direction of its motion."""
    height, width = picture.shape[:2]
    rows, cols = -(-height // _UNIT), -(-width // _UNIT)
    seen = drawing.by_frame[frame]
    unit = np.floor(drawing.tracks.xy[seen] / _UNIT).astype(np.int64)
    colours = np.full((rows, cols, 3), _GREY, dtype=np.uint8)
    row, col = np.clip(unit[:, 1], 0, rows - 1), np.clip(unit[:, 0], 0, cols - 1)
    colours[row, col] = _direction_colours(drawing.velocity[seen] / drawing.full_speed)
    wheel = _direction_wheel(min(_WHEEL_SIZE, height // 4, width // 4))
    overlay = colours.repeat(_UNIT, axis=0).repeat(_UNIT, axis=1)[:height, :width]
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    opacity = drawing.options.opacity
    drawn = np.asarray(cv2.addWeighted(grey, 1 - opacity, overlay, opacity, 0), dtype=np.uint8)
    corner = drawn[: wheel.shape[0], : wheel.shape[1]]
    corner[...] = np.where(wheel.any(axis=2, keepdims=True), wheel, corner)
    return drawn


def _draw_tracks(picture: Picture, drawing: _Drawing, frame: int) -> Picture:
    """Draw a dot for each chosen track, and a tail along its previous positions."""
    drawn = picture.copy()
    seen = drawing.by_frame[frame]
    seen = seen[drawing.has_tail[seen]]
    tail = drawing.options.tail
    shade = np.minimum(drawing.age[seen] * 255 // _OLD_AGE, 255).astype(np.uint8)
    table = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_TURBO))
    steps = np.minimum(drawing.age[seen], tail)
    for last, count, colour in zip(seen, steps, table[0, shade].tolist(), strict=True):
        line = fixed_point(drawing.tracks.xy[last - count : last + 1])
        cv2.polylines(drawn, [line], False, colour, 1, cv2.LINE_AA, SHIFT)
        cv2.circle(drawn, line[-1].tolist(), 1 << SHIFT, colour, -1, cv2.LINE_AA, SHIFT)
    return np.asarray(drawn)


# The panels by the values of ViewOptions.draw; "both" draws all of them.
_PANELS = {"motion": _draw_motion, "tracks": _draw_tracks}


def fixed_point(xy: NDArray[np.float32]) -> NDArray[np.int32]:
    """Convert COLMAP's pixel coordinates to OpenCV's, in fixed point, for drawing.

    In OpenCV, pixel centres have integer coordinates.
    """
    return np.asarray(np.round((xy - 0.5) * (1 << SHIFT)), dtype=np.int32)


def _direction_colours(velocity: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Colours [n, 3] of velocities [n, 2]: the hue is the direction, saturated from length 1 on."""
    angle = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0])) % 360
    saturation = 255 * np.minimum(np.hypot(velocity[:, 0], velocity[:, 1]), 1)
    return bgr(angle / 2, saturation, np.full(len(angle), 255.0))


def _direction_wheel(size: int) -> Picture:
    """The key to `_direction_colours`: [size, size, 3], black outside the wheel."""
    y, x = np.mgrid[:size, :size]
    offset = np.stack([x, y], axis=-1).reshape(-1, 2) * (2 / max(size - 1, 1)) - 1
    colours = _direction_colours(offset)
    colours[np.hypot(offset[:, 0], offset[:, 1]) > 1] = 0
    return colours.reshape(size, size, 3)
