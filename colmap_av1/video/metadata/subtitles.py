"""Positions in the subtitles that drones write.

| spelling | order | third number | drones |
|---|---|---|---|
| `[latitude: 59.3] [longitude: 18.0]`, `longtitude` | named | | DJI Mavic 2 and later |
| `GPS (18.0, 59.3, 16)`, `RTK` | longitude first | satellites | DJI Mavic Pro, Phantom 4, Mini |
| `GPS(59.3,18.0,0.0M)` | latitude first | accuracy | DJI Matrice 300 |
| `GPS(E: 18.0, N: 59.3, 12.5m)` | named | altitude | Autel |

The order in other spellings is unknown. Some Mavic Air 2 write radians instead of degrees. Source:
the sample files of DJI_SRT_Parser, and ExifTool's subtitle reader.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from colmap_av1.util.arrays import Floats
from colmap_av1.video.metadata.places import are_places

_NUMBER = r"[+-]?\d+(?:\.\d+)?"
_LATITUDE = re.compile(rf"\blatitude\s*:\s*({_NUMBER})", re.IGNORECASE)
_LONGITUDE = re.compile(rf"\blong(?:i|ti)tude\s*:\s*({_NUMBER})", re.IGNORECASE)
_HEMISPHERES = re.compile(
    rf"\bGPS\s*\(\s*([EW])\s*:\s*({_NUMBER})\s*,\s*([NS])\s*:\s*({_NUMBER})(?:\s*,\s*({_NUMBER})m)?"
)
_PAIR = re.compile(rf"\b(?:GPS|RTK)\s*\(\s*({_NUMBER})\s*,\s*({_NUMBER})\s*(?:,\s*([^)]*?)\s*)?\)")
_SATELLITES = re.compile(r"\d{1,2}")
_ACCURACY = re.compile(r"\d+\.\d+M")
_METRES = re.compile(rf"({_NUMBER})m?")
_ALTITUDES = (
    re.compile(rf"\babs_alt\s*:\s*({_NUMBER})"),
    re.compile(rf"\baltitude\s*:\s*({_NUMBER})"),
    re.compile(rf"\brel_alt\s*:\s*({_NUMBER})"),
    re.compile(rf"\bBAROMETER\s*[:(]\s*({_NUMBER})"),
    re.compile(rf"\bHb\s*:\s*({_NUMBER})"),
    re.compile(rf"\bH\s+({_NUMBER})m"),
)
# A text with one of these names, or with two numbers of four decimals or more, holds a position.
_HOLDS_POSITION = re.compile(
    r"\b(?:lat|latitude|lon|lng|longt?itude|GPS|RTK)\b|-?\d+\.\d{4,}\D+\d+\.\d{4,}", re.IGNORECASE
)
# Written instead of a position if there is no fix.
_NO_FIX = re.compile(r"\((?:\s*n/a\s*,?)+", re.IGNORECASE)
# Largest extent of the path of a video, in radians of latitude or longitude (64 km).
_LONGEST_PATH = 0.01
# Largest distance in degrees between a path and the position of its video.
_NEAR = 1.0


class Order(Enum):
    """Which of the two angles of a position is written first."""

    NAMED = "named"
    LATITUDE_FIRST = "latitude first"
    LONGITUDE_FIRST = "longitude first"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class WrittenPosition:
    """A position as written in a subtitle.

    Attributes:
        angles: the two angles in the order in which they are written; latitude and longitude
            if they are named.
        order: which of them comes first.
        altitude: in metres; 0 if unknown.
    """

    angles: tuple[float, float]
    order: Order
    altitude: float


def holds_position(text: str) -> bool:
    """Whether a subtitle holds a position, also in an unknown format; false without a fix."""
    return _HOLDS_POSITION.search(text) is not None and _NO_FIX.search(text) is None


def read_position(text: str) -> WrittenPosition | None:
    """The position in a subtitle; None if it holds none in a known format."""
    match = next((m for pattern in _ALTITUDES if (m := pattern.search(text))), None)
    altitude = float(match[1]) if match else 0.0
    latitude, longitude = _LATITUDE.search(text), _LONGITUDE.search(text)
    if latitude is not None and longitude is not None:
        return WrittenPosition((float(latitude[1]), float(longitude[1])), Order.NAMED, altitude)
    if (named := _HEMISPHERES.search(text)) is not None:
        north = float(named[4]) * (1 if named[3] == "N" else -1)
        east = float(named[2]) * (1 if named[1] == "E" else -1)
        return WrittenPosition((north, east), Order.NAMED, float(named[5] or altitude))
    if (pair := _PAIR.search(text)) is None:
        return None
    angles = float(pair[1]), float(pair[2])
    third = pair[3] or ""
    if _SATELLITES.fullmatch(third):
        return WrittenPosition(angles, Order.LONGITUDE_FIRST, altitude)
    if _ACCURACY.fullmatch(third):
        return WrittenPosition(angles, Order.LATITUDE_FIRST, altitude)
    metres = _METRES.fullmatch(third)
    own = float(metres[1]) if metres and match is None else altitude
    return WrittenPosition(angles, Order.UNKNOWN, own)


def to_places(
    written: Sequence[WrittenPosition], place: tuple[float, float, float] | None
) -> tuple[Floats, str | None]:
    """Latitude, longitude and altitude of the positions of one video.

    The format determines the order and unit of the angles, unless that makes most positions
    invalid or contradicts the position of the whole video.

    Args:
        written: the positions.
        place: the position of the whole video; None if unknown.

    Returns:
        float64 [n, 3], NaN if their order or unit is uncertain, and in that case a description of
        what is uncertain.
    """
    places = np.full((len(written), 3), np.nan)
    doubt = None
    for order in Order:
        own = [index for index, position in enumerate(written) if position.order is order]
        if not own:
            continue
        angles = np.array([written[index].angles for index in own])
        readings, what, is_certain = _readings(angles, order)
        chosen = _choose(readings, is_certain, place)
        if chosen is None:
            doubt = what
            continue
        places[own, :2] = chosen
        places[own, 2] = [written[index].altitude for index in own]
    return places, doubt


def _readings(angles: Floats, order: Order) -> tuple[list[Floats], str, bool]:
    """Possible interpretations of angles [n, 2].

    Returns:
        The interpretations, the most likely first; how they differ; whether the first is certain.
    """
    swapped = angles[:, ::-1]
    if order is Order.NAMED:
        known = angles[(angles != 0).any(axis=1)]
        are_radians = (
            len(known) > 0
            and bool((np.abs(known) <= [np.pi / 2, np.pi]).all())
            and bool((np.ptp(known, axis=0) <= _LONGEST_PATH).all())
        )
        if are_radians:
            return [angles, np.degrees(angles)], "whether they are in degrees or radians", False
        return [angles], "", True
    what = "whether latitude or longitude comes first"
    if order is Order.LONGITUDE_FIRST:
        return [swapped, angles], what, True
    return [angles, swapped], what, order is Order.LATITUDE_FIRST


def _choose(
    readings: list[Floats], is_certain: bool, place: tuple[float, float, float] | None
) -> Floats | None:
    """The interpretation that range, video and format agree on; None if two remain."""
    known = (readings[0] != 0).any(axis=1)
    if len(readings) == 1 or not known.any():
        return readings[0]
    on_earth = [are_places(np.insert(r[known], 2, 0.0, axis=1)) for r in readings]
    possible = [
        reading for reading, those in zip(readings, on_earth, strict=True) if those.mean() >= 0.5
    ]
    if place is not None:
        near = [r for r in possible or readings if _degrees_apart(r[known], place) < _NEAR]
        if len(near) == 1:
            return near[0]
    if len(possible) == 1 or is_certain:
        return (possible or readings)[0]
    return None


def _degrees_apart(angles: Floats, place: tuple[float, float, float]) -> float:
    north = angles[:, 0] - place[0]
    east = (angles[:, 1] - place[1] + 180) % 360 - 180
    return float(np.hypot(north, east * np.cos(np.radians(place[0]))).min())
