"""Where a video was taken, as its container or a file beside it says.

GoPro writes positions in a data track (GPMF), DJI as subtitles, in the file or in an .srt beside
it; phones write one for the whole video. FFmpeg demuxes them all, .srt files, too.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av.error
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.util.texts import shown
from colmap_av1.video.container import VideoFile, open_container
from colmap_av1.video.metadata.gpmf import Payload, read_payload

# As Apple and Android spell one position: ISO 6709, annex H, in degrees.
_TAGS = ("com.apple.quicktime.location.iso6709", "location", "location-eng", "xyz")
_NUMBER = r"[+-]?\d+(?:\.\d+)?"
_ISO_6709 = re.compile(rf"({_NUMBER})([+-]\d+(?:\.\d+)?)([+-]\d+(?:\.\d+)?)?(?:CRS\S*)?/?")
# DJI's spellings of two decades, one with a slip of the pen.
_LATITUDE = re.compile(rf"\blatitude\s*:\s*({_NUMBER})")
_LONGITUDE = re.compile(rf"\blong(?:i|ti)tude\s*:\s*({_NUMBER})")
_LONGITUDE_FIRST = re.compile(rf"\bGPS\s*\(\s*({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*({_NUMBER})")
_ALTITUDES = (
    re.compile(rf"\babs_alt\s*:\s*({_NUMBER})"),
    re.compile(rf"\baltitude\s*:\s*({_NUMBER})"),
    re.compile(rf"\brel_alt\s*:\s*({_NUMBER})"),
    re.compile(rf"\bBAROMETER\s*:\s*({_NUMBER})"),
    re.compile(rf"\bH\s+({_NUMBER})m"),
)
# What a subtitle holds that is to say a place.
_SAYS_PLACE = re.compile(r"\blatitude\b|\bGPS\s*\(")
# The key that every packet of GoPro's track begins with: PyAV does not name the codec of data.
_GPMF = b"DEVC"
# FFmpeg's AVDISCARD_DEFAULT and AVDISCARD_ALL.
_READ, _SKIP = 0, 48
# Longest time between two positions that those of frames are interpolated over, in seconds.
_LONGEST_GAP = 3.0


@dataclass(frozen=True)
class Positions:
    """Where a video was taken, and how it was held.

    Attributes:
        source: what says it, for messages.
        times: float64 [n] seconds after the video's first picture, ascending.
        places: float64 [n, 3] latitude and longitude in degrees, altitude in metres (WGS 84;
            0 where it is unknown).
        place: the one position of the whole video, likewise; None: none is said.
        gravity_times: float64 [m] as `times`.
        gravity: float64 [m, 3] direction of gravity in axes of the camera, which are the image's
            but for their order and signs.
        stream: index of the stream of the video that holds times and places; None: another file
            does, or none.
        first_picture: time in seconds of the video's first picture as players count it.
        left_out: what is said and cannot be used, in words; None: nothing.
    """

    source: str
    times: NDArray[np.float64]
    places: NDArray[np.float64]
    place: tuple[float, float, float] | None
    gravity_times: NDArray[np.float64]
    gravity: NDArray[np.float64]
    stream: int | None = None
    first_picture: float = 0.0
    left_out: str | None = None


def doubtful_place(tags: tuple[tuple[str, str], ...]) -> str | None:
    """The one position that a container says and that can be none, in words; None: there is none.

    Args:
        tags: names in lower case, and values, of what the container says.
    """
    said = dict(tags)
    text = next((said[tag].strip() for tag in _TAGS if said.get(tag, "").strip()), None)
    if text is None or _one_place(said) is not None:
        return None
    return (
        f"the container says that it was filmed at '{shown(text)}', which is no place on "
        "Earth: that is left out"
    )


def read_positions(video: VideoFile) -> Positions | None:
    """Read the positions of a video; None where nothing says any, or no tag one that can be one.

    Raises:
        VideoError: the file cannot be opened.
    """
    place = _one_place(dict(video.tags))
    found: Positions | None = None
    start = 0.0
    if video.has_telemetry:
        with open_container(video.path, apply_edits=True) as container:
            start = _first_picture(video, container)
            found = _of_data(container, start)
            if found is None or found.left_out is not None:
                found = _of_subtitles(container, start) or found
    beside = _file_beside(video.path)
    if found is None and beside is not None:
        with contextlib.suppress(VideoError), open_container(beside) as container:
            found = _of_subtitles(container, 0.0)
            found = replace(found, source=str(beside), stream=None) if found else None
    if found is not None:
        return replace(found, place=place, first_picture=start)
    nothing = np.empty(0), np.empty((0, 3))
    return Positions(str(video), *nothing, place, *nothing) if place is not None else None


def interpolate(
    times: NDArray[np.float64], known_times: NDArray[np.float64], known: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Values at some times between known ones; NaN before, after, and in long gaps.

    Args:
        times: float64 [n] seconds.
        known_times: float64 [m] ascending.
        known: float64 [m, k].
    """
    found = np.full((len(times), known.shape[1]), np.nan)
    if len(known_times) < 2:
        return found
    after = np.clip(np.searchsorted(known_times, times), 1, len(known_times) - 1)
    start, end = known_times[after - 1], known_times[after]
    step = end - start
    # The last position holds until the next would come.
    within = (times >= start - step) & (times <= end + step) & (step <= _LONGEST_GAP)
    share = np.clip((times - start) / step, 0, 1)[:, None]
    between = known[after - 1] + share * (known[after] - known[after - 1])
    found[within] = between[within]
    return found


def _file_beside(video: Path) -> Path | None:
    return next((p for s in (".srt", ".SRT") if (p := video.with_suffix(s)).is_file()), None)


