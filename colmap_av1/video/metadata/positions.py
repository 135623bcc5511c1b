"""GPS positions and gravity of a video, from its container or from a file with the same name.

GoPro cameras write positions to a data track (GPMF). DJI drones write them as subtitles, in the
video or in an .srt file with the same name. Phones write one position for the whole video. FFmpeg
demuxes all of these, including .srt files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_av1.errors import VideoError
from colmap_av1.util.arrays import Floats
from colmap_av1.util.texts import excerpt
from colmap_av1.video.container import VideoFile, open_container, until_damage
from colmap_av1.video.metadata.gpmf import Payload, read_payload
from colmap_av1.video.metadata.places import are_places
from colmap_av1.video.metadata.subtitles import holds_position, read_position, to_places

# Apple and Android write one position in these tags, in degrees as in ISO 6709, annex H.
_TAGS = ("com.apple.quicktime.location.iso6709", "location", "location-eng", "xyz")
_NUMBER = r"[+-]?\d+(?:\.\d+)?"
_ISO_6709 = re.compile(rf"({_NUMBER})([+-]\d+(?:\.\d+)?)([+-]\d+(?:\.\d+)?)?(?:CRS\S*)?/?")
# Every packet of GoPro's track begins with this key. PyAV does not name the codec of data streams.
_GPMF = b"DEVC"
_UNKNOWN_FORMAT = "has no positions in a known format"
# FFmpeg's AVDISCARD_DEFAULT and AVDISCARD_ALL.
_READ, _SKIP = 0, 48
# Positions are interpolated between neighbours that are at most this many seconds apart.
_LONGEST_GAP = 3.0


@dataclass(frozen=True)
class _Packet:
    """Start and duration of a packet in seconds, and its content."""

    start: float
    duration: float
    content: bytes


@dataclass(frozen=True)
class Positions:
    """GPS positions and directions of gravity of a video.

    Attributes:
        source: where they come from, for messages.
        times: float64 [n] seconds after the video's first picture, ascending.
        places: float64 [n, 3] latitude and longitude in degrees, altitude in metres (WGS 84;
            0 if unknown).
        place: one position for the whole video, in the same units; None if not given.
        gravity_times: float64 [m] as `times`.
        gravity: float64 [m, 3] direction of gravity in camera axes, which are the image axes in
            another order and with other signs.
        stream: index of the stream of the video that holds times and places; None if another file
            holds them, or there are none.
        first_picture: time in seconds of the video's first picture, on the clock of players.
        ignored: description of the data that is ignored; None if nothing is ignored.
    """

    source: str
    times: Floats
    places: Floats
    place: tuple[float, float, float] | None
    gravity_times: Floats
    gravity: Floats
    stream: int | None = None
    first_picture: float = 0.0
    ignored: str | None = None


def implausible_position(tags: tuple[tuple[str, str], ...]) -> str | None:
    """Describe an invalid position that a container gives for the whole video; None if none.

    Args:
        tags: metadata of the container: (name in lower case, value) pairs.
    """
    metadata = dict(tags)
    text = next((metadata[tag].strip() for tag in _TAGS if metadata.get(tag, "").strip()), None)
    if text is None or _one_place(metadata) is not None:
        return None
    return f"the container's position '{excerpt(text)}' is not a place on Earth: it is ignored"


def read_positions(video: VideoFile) -> Positions | None:
    """Read the positions of a video; None if there is no data and no valid tag.

    Raises:
        VideoError: the file cannot be opened.
    """
    place = _one_place(dict(video.tags))
    found: Positions | None = None
    start = 0.0
    if video.has_telemetry:
        start = _first_picture(video)
        with open_container(video.path, apply_edits=True) as container:
            packets = _packets(container)
            found = _of_data(container, packets, start)
            if found is None or found.ignored is not None:
                found = _of_subtitles(container, packets, start, place) or found
    srt_file = _srt_file(video.path)
    if srt_file is not None and (found is None or not (len(found.times) or len(found.gravity))):
        found = _of_srt_file(srt_file, place) or found
    if found is not None:
        return replace(found, place=place, first_picture=start)
    nothing = np.empty(0), np.empty((0, 3))
    return Positions(str(video), *nothing, place, *nothing) if place is not None else None


def interpolate(times: Floats, known_times: Floats, known: Floats) -> Floats:
    """Interpolate known values linearly; NaN before the first, after the last, and in long gaps.

    Args:
        times: float64 [n] seconds.
        known_times: float64 [m] seconds, ascending.
        known: float64 [m, k] values at these times.

    Returns:
        float64 [n, k] values at `times`.
    """
    found = np.full((len(times), known.shape[1]), np.nan)
    if len(known_times) < 2:
        return found
    after = np.clip(np.searchsorted(known_times, times), 1, len(known_times) - 1)
    start, end = known_times[after - 1], known_times[after]
    step = end - start
    # The last value is used for one more step, until the next value would follow.
    within = (times >= start - step) & (times <= end + step) & (step <= _LONGEST_GAP)
    share = np.clip((times - start) / step, 0, 1)[:, None]
    between = known[after - 1] + share * (known[after] - known[after - 1])
    found[within] = between[within]
    return found


def _srt_file(video: Path) -> Path | None:
    return next((p for s in (".srt", ".SRT") if (p := video.with_suffix(s)).is_file()), None)


def _of_srt_file(path: Path, place: tuple[float, float, float] | None) -> Positions | None:
    try:
        with open_container(path) as container:
            found = _of_subtitles(container, _packets(container), 0.0, place)
    except VideoError:
        nothing = np.empty(0), np.empty((0, 3))
        ignored = f"{path} {_UNKNOWN_FORMAT}"
        return Positions(str(path), *nothing, None, *nothing, ignored=ignored)
    return replace(found, source=str(path), stream=None) if found else None


def _first_picture(video: VideoFile) -> float:
    """Time of a video's first picture on the clock of players, even if an edit list hides it.

    An edit list shifts the pictures to compensate the delay of coding out of order. Telemetry has
    another edit list, or none.
    """
    with open_container(video.path, apply_edits=True) as edited:
        stream = edited.streams[video.index]
        if not video.is_mp4:
            return _start(stream)
        with until_damage(), open_container(video.path) as unedited:
            shown = next((p for p in edited.demux(stream) if p.size and p.pts is not None), None)
            same = unedited.streams[video.index]
            for packet in unedited.demux(same):
                if shown is not None and packet.pos == shown.pos and packet.pts is not None:
                    later = (packet.pts - shown.pts) * stream.time_base
                    return _start(same) - float(later)
        return _start(stream)


def _start(stream: Any) -> float:
    if stream.start_time is None or not stream.time_base:
        return 0.0
    return float(stream.start_time * stream.time_base)


def _one_place(metadata: dict[str, str]) -> tuple[float, float, float] | None:
    for tag in _TAGS:
        match = _ISO_6709.fullmatch(metadata.get(tag, "").strip())
        if match is not None:
            latitude, longitude = float(match[1]), float(match[2])
            place = np.array([[latitude, longitude, float(match[3] or 0)]])
            if are_places(place)[0]:
                return latitude, longitude, float(match[3] or 0)
    return None


def _packets(container: Any) -> dict[int, list[_Packet]]:
    """The packets of each stream that may hold positions, up to damage."""
    streams = [*container.streams.data, *container.streams.subtitles]
    found: dict[int, list[_Packet]] = {stream.index: [] for stream in streams}
    for other in container.streams:
        if hasattr(other, "discard"):  # newer PyAV can skip other streams without reading them
            other.discard = type(other.discard)(_READ if other in streams else _SKIP)
    data = {stream.index for stream in container.streams.data}
    with until_damage():
        for packet in container.demux(streams):
            index, content = packet.stream.index, bytes(packet)
            if (
                not content
                or packet.pts is None
                or (index in data and not content.startswith(_GPMF))
            ):
                continue
            base = packet.time_base
            start, duration = packet.pts * base, (packet.duration or 0) * base
            found[index].append(_Packet(float(start), float(duration), content))
    return found


def _of_data(container: Any, packets: dict[int, list[_Packet]], start: float) -> Positions | None:
    """The positions of GoPro's data track."""
    tracks = [stream.index for stream in container.streams.data if packets[stream.index]]
    if not tracks:
        return None
    found = packets[tracks[0]]
    payloads = [
        (packet.start - start, packet.duration, read_payload(packet.content)) for packet in found
    ]
    times, places = _spread(payloads, lambda payload: payload.positions)
    gravity_times, gravity = _spread(payloads, lambda payload: payload.gravity)
    kept = are_places(places)
    held = np.linalg.norm(gravity, axis=1) > 0.5
    source = f"the GoPro track of {container.name}"
    ignored = _message_of_ignored(source, places[~kept])
    if not kept.any() and ignored is None and any(_has_receiver(p.content) for p in found):
        ignored = f"{source} has no positions: the receiver had no fix, or the track is damaged"
    if not kept.any() and not held.any() and ignored is None:
        return None
    return Positions(
        source,
        *_ascending(times[kept], places[kept]),
        None,
        *_ascending(gravity_times[held], gravity[held]),
        stream=tracks[0],
        ignored=ignored,
    )


