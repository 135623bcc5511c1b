"""Damaged and hostile streams give an error of this package or the frames before the damage."""

from __future__ import annotations

import contextlib
import hashlib
import json
import struct
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from block_data import blank_blocks, frame_of_blocks
from conformance import parse
from conftest import PROJECT, SHARED, TEST_PATHS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ivf_files import packets
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import BitstreamError, ColmapAv1Error, LimitError
from colmap_av1.motion.frame_motion import BLOCK, FrameMotion
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import ReadOptions
from colmap_av1.tracks.tracks import build_tracks
from colmap_av1.video.decoding import decode_frames

_DATA = PROJECT / "tests" / "data" / "conformance"
_KIT = SHARED / "conformance"
_UNIT_FIELDS = (
    *("mv", "ref_frame", "mi_size", "y_mode", "is_inter", "skip", "skip_mode", "segment_id"),
    *("motion_mode", "compound_type", "interintra", "use_intrabc"),
)
_TIMEOUT = 120  # seconds for all files of a test together; they take 2
_MEGABYTE = 1 << 20

# Files without a readable frame. FFmpeg versions differ in where demuxing fails: before the first
# packet the file is not a video, after it the stream is damaged.
_NO_VIDEO = ("VideoError", "BitstreamError")
_ERRORS = {
    **dict.fromkeys(
        (
            *("empty.ivf", "ivf_header_only.ivf", "ivf_header_cut.ivf", "cut_in_key_frame.ivf"),
            *("garbage.ivf", "garbage_after_header.ivf", "text.ivf", "obu_size_past_end.ivf"),
            *("obu_size_leb128_overlong.ivf", "ivf_header_length_bad.ivf", "cut_half.mp4"),
            *("moov_flips.mp4", "stsz_huge_size.mp4", "stco_past_end.mp4", "cut_half.mkv"),
            *("ebml_size_bad.mkv", "starts_mid_obu.obu", "annexb_unit_size_bad.obu"),
        ),
        _NO_VIDEO,
    ),
    **dict.fromkeys(("wrong_fourcc.ivf", "h264.mp4", "h264.mkv"), ("NotAv1Error",)),
    **dict.fromkeys(
        (
            *("flip_sequence_header_0.ivf", "flip_sequence_header_1.ivf"),
            *("flip_frame_header_0.ivf", "flip_tile_data_3.ivf", "random_tile_data.ivf"),
            *("no_key_frame.ivf", "no_sequence_header.ivf", "wide_dimensions.ivf"),
            *("show_existing_empty_slot.ivf", "tile_size_past_end.ivf", "tile_size_tiny.ivf"),
        ),
        ("BitstreamError",),
    ),
    "huge_dimensions.ivf": ("LimitError",),
}
# Damage that the syntax does not reveal.
_SILENT = ("flip_frame_header_2.ivf", "duplicated_tu.ivf", "reserved_obu_types.ivf")

# Reads files in a separate process, so that a crash or a hang does not stop the tests. Writes a
# line of JSON for each file before it reads the next.
_WORKER = """
import gc, json, os, resource, sys, time, warnings
sys.path[:0] = sys.argv[1].split(os.pathsep)
from test_damaged import frame_digest
from colmap_av1.errors import ColmapAv1Error
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import ReadOptions
from colmap_av1.tracks.tracks import build_tracks

def peak():
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used if sys.platform == "darwin" else 1024 * used

for path in sys.argv[2:]:
    outcome = {"file": path, "error": None, "strict_error": None, "digests": []}
    before, start = peak(), time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            for frame in read_motion(path):
                outcome["digests"].append([frame.decode_index, frame_digest(frame)])
        except ColmapAv1Error as error:
            outcome["error"] = type(error).__name__
    outcome["warnings"] = [str(w.message) for w in caught]
    gc.collect()  # what the error's traceback holds
    try:
        for frame in read_motion(path, ReadOptions(strict=True)):
            pass
    except ColmapAv1Error as error:
        outcome["strict_error"] = type(error).__name__
    outcome["grown"], outcome["seconds"] = peak() - before, time.perf_counter() - start
    print(json.dumps(outcome), flush=True)
"""


def digest(fields: dict[str, NDArray[Any]]) -> str:
    """Digest of the unit arrays of a frame, independent of shape and memory order."""
    state = hashlib.sha256()
    for name in _UNIT_FIELDS:
        state.update(np.ascontiguousarray(fields[name]).tobytes())
    return state.hexdigest()


def frame_digest(frame: FrameMotion) -> str:
    return digest({name: getattr(frame, name) for name in _UNIT_FIELDS})