def _first_picture(video: VideoFile, container: Any) -> float:
    """Time of a video's first picture as players count it, who may hide it.

    Telemetry has edits of its own, or none: pictures coded out of order are shown later, and edits
    make up for that.
    """
    stream = container.streams[video.index]
    if "mov" not in video.container:
        return _start(stream)
    with (
        contextlib.suppress(av.error.FFmpegError, OSError),
        open_container(video.path) as unedited,
    ):
        shown = next((p for p in container.demux(stream) if p.size and p.pts is not None), None)
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


def are_places(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of some latitudes, longitudes and altitudes [n, 3] can be those of a camera.

    Both angles 0 is what receivers write without a fix.
    """
    latitude, longitude, altitude = np.nan_to_num(places, nan=np.inf).T
    on_earth = (abs(latitude) <= 90) & (abs(longitude) <= 180) & (abs(altitude) < 1e5)
    return np.asarray(on_earth & ((latitude != 0) | (longitude != 0)))


def _packets(container: Any, streams: Sequence[Any]) -> Iterator[tuple[int, float, float, bytes]]:
    """Stream's index, start, duration and content of some streams' packets, up to damage."""
    for other in container.streams:
        if hasattr(other, "discard"):  # of later PyAV: what is not wanted is not even read
            other.discard = type(other.discard)(_READ if other in streams else _SKIP)
    with contextlib.suppress(av.error.FFmpegError, OSError):
        container.seek(0)  # it may have been read before
        for packet in container.demux(streams):
            if packet.size and packet.pts is not None:
                base = packet.time_base
                start, duration = packet.pts * base, (packet.duration or 0) * base
                yield packet.stream.index, float(start), float(duration), bytes(packet)


def _of_data(container: Any, start: float) -> Positions | None:
    """The positions of GoPro's data track."""
    streams = list(container.streams.data)
    if not streams:
        return None
    found = [own for own in _packets(container, streams) if own[-1].startswith(_GPMF)]
    payloads = [(time - start, duration, read_payload(data)) for _, time, duration, data in found]
    times, places = _spread(payloads, lambda payload: payload.positions)
    gravity_times, gravity = _spread(payloads, lambda payload: payload.gravity)
    kept = are_places(places)
    held = np.linalg.norm(gravity, axis=1) > 0.5
    source = f"the GoPro track of {container.name}"
    left_out = _left_out(source, places[~kept])
    if not kept.any() and left_out is None and any(_has_receiver(data) for *_, data in found):
        left_out = f"{source} holds no position: the receiver had no fix, or the track is damaged"
    if not kept.any() and not held.any() and left_out is None:
        return None
    return Positions(
        source,
        *_ascending(times[kept], places[kept]),
        None,
        *_ascending(gravity_times[held], gravity[held]),
        stream=found[0][0],
        left_out=left_out,
    )


def _has_receiver(payload: bytes) -> bool:
    """Whether a packet of GoPro's is to hold positions, or what is said of their fix."""
    return any(key in payload for key in (b"GPS5", b"GPS9", b"GPSF"))


def _left_out(source: str, refused: NDArray[np.float64], unreadable: int = 0) -> str | None:
    """What is said of positions [n, 3] that can be none; those of no fix go without saying."""
    count = int((np.nan_to_num(refused[:, :2]) != 0).any(axis=1).sum()) + unreadable
    if count == 0:
        return None
    return f"{source}: {count} of its positions can be none on Earth: they are left out"


def _spread(
    payloads: Sequence[tuple[float, float, Payload]],
    of: Callable[[Payload], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Samples of all packets, and their times: each packet's are evenly spread over it."""
    times = [np.empty(0)]
    values = [np.empty((0, 3))]
    for start, duration, payload in payloads:
        found = of(payload)
        if found.ndim == 2 and found.shape[1] == 3 and len(found):
            times.append(start + duration * np.arange(len(found)) / len(found))
            values.append(found)
    return np.concatenate(times), np.concatenate(values)


def _of_subtitles(container: Any, start: float) -> Positions | None:
    """The positions in DJI's subtitles."""
    for stream in container.streams.subtitles:
        texts = [
            (time - start, data.decode("utf-8", "replace"))
            for _, time, _, data in _packets(container, [stream])
        ]
        found = [(time, place) for time, text in texts if (place := _place_in(text)) is not None]
        places = np.array([place for _, place in found]).reshape(-1, 3)
        kept = are_places(places)
        source = f"the subtitles of {container.name}"
        unreadable = sum(_SAYS_PLACE.search(text) is not None for _, text in texts) - len(found)
        left_out = _left_out(source, places[~kept], unreadable)
        if kept.any() or left_out is not None:
            times = np.array([time for time, _ in found])
            nothing = np.empty(0), np.empty((0, 3))
            own = _ascending(times[kept], places[kept])
            return Positions(source, *own, None, *nothing, stream=stream.index, left_out=left_out)
    return None


def _place_in(text: str) -> tuple[float, float, float] | None:
    """Latitude, longitude and altitude in a subtitle; None where it holds none."""
    latitude, longitude = _LATITUDE.search(text), _LONGITUDE.search(text)
    altitude = next((m for pattern in _ALTITUDES if (m := pattern.search(text))), None)
    if latitude is not None and longitude is not None:
        return float(latitude[1]), float(longitude[1]), float(altitude[1]) if altitude else 0.0
    both = _LONGITUDE_FIRST.search(text)
    if both is None:
        return None
    # The third number is the altitude with some models, the number of satellites with others.
    return float(both[2]), float(both[1]), float(altitude[1] if altitude else both[3])


def _ascending(
    times: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """By time, each time once."""
    at, first = np.unique(times, return_index=True)
    return at, values[first]
