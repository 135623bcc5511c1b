"""Equirectangular videos are refused with a command that extracts perspective views."""

from __future__ import annotations

import shlex
import struct
import subprocess
from pathlib import Path

import imageio_ffmpeg
import pytest
from conftest import Encode, Ffmpeg, make_frames

from colmap_av1.errors import VideoError
from colmap_av1.match import match
from colmap_av1.video.facts import read_video
from colmap_av1.video.metadata.spherical import spherical_warnings

# Google's Spherical Video RFC, version 1: XML in a box of this type in the track.
UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
XML = b"""<?xml version="1.0"?><rdf:SphericalVideo
xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"
xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">
<GSpherical:Spherical>true</GSpherical:Spherical>
<GSpherical:Stitched>true</GSpherical:Stitched>
<GSpherical:StitchingSoftware>any</GSpherical:StitchingSoftware>
<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"""


def as_spherical(video: Path, output: Path) -> Path:
    """Add the box at the end of the first track; the index of the video must be at its end."""
    data = bytearray(video.read_bytes())
    box = struct.pack(">I4s", 24 + len(XML), b"uuid") + UUID + XML
    index = data.index(b"moov") - 4
    track = data.index(b"trak", index) - 4
    (size,) = struct.unpack_from(">I", data, track)
    data[track + size : track + size] = box
    for at in (index, track):
        struct.pack_into(">I", data, at, struct.unpack_from(">I", data, at)[0] + len(box))
    output.write_bytes(data)
    return output


def test_suggested_command_extracts_views(encode: Encode, ffmpeg: Ffmpeg, tmp_path: Path) -> None:
    flat = encode(make_frames(4, 256, 128), tmp_path / "flat.mp4")
    video = as_spherical(flat, tmp_path / "all round.mp4")
    assert read_video(flat).projection is None
    with pytest.raises(VideoError, match="equirectangular") as error:
        match(tmp_path / "a.db", video)
    assert not (tmp_path / "a.db").exists()
    line = str(error.value).split("--video: ")[1]
    program = shlex.quote(imageio_ffmpeg.get_ffmpeg_exe())
    line = line.replace("do ffmpeg ", f"do {program} -v error ")
    subprocess.run(line, shell=True, check=True, cwd=tmp_path)
    views = sorted(tmp_path.glob("all round_*.mp4"))
    assert [view.stem for view in views] == [f"all round_{yaw}" for yaw in (-90, 0, 180, 90)]
    assert {read_video(view).picture_size for view in views} == {(96, 96)}


def test_aspect_ratio_gives_a_hint() -> None:
    video = Path("a.mp4")
    (message,) = spherical_warnings(video, None, (3840, 1920))
    assert "equirectangular" in message
    assert spherical_warnings(video, None, (3840, 2160)) == []
    assert spherical_warnings(video, None, (256, 128)) == []
    assert spherical_warnings(video, 0, (3840, 1920)) == []
