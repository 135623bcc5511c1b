"""Comparison of the parser's values with the expected arrays of the conformance kit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from colmap_av1 import _core
from colmap_av1.motion.frame_motion import BLOCK
from colmap_av1.video.container import open_stream

_UNIT_FIELDS = (
    "mv",
    "ref_frame",
    "mi_size",
    "y_mode",
    "is_inter",
    "skip",
    "skip_mode",
    "segment_id",
    "motion_mode",
    "compound_type",
    "interintra",
    "use_intrabc",
)
_INTRA_FRAMES = (0, 2)

# Header fields that are defined only under a condition. Otherwise the kit contains the value that
# its decoder kept from an earlier frame.
_CONDITIONAL = {
    "skip_mode_frame": lambda h: h["skip_mode_present"],
    "delta_q_res": lambda h: h["delta_q_present"],
    "delta_lf_res": lambda h: h["delta_lf_present"],
    "interpolation_filter": lambda h: h["frame_type"] not in _INTRA_FRAMES,
    "is_motion_mode_switchable": lambda h: h["frame_type"] not in _INTRA_FRAMES,
    "tile_size_bytes": lambda h: h["tile_cols"] * h["tile_rows"] > 1,
}
# The kit stores the multiplier; the syntax element is its logarithm.
_MULTIPLIERS = ("delta_q_res", "delta_lf_res")


def parse(parser: _core.Parser, data: bytes | memoryview) -> list[_core.Event]:
    """Parse a temporal unit or a part of one; returns its events."""
    events: list[_core.Event] = []
    position = 0
    while position < len(data):
        event, position = parser.parse(data, position)
        if event is not None:
            events.append(event)
    return events


def read_events(stream: Path) -> tuple[list[Any], dict[str, int]]:
    """Events of a stream with their blocks, and the first sequence header."""
    parser = _core.Parser()
    events: list[Any] = []
    sequence = None
    with open_stream(stream) as opened:
        if opened.configuration:
            parser.parse(opened.configuration)
        for packet in opened.packets():
            events += parse(parser, packet.data)
            sequence = sequence or parser.sequence_header()
    parser.finish()
    assert sequence is not None
    return events, sequence


def differences(stream: Path, expected: Path, *, layout: bool = True) -> Iterator[str]:
    """Describe every field that differs.

    With layout=False, positions of OBUs in the file are not compared, because another container or
    a rewritten stream changes them.
    """
    events, sequence = read_events(stream)
    with np.load(expected) as arrays:
        want = dict(arrays)
    for name, value in zip(want["seq_names"], want["seq_values"], strict=True):
        if sequence[str(name)] != value:
            yield f"{name}: {sequence[str(name)]}, expected {value}"
    if len(events) != int(want["frames"]):
        yield f"{len(events)} events, expected {want['frames']}"
        return
    for index, event in enumerate(events):
        header = event.header()
        for difference in _header_differences(event, header, want, index, layout):
            yield f"event {index}: {difference}"
        if not header["show_existing_frame"]:
            for difference in _block_differences(event, header, want, index):
                yield f"event {index}: {difference}"


def _header_differences(
    event: Any, header: dict[str, Any], want: dict[str, Any], index: int, layout: bool
) -> Iterator[str]:
    for key, values in want.items():
        if not key.startswith("h_") or key == "h_unit_offset":
            continue
        name = key[2:]
        value = values[index]
        if np.all(value == -1) or (header["show_existing_frame"] and name not in header):
            continue
        if not layout and name in ("obu_offset", "temporal_unit"):
            continue
        if name in _CONDITIONAL and not _CONDITIONAL[name](header):
            continue
        got = event.ref_decode_index()[1:] if name == "ref_decode_index" else header[name]
        if name in _MULTIPLIERS:
            got = 1 << got
        if not np.array_equal(got, value):
            yield f"{name} is {got}, expected {value}"


def _block_differences(
    event: Any, header: dict[str, Any], want: dict[str, Any], index: int
) -> Iterator[str]:
    rows, cols = header["mi_rows"], header["mi_cols"]
    offset = int(want["h_unit_offset"][index])
    intra = header["frame_type"] in _INTRA_FRAMES
    data, block_index, local_warp_params = event.take_blocks()
    blocks = data.view(BLOCK)
    for name in _UNIT_FIELDS:
        got = blocks[name][block_index]
        value = want[f"u_{name}"][offset : offset + rows * cols].reshape(got.shape)
        if name == "skip_mode" and intra:
            # 5.11.7 sets skip_mode to 0 in intra frames. The kit's decoder keeps the value of the
            # last inter frame at the same position.
            value = np.zeros_like(value)
        if not np.array_equal(got, value):
            row, col = np.argwhere((got != value).reshape(rows, cols, -1).any(axis=2))[0]
            yield f"{name} at {row}, {col} is {got[row, col]}, expected {value[row, col]}"

    of_frame = want["b_frame"] == index
    if len(blocks) != np.count_nonzero(of_frame):
        yield f"{len(blocks)} blocks, expected {np.count_nonzero(of_frame)}"
        return
    compound = blocks["ref_frame"][:, 1] > 0
    renamed = {
        "row": blocks["mi_row"],
        "col": blocks["mi_col"],
        "palette_size_y": blocks["palette_size"][:, 0],
        "palette_size_uv": blocks["palette_size"][:, 1],
    }
    for key, values in want.items():
        if not key.startswith("b_") or key == "b_frame":
            continue
        name = key[2:]
        got = renamed[name] if name in renamed else blocks[name]
        value = values[of_frame].astype(np.int32)
        if name in ("comp_group_idx", "compound_idx"):
            got, value = got[compound], value[compound]
        if name == "delta_lf" and not header["delta_lf_present"]:
            continue
        if not np.array_equal(got, value):
            block = np.argwhere((got != value).reshape(len(got), -1).any(axis=1))[0, 0]
            yield f"block {block}: {name} is {got[block]}, expected {value[block]}"

    first = int(np.argmax(of_frame)) if of_frame.any() else 0
    warps = of_frame[want["w_block"]]
    warp_block = np.flatnonzero(blocks["local_warp"] >= 0)
    valid = blocks["warp_index"][warp_block] >= 0
    if not np.array_equal(warp_block, want["w_block"][warps] - first):
        yield "blocks with a local warp differ"
    elif not np.array_equal(valid, want["w_valid"][warps]):
        yield "LocalValid differs"
    else:
        params = local_warp_params[blocks["warp_index"][warp_block[valid]]]
        if not np.array_equal(params, want["w_params"][warps][valid]):
            yield "LocalWarpParams differ"
    if not np.array_equal(event.tile_sizes(), want["t_size"][want["t_frame"] == index]):
        yield "tile sizes differ"