def _has_receiver(payload: bytes) -> bool:
    """Whether a GoPro packet has fields for positions or their fix."""
    return any(key in payload for key in (b"GPS5", b"GPS9", b"GPSF"))


def _message_of_ignored(source: str, refused: Floats, unreadable: int = 0) -> str | None:
    """The message for ignored positions [n, 3]; None if there are only positions without a fix."""
    count = int((np.nan_to_num(refused[:, :2]) != 0).any(axis=1).sum()) + unreadable
    if count == 0:
        return None
    return f"{source}: ignored {count} invalid GPS positions"


def _spread(
    payloads: Sequence[tuple[float, float, Payload]],
    of: Callable[[Payload], Floats],
) -> tuple[Floats, Floats]:
    """Times and values of the samples of all packets, spaced evenly within each packet."""
    times = [np.empty(0)]
    values = [np.empty((0, 3))]
    for start, duration, payload in payloads:
        found = of(payload)
        if found.ndim == 2 and found.shape[1] == 3 and len(found):
            times.append(start + duration * np.arange(len(found)) / len(found))
            values.append(found)
    return np.concatenate(times), np.concatenate(values)


def _of_subtitles(
    container: Any,
    packets: dict[int, list[_Packet]],
    start: float,
    place: tuple[float, float, float] | None,
) -> Positions | None:
    """The positions in the subtitles of a drone."""
    found = [
        own
        for stream in container.streams.subtitles
        if (own := _of_texts(container.name, stream.index, packets[stream.index], start, place))
    ]
    return next((own for own in found if len(own.times)), found[0] if found else None)


def _of_texts(
    name: str,
    stream: int,
    packets: list[_Packet],
    start: float,
    place: tuple[float, float, float] | None,
) -> Positions | None:
    texts = [(p.start - start, p.content.decode("utf-8", "replace")) for p in packets]
    found = [(time, own) for time, text in texts if (own := read_position(text)) is not None]
    unreadable = sum(read_position(text) is None and holds_position(text) for _, text in texts)
    source = f"the subtitles of {name}"
    times = np.array([time for time, _ in found])
    places, doubt = to_places([own for _, own in found], place)
    kept = are_places(places)
    if doubt is not None:
        ignored: str | None = f"{source}: positions are ignored because it is unclear {doubt}"
    elif found or not unreadable:
        ignored = _message_of_ignored(source, places[~kept], unreadable)
    else:
        ignored = f"{source} {_UNKNOWN_FORMAT}"
    if not kept.any() and ignored is None:
        return None
    nothing = np.empty(0), np.empty((0, 3))
    path = _ascending(times[kept], places[kept])
    return Positions(source, *path, None, *nothing, stream=stream, ignored=ignored)


def _ascending(times: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Sort by time, and keep one value per time."""
    at, first = np.unique(times, return_index=True)
    return at, values[first]