def read_apart(paths: list[Path]) -> dict[str, dict[str, Any]]:
    """Read the files in a separate process; a crash or a hang fails the test."""
    command = [sys.executable, "-c", _WORKER, TEST_PATHS, *map(str, paths)]
    run = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=_TIMEOUT,
        cwd=Path(__file__).parent,  # the checkout would hide the installed package
    )
    outcomes = [json.loads(line) for line in run.stdout.splitlines()]
    if run.returncode != 0 or len(outcomes) != len(paths):
        at = paths[len(outcomes)].name if len(outcomes) < len(paths) else "its end"
        pytest.fail(f"status {run.returncode} at {at}: {run.stderr[-2000:]}")
    return {Path(outcome["file"]).name: outcome for outcome in outcomes}


def expected_digests(npz: Path) -> dict[int, tuple[int, str]]:
    """Temporal unit and digest of every decoded frame of a stream, by decode_index."""
    found = {}
    with np.load(npz) as arrays:
        want = dict(arrays)
    for index in range(int(want["frames"])):
        if want["h_show_existing_frame"][index] == 1:
            continue
        offset = int(want["h_unit_offset"][index])
        count = int(want["h_mi_rows"][index] * want["h_mi_cols"][index])
        units = {name: want[f"u_{name}"][offset : offset + count] for name in _UNIT_FIELDS}
        if want["h_frame_type"][index] in (0, 2):  # as in conformance.py
            units["skip_mode"] = np.zeros_like(units["skip_mode"])
        found[index] = (int(want["h_temporal_unit"][index]), digest(units))
    return found


def packets_until_damage(path: Path) -> list[bytes]:
    found: list[bytes] = []
    with contextlib.suppress(ColmapAv1Error):
        found.extend(packet.data for packet in packets(path))
    return found


def intact_units(damaged: Path, source: Path) -> int:
    """Number of undamaged temporal units at the start."""
    count = 0
    for got, want in zip(packets_until_damage(damaged), packets_until_damage(source), strict=False):
        if got != want:
            break
        count += 1
    return count


def bad_files() -> list[dict[str, Any]]:
    manifest = _KIT / "bad" / "bad.json"
    return list(json.loads(manifest.read_text())) if manifest.exists() else []


@pytest.fixture(scope="module")
def outcomes() -> dict[str, dict[str, Any]]:
    return read_apart([_KIT / "bad" / bad["file"] for bad in bad_files()])


@pytest.mark.shared
@pytest.mark.parametrize("bad", bad_files(), ids=lambda bad: bad["file"])
def test_damaged_file_gives_the_expected_error_or_frames(
    bad: dict[str, Any], outcomes: dict[str, dict[str, Any]]
) -> None:
    name = bad["file"]
    outcome = outcomes[name]
    assert outcome["grown"] < 64 * _MEGABYTE
    assert outcome["seconds"] < 20

    if name in _ERRORS:
        assert outcome["error"] in _ERRORS[name]
        assert outcome["strict_error"] == outcome["error"]
        assert outcome["digests"] == []
        return
    assert outcome["error"] is None
    assert outcome["digests"] != []
    if name in _SILENT:
        assert (outcome["warnings"], outcome["strict_error"]) == ([], None)
    else:
        assert outcome["strict_error"] == "BitstreamError"
        [warning] = outcome["warnings"]
        assert f"{len(outcome['digests'])} frames" in warning

    source = Path(bad["derived_from"])
    expected = expected_digests(_KIT / "expected" / f"{source.name.split('.')[0]}.npz")
    if "same_result_as" in bad:
        assert outcome["digests"] == [[i, value] for i, (_, value) in expected.items()]
        return
    intact = intact_units(_KIT / "bad" / name, _KIT / "streams" / source)
    before = [[i, value] for i, (unit, value) in expected.items() if unit < intact]
    assert before != []
    assert outcome["digests"][: len(before)] == before


def ivf(*units: bytes) -> bytes:
    """An IVF file that contains the temporal units."""
    header = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"AV01", 64, 64, 25, 1, len(units), 0)
    frames = (struct.pack("<IQ", len(unit), i) + unit for i, unit in enumerate(units))
    return header + b"".join(frames)


def obu(obu_type: int, payload: bytes) -> bytes:
    assert len(payload) < 128
    return bytes([obu_type << 3 | 2, len(payload)]) + payload


def bits(*fields: tuple[int, int]) -> bytes:
    """Header fields (width, value), then trailing bits: a one, and zeros to the next byte."""
    text = "".join(f"{value:0{width}b}" for width, value in fields if width) + "1"
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


def still_picture_sequence(width: int, height: int) -> bytes:
    """A sequence header with still_picture and a reduced header (5.5.1)."""
    return obu(
        1,
        bits(
            *((3, 0), (1, 1), (1, 1), (5, 0)),  # profile, still_picture, reduced, level
            *((4, 15), (4, 15), (16, width - 1), (16, height - 1)),
            *((1, 0),) * 6,  # 64x64 superblocks, no optional tools
            *((1, 0), (1, 0), (1, 0), (1, 0), (2, 0), (1, 0)),  # colors: 8 bit 4:2:0
            (1, 0),  # no film grain
        ),
    )


def still_picture(width: int, height: int, tile_data: bytes) -> bytes:
    """A temporal unit with a still picture."""
    # disable_cdf_update, allow_screen_content_tools, render_and_frame_size_different, then
    # uniform tile spacing without an increment; zeros are valid for all following fields.
    frame = bytes([0b00010000]) + bytes(11)
    return obu(2, b"") + still_picture_sequence(width, height) + obu(6, frame + tile_data)


@pytest.mark.parametrize(
    ("width", "height", "error"),
    [
        (65536, 65536, "LimitError"),
        (16385, 16384, "LimitError"),
        (16384, 16384, "BitstreamError"),
        (65536, 4096, "BitstreamError"),
        (4096, 65536, "BitstreamError"),
    ],
)
def test_declared_size_alone_costs_no_memory(
    width: int, height: int, error: str, tmp_path: Path
) -> None:
    small, large = tmp_path / "small.ivf", tmp_path / "large.ivf"
    small.write_bytes(ivf(still_picture(64, 64, b"\0")))
    large.write_bytes(ivf(still_picture(width, height, b"\0" * 40)))
    outcome = read_apart([small, large])["large.ivf"]
    assert outcome["error"] == error
    # The largest accepted size costs at most its unit grid, 8 bytes per unit.
    limit = 32 if error == "LimitError" else 32 + width * height / 16 * 8 / _MEGABYTE
    assert outcome["grown"] < limit * _MEGABYTE


def test_max_frame_size_is_the_limit() -> None:
    stream = _DATA / "aq1.ivf"
    first = next(read_motion(stream))
    samples = first.width * first.height
    next(read_motion(stream, ReadOptions(max_frame_size=samples)))
    with pytest.raises(LimitError, match="max_frame_size"):
        next(read_motion(stream, ReadOptions(max_frame_size=samples - 1)))


def test_frames_of_a_large_packet_are_parsed_one_at_a_time() -> None:
    # Otherwise a packet of a few kilobytes with many frames of one colour would need gigabytes.
    start = obu(2, b"") + still_picture_sequence(64, 64)
    frame = obu(3, bytes([0b00011000, 255, 0, 0, 0, 0x80])) + obu(4, b"\x07\x80")
    data = start + 3 * frame
    parser, position = _core.Parser(), 0
    for number in (1, 2, 3):
        event, position = parser.parse(data, position)
        assert event is not None
        assert position == len(start) + number * len(frame)


def test_tile_groups_after_a_damaged_one_do_not_complete_the_frame() -> None:
    # Two tiles of one superblock: a header with uniform spacing, one increment, base_q_idx 255.
    start = obu(2, b"") + still_picture_sequence(128, 64)
    start += obu(3, bytes([0b00011000, 255, 0, 0, 0, 0x80]))
    tile = b"\x07\x80"
    first, damaged, second = (
        obu(4, bytes([number]) + data)
        for number, data in (
            (0b10000000, tile),
            (0b10000000, tile + b"\x81" * 3),
            (0b11100000, tile),
        )
    )
    parser = _core.Parser()
    assert len(parse(parser, start + first + second)) == 1
    with pytest.raises(_core.BitstreamError):
        parse(parser, start + damaged)
    with pytest.raises(_core.BitstreamError, match="tile group"):
        parse(parser, second)
    assert len(parse(parser, start + first + second)) == 1


# --- tiles with trailing bits that violate the specification -----------------------------------


def last_obu_type(unit: bytes) -> int:
    """Type of the last OBU of a temporal unit; all OBUs must have a size."""
    position = last = 0
    while position < len(unit):
        last = (unit[position] >> 3) & 15
        position += 2 if unit[position] & 4 else 1
        size = shift = 0
        while True:
            byte = unit[position]
            position += 1
            size |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        position += size
    return last


def with_other_trailing_bits(path: Path, num: int, output: Path) -> int:
    """Write a stream with changed trailing bits in the first frames that end a temporal unit.

    Returns the number of changed frames.
    """
    data = bytearray(path.read_bytes())
    position, changed = 32, 0
    while position < len(data) and changed < num:
        (size,) = struct.unpack_from("<I", data, position)
        unit = data[position + 12 : position + 12 + size]
        position = end = position + 12 + size
        if last_obu_type(unit) == 6 and unit[-1]:  # OBU_FRAME ends with a tile
            # Bits 10...0 become 01...1. Encoders choose the largest value that gives the last
            # symbols, so the next smaller one gives the same symbols.
            data[end - 1] -= 1
            changed += 1
    output.write_bytes(data)
    return changed


def motion_of(path: Path, **options: Any) -> tuple[list[str], list[str]]:
    """Digests of the frames, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = [frame_digest(frame) for frame in read_motion(path, ReadOptions(**options))]
    return found, [str(w.message) for w in caught]


@pytest.mark.parametrize("num", [1, 99])
def test_wrong_trailing_bits_are_accepted_with_a_warning(tmp_path: Path, num: int) -> None:
    source, path = _DATA / "svt4_p6.ivf", tmp_path / "a.ivf"
    changed = with_other_trailing_bits(source, num, path)
    assert changed == 1 or 4 < changed < num
    wanted, no_warnings = motion_of(source)
    assert no_warnings == []
    for num_threads in (1, 4):
        found, warned = motion_of(path, num_threads=num_threads)
        assert found == wanted
        (line,) = warned
        assert f"{changed} of {len(wanted)} frames" in line
    with pytest.raises(BitstreamError, match="bits"):
        motion_of(path, strict=True)
    assert motion_of(source, strict=True) == (wanted, [])

    def pictures(video: Path) -> list[bytes]:
        return [image.tobytes() for _, image in decode_frames(video)]

    assert pictures(path) == pictures(source)


def test_tile_with_data_after_its_symbols_is_damaged() -> None:
    start = obu(2, b"") + still_picture_sequence(64, 64)
    frame = obu(3, bytes([0b00011000, 255, 0, 0, 0, 0x80]))
    for tile, wrong in (
        (b"\x07\x80", 0),
        (b"\x07\x80\0\0\0", 0),
        (b"\x07\x00", 1),
        (b"\x07\x81", 1),
    ):
        (event,) = parse(_core.Parser(), start + frame + obu(4, tile))
        assert event.num_wrong_trailing_bits == wrong
        if wrong:
            with pytest.raises(_core.BitstreamError, match="bits"):
                parse(_core.Parser(strict=True), start + frame + obu(4, tile))
    for end in (b"\x80\0\1", b"\x80\x80\x80", b"\0\0\0"):
        with pytest.raises(_core.BitstreamError, match="symbol"):
            parse(_core.Parser(), start + frame + obu(4, b"\x07" + end))


# --- any damage to a small stream -------------------------------------------------------------

_SMALL = [_DATA / name for name in ("svt4_p6.ivf", "gm_affine.ivf", "screen_444.ivf")]


def frames_before_error(path: Path) -> Iterator[FrameMotion]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield from read_motion(path, ReadOptions(num_threads=1))
    except ColmapAv1Error:
        return


def frame_digests(frames: Iterator[FrameMotion]) -> list[tuple[int, int, str]]:
    return [(f.header["temporal_unit"], f.decode_index, frame_digest(f)) for f in frames]


@pytest.fixture(scope="module")
def undamaged() -> dict[Path, list[tuple[int, int, str]]]:
    return {path: frame_digests(read_motion(path)) for path in _SMALL}


@st.composite
def damages(draw: st.DrawFn) -> tuple[Path, bytes, int]:
    """A stream, its damaged content, and the number of bytes before the damage."""
    path = draw(st.sampled_from(_SMALL))
    data = path.read_bytes()
    start = draw(st.integers(0, len(data) - 1))
    length = draw(st.integers(1, 200))
    kind = draw(st.sampled_from(["flip", "cut", "drop", "repeat", "random"]))
    if kind == "flip":
        flipped = data[start] ^ (1 << draw(st.integers(0, 7)))
        return path, data[:start] + bytes([flipped]) + data[start + 1 :], start
    if kind == "cut":
        return path, data[:start], start
    if kind == "drop":
        return path, data[:start] + data[start + length :], start
    if kind == "repeat":
        part = data[start : start + length]
        return path, data[: start + length] + part + data[start + length :], start + len(part)
    part = draw(st.binary(min_size=1, max_size=length))
    return path, data[:start] + part + data[start + len(part) :], start


def units_before(data: bytes, position: int) -> int:
    """Number of temporal units of an IVF file that end before or at a position."""
    count, at = 0, 32
    while at + 12 <= len(data):
        at += 12 + struct.unpack_from("<I", data, at)[0]
        if at > position:
            break
        count += 1
    return count


_SETTINGS = settings(
    max_examples=80,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@_SETTINGS
@given(damage=damages())
def test_frames_before_any_damage_are_read(
    damage: tuple[Path, bytes, int],
    undamaged: dict[Path, list[tuple[int, int, str]]],
    tmp_path: Path,
) -> None:
    source, data, position = damage
    file = tmp_path / "damaged.ivf"
    file.write_bytes(data)
    found = frame_digests(frames_before_error(file))
    if not found:
        return  # the demuxer looks at some packets before it gives the first
    intact = units_before(source.read_bytes(), position)
    before = [frame for frame in undamaged[source] if frame[0] < intact]
    assert found[: len(before)] == before


@_SETTINGS
@given(damage=damages())
def test_parser_recovers_after_any_damage(
    damage: tuple[Path, bytes, int], undamaged: dict[Path, list[tuple[int, int, str]]]
) -> None:
    source, data, position = damage
    whole = source.read_bytes()
    parser = _core.Parser()
    found: list[tuple[int, str]] = []
    failed_at = None
    # A temporal delimiter ends an incomplete frame with an error.
    delimiter = obu(2, b"")
    for index, unit in enumerate([*split_units(data), delimiter, *split_units(whole)]):
        at = 0
        try:
            while at < len(unit):
                event, at = parser.parse(unit, at)
                if event is not None and not event.header()["show_existing_frame"]:
                    blocks, block_index, _ = event.take_blocks()
                    units = blocks.view(BLOCK)[block_index]
                    found.append((index, digest({name: units[name] for name in _UNIT_FIELDS})))
        except (_core.BitstreamError, _core.LimitError):
            failed_at = index if failed_at is None else failed_at
    intact = units_before(whole, position)
    assert failed_at is None or failed_at >= intact
    expected = undamaged[source]
    assert [f for f in found if f[0] < intact] == [(u, d) for u, _, d in expected if u < intact]
    # The streams start with a key frame that resets the state, so the last reading is exact.
    assert [d for _, d in found[-len(expected) :]] == [d for _, _, d in expected]


def split_units(data: bytes) -> list[bytes]:
    units, at = [], 32
    while at + 12 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        units.append(data[at + 12 : at + 12 + size])
        at += 12 + size
    return units


def test_damage_before_the_first_frame_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "damaged.ivf"
    file.write_bytes(ivf(obu(2, b"") + obu(6, b"\0" * 20)))
    with pytest.raises((BitstreamError, ColmapAv1Error)):
        list(read_motion(file))


def blank_frame(units: tuple[int, int], width: int, height: int) -> FrameMotion:
    """A frame of inter blocks without motion; its size need not fit its units."""
    header = {
        "show_frame": 1,
        "frame_width": width,
        "force_integer_mv": 0,
        "gm_type": np.zeros(7, dtype=np.int32),
        "gm_params": np.zeros((7, 6), dtype=np.int32),
    }
    indices = np.full(8, -1, dtype=np.int32)
    return frame_of_blocks(
        blank_blocks(*units),
        decode_index=0,
        display_index=0,
        width=width,
        height=height,
        header=header,
        ref_decode_index=indices,
        ref_display_index=indices,
        ref_size=np.zeros((8, 2), dtype=np.int32),
        slot_decode_index=indices,
    )


@pytest.mark.parametrize("size", [2**31 - 1, 2**31 - 3, 65537, 0, -1])
def test_invalid_frame_sizes_are_refused(size: int) -> None:
    for frame in (blank_frame((2, 2), size, 8), blank_frame((2, 2), 8, size)):
        with pytest.raises(ValueError, match="1 to 65536"):
            frame.displacement(0)
        with pytest.raises(ValueError, match="1 to 65536"):
            build_tracks([frame])


@pytest.mark.parametrize("units", [(0, 0), (1, 2), (2, 1)])
def test_picture_larger_than_its_units_is_refused(units: tuple[int, int]) -> None:
    frame = blank_frame(units, 8, 8)
    with pytest.raises(ValueError, match="4x4"):
        frame.displacement(0)
    with pytest.raises(ValueError, match="4x4"):
        build_tracks([frame])
