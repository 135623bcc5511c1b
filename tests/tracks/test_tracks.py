from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from block_data import blank_blocks, frame_of_blocks, units, with_units
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.errors import VideoError
from colmap_av1.motion.frame_motion import BLOCK, FrameMotion
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import TrackOptions
from colmap_av1.tracks.tracks import Tracks, build_tracks, build_tracks_and_ends
from colmap_av1.util.progress import no_progress

BLOCK_4X4, BLOCK_8X8, BLOCK_16X16, BLOCK_32X32, BLOCK_64X64 = 0, 3, 6, 9, 12
NEWMV, GLOBALMV = 16, 15
LOCALWARP = 2
LAST, GOLDEN, ALTREF = 1, 4, 7
ONE = 1 << 16
# No filter: every displacement is used.
OPEN = TrackOptions(
    cosine=None,
    max_interval=None,
    max_block_area=None,
    max_uncoded_block_area=None,
    smoothness=None,
    border=None,
    interpolation=None,
    bridge=None,
)
# The filters that do not depend on the size of the picture.
SMALL_PICTURES = TrackOptions(border=None)

# Motion of a list: (dx, dy) in px for all units, or an int16 array [rows, cols, 2] (row, col).
Motion = tuple[float, float] | NDArray[np.int16]


def frame(
    decode: int,
    display: int | None = None,
    refs: dict[int, tuple[int, int]] | None = None,
    motion: Sequence[tuple[int, Motion]] = (),
    *,
    width: int = 64,
    height: int = 48,
    ref_sizes: dict[int, tuple[int, int]] | None = None,
    slots: Iterable[int] | None = None,
    mi_size: int = BLOCK_4X4,
    shown: bool = True,
) -> FrameMotion:
    """A coded frame whose list l references motion[l][0] by motion[l][1].

    refs maps RefFrame to the (decode, display) index of the frame behind it. Slots hold
    this frame and its references unless given. Without motion, the frame is intra. A
    frame that is not shown at once (shown=False) waits for a later one's showing.
    """
    refs = refs or {}
    rows, cols = 2 * ((height + 7) // 8), 2 * ((width + 7) // 8)
    blocks = blank_blocks(rows, cols)
    blocks["mi_size"] = mi_size
    blocks["ref_frame"] = -1
    if motion:
        blocks["y_mode"] = NEWMV
        blocks["is_inter"] = 1
    else:
        blocks["ref_frame"][..., 0] = 0
    for index, (ref, vector) in enumerate(motion):
        blocks["ref_frame"][..., index] = ref
        if isinstance(vector, tuple):
            blocks["mv"][..., index, :] = round(8 * vector[1]), round(8 * vector[0])
        else:
            blocks["mv"][..., index, :] = vector
    ref_decode_index = np.full(8, -1, np.int32)
    ref_display_index = np.full(8, -1, np.int32)
    ref_size = np.zeros((8, 2), np.int32)
    for ref, (ref_decode, ref_display) in refs.items():
        ref_decode_index[ref] = ref_decode
        ref_display_index[ref] = ref_display
        ref_size[ref] = (ref_sizes or {}).get(ref, (width, height))
    kept = [decode, *(d for d, _ in refs.values())] if slots is None else list(slots)
    return frame_of_blocks(
        blocks,
        decode_index=decode,
        display_index=decode if display is None else display,
        width=width,
        height=height,
        header={
            "frame_width": width,
            "show_frame": int(shown),
            "force_integer_mv": 0,
            "gm_type": np.zeros(7, np.int32),
            "gm_params": np.tile(np.array([0, 0, ONE, 0, 0, ONE], np.int32), (7, 1)),
        },
        ref_decode_index=ref_decode_index,
        ref_display_index=ref_display_index,
        ref_size=ref_size,
        slot_decode_index=np.resize(np.array(kept, np.int32), 8),
    )


def low_delay(motions: Sequence[Motion], **keywords: Any) -> list[FrameMotion]:
    """A key frame, then a frame for each motion, which refers to the preceding frame."""
    frames = [frame(0, **keywords)]
    for i, vector in enumerate(motions, start=1):
        frames.append(frame(i, refs={LAST: (i - 1, i - 1)}, motion=[(LAST, vector)], **keywords))
    return frames


def displacement(motion: FrameMotion, list_index: int = 0) -> NDArray[np.float32]:
    return motion.displacement(list_index)


def split(tracks: Tracks) -> list[tuple[NDArray[np.int32], NDArray[np.float32]]]:
    return [
        (tracks.frame[a:b], tracks.xy[a:b])
        for a, b in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True)
    ]


def check_invariants(tracks: Tracks, min_length: int, cell: int = 4) -> None:
    lengths = tracks.lengths
    assert tracks.offsets[0] == 0
    assert tracks.offsets[-1] == tracks.num_observations == len(tracks.xy)
    assert len(tracks.sigma) == len(tracks.confirmed) == tracks.num_observations
    assert not tracks.confirmed.any()
    assert (lengths >= min_length).all()
    inside = np.ones(tracks.num_observations, bool)
    inside[tracks.offsets[:-1]] = False
    assert (np.diff(tracks.frame, prepend=-1)[inside] > 0).all()
    assert np.isfinite(tracks.sigma).all()
    assert (tracks.sigma[inside] > 0).all()
    assert (tracks.sigma >= 0).all()
    assert ((tracks.xy >= 0) & (tracks.xy < (tracks.width, tracks.height))).all()
    assert ((tracks.frame >= 0) & (tracks.frame < tracks.num_frames)).all()
    cells = np.column_stack([tracks.frame, np.floor(tracks.xy / cell).astype(np.int32)])
    assert len(np.unique(cells, axis=0)) == len(cells)


def warp_units(motion: FrameMotion, params: Sequence[int]) -> FrameMotion:
    """All units as LOCALWARP blocks of one model; the mv is nonsense."""
    warped = with_units(motion, motion_mode=LOCALWARP, mi_size=BLOCK_8X8, warp_index=0, mv=999)
    return replace(warped, local_warp_params=np.array([params], np.int32))


def similarity_params(angle: float, zoom: float, shift: tuple[float, float]) -> list[int]:
    """Warp parameters of p -> zoom R p + shift in corner-origin coordinates."""
    c, s = zoom * math.cos(angle), zoom * math.sin(angle)
    # In coordinates with the origin at the centre of the first pixel.
    tx = shift[0] + 0.5 * (c - s) - 0.5
    ty = shift[1] + 0.5 * (s + c) - 0.5
    return [round(v * ONE) for v in (tx, ty, c, -s, s, c)]


# displacement


def test_displacement_of_a_translation_is_the_vector() -> None:
    motion = frame(1, refs={LAST: (0, 0)}, motion=[(LAST, (1.375, -2.25))])
    assert (displacement(motion) == (1.375, -2.25)).all()
    assert np.isnan(displacement(motion, 1)).all()
    assert displacement(motion).dtype == np.float32


def test_displacement_of_intra_blocks_is_nan() -> None:
    motion = frame(0)
    assert np.isnan(displacement(motion)).all()
    assert np.isnan(displacement(with_units(motion, is_inter=1, use_intrabc=1))).all()


def test_displacement_of_a_warp_has_its_origin_at_the_pixel_corner() -> None:
    motion = frame(1, refs={LAST: (0, 0)}, motion=[(LAST, (0, 0))])
    params = similarity_params(0.02, 1.05, (3.0, -2.0))
    found = displacement(warp_units(motion, params))
    rows, cols = np.mgrid[0 : found.shape[0], 0 : found.shape[1]]
    x, y = 4.0 * cols + 2, 4.0 * rows + 2
    c, s = 1.05 * math.cos(0.02), 1.05 * math.sin(0.02)
    expected = np.stack([c * x - s * y + 3 - x, s * x + c * y - 2 - y], axis=-1)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def global_warp(block: int) -> FrameMotion:
    motion = frame(1, refs={LAST: (0, 0)}, motion=[(LAST, (1.0, 2.0))], mi_size=block)
    motion.header["gm_type"][0] = 2
    motion.header["gm_params"][0] = similarity_params(0.01, 1.01, (0.0, 0.0))
    return with_units(motion, y_mode=GLOBALMV)


def test_global_warp_applies_where_the_specification_says() -> None:
    def is_translation(motion: FrameMotion) -> bool:
        return bool((displacement(motion) == (1.0, 2.0)).all())

    warped = global_warp(BLOCK_8X8)
    assert not is_translation(warped)
    np.testing.assert_allclose(
        displacement(warped)[0, 0],
        np.array([[0.01, -0.0101], [0.0101, 0.01]]) @ (2, 2),
        atol=2e-3,
    )
    assert is_translation(global_warp(BLOCK_4X4))
    assert is_translation(with_units(warped, y_mode=NEWMV))
    assert is_translation(replace(warped, header=warped.header | {"force_integer_mv": 1}))
    scaled = warped.ref_size.copy()
    scaled[LAST] = 128, 96
    assert is_translation(replace(warped, ref_size=scaled))
    sheared = warped.header["gm_params"].copy()
    sheared[0, 3] = 10000  # 7 |beta| reaches 1: the shear is not valid (7.11.3.6)
    assert is_translation(replace(warped, header=warped.header | {"gm_params": sheared}))


def test_displacement_refuses_indices_outside_its_tables() -> None:
    motion = frame(1, refs={LAST: (0, 0)}, motion=[(LAST, (0, 0))])
    with pytest.raises(ValueError, match="warp_index"):
        displacement(with_units(motion, warp_index=3))
    with pytest.raises(ValueError, match="mi_size"):
        displacement(with_units(motion, mi_size=22))
    with pytest.raises(ValueError, match="ref_frame"):
        displacement(with_units(motion, ref_frame=8))
    for outside in (motion.block_index - 1, motion.block_index + 1):
        with pytest.raises(ValueError, match="block_index"):
            displacement(replace(motion, block_index=outside))


def test_arrays_may_have_any_memory_layout_but_not_another_type() -> None:
    motion = global_warp(BLOCK_8X8)
    laid_out = replace(
        motion,
        blocks=np.repeat(motion.blocks, 2)[::2],
        block_index=np.asfortranarray(motion.block_index),
    )
    assert not laid_out.blocks.flags.c_contiguous
    assert not laid_out.block_index.flags.c_contiguous
    assert (displacement(laid_out) == displacement(motion)).all()
    shifted = np.empty(motion.blocks.nbytes + 1, np.uint8)[1:].view(BLOCK)
    shifted[:] = motion.blocks
    with pytest.raises(ValueError, match="blocks"):
        displacement(replace(motion, blocks=shifted))
    for wrong in (motion.blocks["mv"], motion.blocks.tobytes()):
        with pytest.raises(TypeError, match="blocks"):
            displacement(replace(motion, blocks=wrong))
    with pytest.raises(TypeError, match="block_index"):
        displacement(replace(motion, block_index=motion.block_index[0]))
    with pytest.raises(TypeError, match="gm_type"):
        displacement(replace(motion, header=motion.header | {"gm_type": None}))
    with pytest.raises(TypeError, match="frame_width"):
        displacement(replace(motion, header=motion.header | {"frame_width": "wide"}))
    with pytest.raises(KeyError, match="force_integer_mv"):
        displacement(replace(motion, header={"show_frame": 1, "frame_width": 64}))


# chaining


@pytest.mark.parametrize("step", [(0.0, 0.0), (0.375, -0.625), (-5.125, 3.5), (4.0, 8.0)])
def test_constant_translation_adds_up_exactly(step: tuple[float, float]) -> None:
    tracks = build_tracks(low_delay([step] * 6), OPEN)
    check_invariants(tracks, 4)
    assert tracks.num_frames == 7
    for _, xy in split(tracks):
        np.testing.assert_array_equal(
            np.diff(xy, axis=0), np.full((len(xy) - 1, 2), -np.float32(step))
        )
    # All start at unit centres, and tracks of the first frame are lost only at the edge.
    starts = tracks.xy[tracks.offsets[:-1]]
    np.testing.assert_array_equal(starts % 4, 2)
    third = np.mgrid[2:64:4, 2:48:4].reshape(2, -1).T - 3 * np.array(step)
    staying = ((third >= 0) & (third < (64, 48))).all(axis=1).sum()
    assert (tracks.frame[tracks.offsets[:-1]] == 0).sum() == staying


def mv_of(flow: Callable[[Any, Any], tuple[Any, Any]], width: int, height: int) -> Motion:
    y, x = np.mgrid[2 : 8 * ((height + 7) // 8) : 4, 2 : 8 * ((width + 7) // 8) : 4]
    dx, dy = flow(x, y)
    return np.stack([np.rint(8 * dy), np.rint(8 * dx)], axis=-1).astype(np.int16)


@pytest.mark.parametrize(("angle", "zoom"), [(0.01, 1.0), (0.0, 1.02), (0.0, 0.98), (-0.02, 0.99)])
def test_rotation_and_zoom_stay_near_the_true_path(angle: float, zoom: float) -> None:
    width, height = 160, 120
    c, s = zoom * math.cos(angle), zoom * math.sin(angle)

    def back(x: Any, y: Any) -> tuple[Any, Any]:
        u, v = x - width / 2, y - height / 2
        return c * u - s * v + width / 2, s * u + c * v + height / 2

    def flow(x: Any, y: Any) -> tuple[Any, Any]:
        u, v = back(x, y)
        return u - x, v - y

    motion = mv_of(flow, width, height)
    tracks = build_tracks(low_delay([motion] * 8, width=width, height=height), SMALL_PICTURES)
    check_invariants(tracks, 4)
    assert tracks.num_tracks > 900
    errors = []
    for _, xy in split(tracks):
        truth = xy[-1].astype(float)
        for _ in range(len(xy) - 1):
            truth = np.array(back(*truth))
        errors.append(np.hypot(*(truth - xy[0])) / (len(xy) - 1))
    # Error per step: vectors are rounded to 1/8 px, and motion is constant within a unit.
    assert np.max(errors) < 0.15
    assert np.mean(errors) < 0.06


def test_warp_is_inverted_without_an_offset() -> None:
    params = similarity_params(0.03, 0.97, (1.5, 0.25))
    frames = low_delay([(0, 0)] * 4)
    frames[1:] = [warp_units(f, params) for f in frames[1:]]
    tracks = build_tracks(frames, SMALL_PICTURES)
    check_invariants(tracks, 4)
    assert tracks.num_tracks > 50
    matrix = np.array(params[2:], float).reshape(2, 2) / ONE
    shift = np.array(params[:2]) / ONE
    for _, xy in split(tracks):
        back = (xy[1:] - 0.5) @ matrix.T + shift + 0.5
        np.testing.assert_allclose(back, xy[:-1], atol=1e-4)


def hierarchy(step: Any, far: Any) -> list[FrameMotion]:
    """Five frames coded as 0 4 2 1 3; frame 4's vector is `far`, the others are true."""
    step = np.asarray(step)

    def node(decode: int, display: int, past: tuple[int, int], future: tuple[int, int]) -> Any:
        motion = [
            (ref, tuple((display - other[1]) * step))
            for ref, other in ((ALTREF, future), (LAST, past))
        ]
        refs = {LAST: past, ALTREF: future}
        return frame(decode, display, refs, motion, slots=[0, 1, 2, 3, 4], shown=display in (1, 3))

    return [
        frame(0, 0),
        frame(1, 4, {LAST: (0, 0)}, [(LAST, far)], slots=[0, 1], shown=False),
        node(2, 2, (0, 0), (1, 4)),
        node(3, 1, (0, 0), (2, 2)),
        node(4, 3, (2, 2), (1, 4)),
    ]


@pytest.mark.parametrize("far", [(5.0, -2.0), (-17.0, 3.0)])
def test_random_access_follows_short_steps_in_both_directions(far: tuple[float, float]) -> None:
    step = (1.25, -0.5)
    tracks = build_tracks(hierarchy(step, far), SMALL_PICTURES)
    check_invariants(tracks, 4)
    # Tracks that leave the picture use the far vector.
    ends = [(xy, xy[0] - 4 * np.float32(step)) for shown, xy in split(tracks) if len(shown) == 5]
    full = [xy for xy, end in ends if ((end >= 0) & (end < (64, 48))).all()]
    assert len(full) >= 14 * 10
    for xy in full:
        np.testing.assert_array_equal(np.diff(xy, axis=0), np.tile(-np.float32(step), (4, 1)))


def test_video_may_end_with_a_frame_coded_ahead() -> None:
    # The last frames are only shown by frame headers, which have no motion.
    tracks = build_tracks(
        hierarchy((0.0, 0.0), (0.0, 0.0))[:3], TrackOptions(min_length=3, border=None)
    )
    assert tracks.num_frames == 5
    assert tracks.num_tracks == 16 * 12
    np.testing.assert_array_equal(tracks.frame.reshape(-1, 3), [[0, 2, 4]] * (16 * 12))


def test_frames_out_of_order_are_refused() -> None:
    frames = low_delay([(0.0, 0.0)] * 3)
    with pytest.raises(ValueError, match="bitstream order"):
        build_tracks([frames[0], frames[2], frames[1]])
    with pytest.raises(ValueError, match="twice"):
        build_tracks([frames[0], frames[0]])


def test_steps_longer_than_the_limit_are_not_taken() -> None:
    frames = [frame(0), frame(1, 3, {LAST: (0, 0)}, [(LAST, (0.0, 0.0))])]

    def count(limit: int | None) -> int:
        options = TrackOptions(min_length=2, max_interval=limit, border=None)
        return build_tracks(frames, options).num_tracks

    assert count(3) == count(None) == 16 * 12
    assert count(2) == 0


@pytest.mark.parametrize("uncoded", [0, 1])
@pytest.mark.parametrize("step", [(0.0, 0.0), (0.75, -0.25)])
def test_largest_blocks_are_tracked_if_the_whole_frame_moves_alike(
    step: tuple[float, float], uncoded: int
) -> None:
    def count(elsewhere: int, detail: int = 4) -> int:
        """Number of tracks through five frames of 48 rows of units.

        The last `elsewhere` rows move differently, and the first `detail` rows have small blocks.
        """
        motion = np.zeros((48, 64, 2), np.int16)
        motion[...] = round(8 * step[1]), round(8 * step[0])
        motion[48 - elsewhere :] = 0, 40
        frames = low_delay([motion] * 5, width=256, height=192, mi_size=BLOCK_64X64)
        for one in frames:
            units(one)["skip"] = uncoded
            units(one)["mi_size"][:detail] = BLOCK_16X16
        return build_tracks(frames, replace(SMALL_PICTURES, smoothness=None)).num_tracks

    assert count(0) >= count(4) > 0.8 * 44 * 64
    assert count(6) <= 4 * 64
    # As in pictures of a single colour.
    assert count(0, detail=0) == 0


def test_largest_blocks_are_tracked_in_repeats_of_a_picture_with_detail() -> None:
    def count(intra_size: int, *, coded: bool = False) -> int:
        """Number of tracks through five frames that repeat a key frame with blocks of a size.

        If `coded`, the third frame has a residual.
        """
        still = np.zeros((48, 64, 2), np.int16)
        frames = low_delay([still] * 5, width=256, height=192, mi_size=BLOCK_64X64)
        for one in frames:
            units(one)["skip"] = 1
        units(frames[0])["mi_size"] = intra_size
        if coded:
            units(frames[2])["skip"] = 0
        return build_tracks(frames, SMALL_PICTURES).num_tracks

    assert count(BLOCK_16X16) > 0.8 * 48 * 64
    assert count(BLOCK_16X16, coded=True) == 0
    # As in a picture of a single colour.
    assert count(BLOCK_32X32) == count(BLOCK_64X64) == 0


def test_hidden_frames_continue_tracks_without_observations() -> None:
    step = (0.5, 0.25)
    frames = [
        frame(0, 0),
        frame(1, -1, {LAST: (0, 0)}, [(LAST, step)]),
        frame(2, 1, {LAST: (1, -1)}, [(LAST, step)]),
        frame(3, -1, {LAST: (2, 1)}, [(LAST, step)]),
        frame(4, 2, {LAST: (3, -1)}, [(LAST, step)]),
        frame(5, 3, {LAST: (4, 2)}, [(LAST, step)]),
    ]
    tracks = build_tracks(frames, SMALL_PICTURES)
    check_invariants(tracks, 4)
    assert tracks.num_frames == 4
    paths = split(tracks)
    assert len(paths) > 100
    for shown, xy in paths:
        np.testing.assert_array_equal(shown, [0, 1, 2, 3])
        np.testing.assert_array_equal(xy[0] - xy, np.outer([0, 2, 4, 5], step))


def test_frame_that_a_later_header_shows_is_chained_when_it_leaves_its_slot() -> None:
    # No frame has show_frame. The second frame is in no slot after the third, so it has been shown.
    builder = _core.TrackBuilder(_core.TrackBuilderOptions())
    for number, display, slots in ((0, 0, [0]), (1, 2, [0, 1]), (2, 3, [0, 2])):
        builder.add(frame(number, display, slots=slots, shown=False))
    with pytest.raises(ValueError, match="order"):
        builder.add(frame(3, 1, slots=[0, 2, 3], shown=False))
    builder.add(frame(4, 4, slots=[0, 2, 4], shown=False))


def test_second_list_is_used_if_the_first_finds_no_track() -> None:
    # The nearer reference is in a slot that was never coded here.
    frames = low_delay([(1.0, 0.0)] * 3)
    frames.append(
        frame(
            9,
            9,
            {LAST: (8, 8), GOLDEN: (3, 3)},
            [(LAST, (5.0, 5.0)), (GOLDEN, (1.0, 0.0))],
            slots=[9],
        )
    )
    tracks = build_tracks(frames, replace(OPEN, min_length=5))
    assert tracks.num_tracks > 50
    for shown, xy in split(tracks):
        np.testing.assert_array_equal(shown, [0, 1, 2, 3, 9])
        np.testing.assert_array_equal(np.diff(xy, axis=0), [[-1, 0]] * 4)


def test_intra_blocks_end_tracks_and_seed_new_ones() -> None:
    frames = low_delay([(0.0, 0.0)] * 8)
    hole = units(frames[4])[2:6, 3:7]
    hole["ref_frame"] = (0, -1)
    hole["is_inter"] = 0
    hole["mv"] = 0
    tracks = build_tracks(frames, replace(SMALL_PICTURES, bridge=None))
    check_invariants(tracks, 4)
    counts = {}
    for shown, xy in split(tracks):
        inside = 12 <= xy[0, 0] < 28 and 8 <= xy[0, 1] < 24
        counts[inside, int(shown[0]), int(shown[-1])] = (
            counts.get((inside, int(shown[0]), int(shown[-1])), 0) + 1
        )
    assert counts == {(False, 0, 8): 16 * 12 - 16, (True, 0, 3): 16, (True, 4, 8): 16}


@pytest.mark.parametrize(("jump", "goes_on"), [(0.0, True), (1.5, True), (3.0, False)])
def test_tracks_cross_intra_blocks_if_both_sides_move_alike(jump: float, goes_on: bool) -> None:
    mv = np.zeros((12, 16, 2), np.int16)
    mv[:, 7:, 1] = round(8 * jump)
    frames = low_delay([(0.0, 0.0)] * 3 + [mv] + [(0.0, 0.0)] * 4)
    hole = units(frames[4])[:, 3:7]
    hole["ref_frame"] = (0, -1)
    hole["is_inter"] = 0
    tracks = build_tracks(frames, replace(OPEN, min_length=1, bridge=2.0))
    check_invariants(tracks, 1)
    whole = [xy for shown, xy in split(tracks) if len(shown) == 9 and 12 <= xy[0, 0] < 28]
    assert (len(whole) == 4 * 12) == goes_on
    assert (len(whole) == 0) == (not goes_on)
    for xy in whole:
        # Motion is interpolated between the left and the right side by distance.
        share = ((xy[0, 0] - 2) / 4 - 2) / 5
        np.testing.assert_allclose(xy[3, 0] - xy[4, 0], share * jump, atol=1e-5)
        np.testing.assert_array_equal(xy[:, 1], xy[0, 1])
    # They have a larger sigma than neighbours with motion of their own.
    if jump and goes_on:
        bridged = tracks.sigma[tracks.frame == 4].reshape(12, 16)
        assert (bridged[:, 3:7] > bridged[:, :3].max()).all()


def test_tracks_between_diverging_blocks_continue() -> None:
    # Tracks of columns 0 to 8 move to half a pixel from the left edges of their units.
    shift = np.zeros((12, 16, 2), np.int16)
    shift[:, :9, 1] = round(8 * 1.5)
    # Then the right half refers to a pixel further right, and no vector points to x = 32.5.
    apart = np.zeros((12, 16, 2), np.int16)
    apart[:, 8:, 1] = 8
    frames = low_delay([shift, apart])

    def carried(bridge: float | None) -> int:
        tracks = build_tracks(frames, replace(OPEN, min_length=2, bridge=bridge))
        check_invariants(tracks, 2)
        paths = [xy for shown, xy in split(tracks) if shown[-1] == 2 and xy[-2, 0] == 32.5]
        assert all(len(xy) == 3 and xy[-1, 0] == 32.5 for xy in paths)
        return len(paths)

    assert (carried(None), carried(0.5), carried(2.0)) == (0, 0, 12)


@pytest.mark.parametrize(
    ("cell", "going_on"),
    [(4, [[6.0, 5.5, 5.5, 3.5]]), (2, [[6.0, 5.5, 5.5, 3.5], [2.0, 3.5, 1.5]])],
)
def test_longer_of_two_tracks_in_a_cell_continues(cell: int, going_on: list[list[float]]) -> None:
    # Column 0 seeds tracks in frame 1 that move to x = 3.5; those of column 1 start in frame 0 and
    # are at 5.5. In frame 3 one unit refers to both; the younger one is nearer to its centre.
    steps = np.zeros((3, 12, 16, 2), np.int16)
    steps[0, :, 1, 1] = round(8 * 0.5)
    steps[1, :, 0, 1] = round(8 * -1.5)
    steps[2, :, 0, 1] = 8 * 2
    frames = low_delay(list(steps))
    for index, col in ((1, 0), (3, 1)):
        units(frames[index])["ref_frame"][:, col] = (0, -1)
        units(frames[index])["is_inter"][:, col] = 0
    tracks = build_tracks(frames, replace(OPEN, min_length=2, cell=cell))
    check_invariants(tracks, 2, cell)
    paths = [xy[:, 0].tolist() for shown, xy in split(tracks) if shown[-1] == 3 and xy[-1, 0] < 4]
    assert sorted(paths) == sorted(going_on * 12)


def test_cell_is_at_most_the_seeding_distance() -> None:
    frames = low_delay([(0.25, 0.5)] * 4)
    fine = build_tracks(frames, replace(OPEN, seeding=2))
    assert fine.xy.tobytes() == build_tracks(frames, replace(OPEN, seeding=2, cell=2)).xy.tobytes()
    assert fine.num_tracks > 3 * build_tracks(frames, OPEN).num_tracks


@pytest.mark.parametrize(
    ("cell", "seeding"), [(4, 8), (1, 8), (4, 4), (2, 4), (1, 4), (2, 2), (1, 2), (1, 1)]
)
def test_a_track_starts_in_every_empty_square(cell: int, seeding: int) -> None:
    steps = [(1.0, 0.5)] * 3
    options = replace(OPEN, min_length=1, cell=cell, seeding=seeding)
    tracks = build_tracks(low_delay(steps), options)
    check_invariants(tracks, 1, cell)
    first = tracks.xy[tracks.offsets[:-1]]
    at_once = tracks.frame[tracks.offsets[:-1]] == 0
    assert at_once.sum() == 64 * 48 // seeding**2
    assert (first % seeding == seeding / 2).all()
    # Motion to the left and up uncovers squares at the right and below.
    assert (first[~at_once] >= np.array([64, 48]) - 3 * seeding).any(axis=1).all()
    for shown, xy in split(tracks):
        assert np.array_equal(xy, xy[0] - np.outer(shown - shown[0], steps[0]))
    # In every frame, nearly every square has a track.
    assert np.bincount(tracks.frame).min() >= 60 * 46 // seeding**2


def test_track_continues_in_the_best_matching_unit_only() -> None:
    # Both columns of units refer to column 0 of the reference; the vector of the second one
    # points 1 px away from its centre.
    mv = np.zeros((12, 16, 2), np.int16)
    mv[:, 1, 1] = 8 * -5
    frames = low_delay([(0.0, 0.0), mv, (0.0, 0.0), (0.0, 0.0)])
    tracks = build_tracks(frames, replace(OPEN, min_length=3))
    check_invariants(tracks, 3)
    for shown, xy in split(tracks):
        if xy[0, 0] == 2:
            assert len(shown) == 5
            assert (xy[:, 0] == 2).all()
        if 4 <= xy[0, 0] < 8:
            assert shown[0] == 2


def test_a_reference_of_another_size_is_scaled() -> None:
    small, large = (64, 48), (128, 96)
    step = (1.0, 0.5)  # px of the small frame
    frames = [
        frame(0, width=128, height=96),
        frame(1, refs={LAST: (0, 0)}, motion=[(LAST, step)], ref_sizes={LAST: large}),
        frame(2, refs={LAST: (1, 1)}, motion=[(LAST, step)]),
        frame(
            3,
            refs={LAST: (2, 2)},
            motion=[(LAST, (2.0, 1.0))],
            width=128,
            height=96,
            ref_sizes={LAST: small},
        ),
    ]
    tracks = build_tracks(frames, SMALL_PICTURES)
    check_invariants(tracks, 4)
    assert (tracks.width, tracks.height) == large
    paths = split(tracks)
    assert len(paths) > 100
    for _, xy in paths:
        np.testing.assert_allclose(np.diff(xy, axis=0), [[-2, -1]] * 3, atol=1e-5)


def test_super_resolution_positions_are_in_the_upscaled_picture() -> None:
    # FrameWidth 32, UpscaledWidth 64: a coded pixel is two pixels wide.
    def half(motion: FrameMotion) -> FrameMotion:
        return replace(motion, width=64, header=motion.header | {"frame_width": 32})

    upscaled = {LAST: (64, 48)}
    frames = [half(frame(0, width=32))]
    frames += [
        half(
            frame(
                i,
                refs={LAST: (i - 1, i - 1)},
                motion=[(LAST, (0.5, 1.0))],
                width=32,
                ref_sizes=upscaled,
            )
        )
        for i in range(1, 5)
    ]
    tracks = build_tracks(frames, SMALL_PICTURES)
    assert tracks.width == 64
    paths = split(tracks)
    assert len(paths) > 30
    for _, xy in paths:
        np.testing.assert_allclose(np.diff(xy, axis=0), [[-1, -1]] * (len(xy) - 1), atol=1e-5)
    assert tracks.xy[:, 0].max() > 56


def test_tracks_below_the_minimum_length_are_left_out() -> None:
    frames = low_delay([(0.0, 0.0)] * 3)
    assert build_tracks(frames, TrackOptions(min_length=5, border=None)).num_tracks == 0
    assert build_tracks(frames, TrackOptions(min_length=4, border=None)).num_tracks == 16 * 12
    empty = build_tracks(frames, TrackOptions(min_length=5, border=None))
    assert empty.frame.shape == (0,)
    assert empty.xy.shape == (0, 2)
    assert build_tracks(frames[:3], TrackOptions(border=None)).num_tracks == 0
    short = build_tracks(frames[:3], TrackOptions(min_length=3, border=None))
    assert short.num_tracks == 16 * 12


def test_long_tracks_are_kept() -> None:
    frames = low_delay([(3.0, 0.0)] * 7)
    tracks = build_tracks(frames, TrackOptions(min_length=1, border=None))
    assert set(tracks.lengths) > {1, 2, 8}
    longer = build_tracks(frames, TrackOptions(min_length=4, border=None))
    for kept in (tracks.keep_long(4), tracks.keep_lasting(4)):
        for name in ("offsets", "frame", "xy", "sigma"):
            assert np.array_equal(getattr(kept, name), getattr(longer, name))


def test_tracks_last_even_if_few_frames_are_kept() -> None:
    tracks = build_tracks(low_delay([(3.0, 0.0)] * 7), TrackOptions(min_length=1, border=None))
    ends = tracks.keep_frames(np.array([0, 3], np.int32))
    assert ends.keep_lasting(4).num_tracks == np.count_nonzero(ends.lengths == 2) > 0
    assert ends.keep_lasting(5).num_tracks == 0


# trust


def test_large_and_uncoded_blocks_are_not_tracked() -> None:
    # Every second row moves against the others, so there is no common motion.
    there = np.zeros((12, 16, 2), np.int16)
    there[::2], there[1::2] = (0, 4), (0, -4)
    frames = low_delay([there, -there] * 2, mi_size=BLOCK_16X16)
    for f in frames:
        units(f)["mi_size"][:, 8:] = BLOCK_32X32
        units(f)["skip"][:4] = 1

    def kept(**options: Any) -> NDArray[np.bool_]:
        tracks = build_tracks(frames, replace(OPEN, **options))
        seen = np.zeros((12, 16), bool)
        col, row = (tracks.xy // 4).astype(int).T
        seen[row, col] = True
        return seen

    assert kept().all()
    small = kept(max_block_area=256)
    assert small[:, :8].all()
    assert not small[:, 8:].any()
    coded = kept(max_uncoded_block_area=256)
    assert coded[4:].all()
    assert coded[:4, :8].all()
    assert not coded[:4, 8:].any()


def test_smoothness_rejects_a_block_that_disagrees() -> None:
    frames = low_delay([(0.0, 0.0)] * 4, mi_size=BLOCK_8X8)
    for f in frames[1:]:
        units(f)["mv"][4:6, 6:8, 0, :] = 24
    tracks = build_tracks(frames, replace(OPEN, smoothness=0.5))
    seen = np.zeros((12, 16), bool)
    col, row = (tracks.xy // 4).astype(int).T
    seen[row, col] = True
    assert not seen[4:6, 6:8].any()
    assert seen.sum() == 12 * 16 - 4


def test_motion_at_the_edge_is_not_tracked() -> None:
    frames = low_delay([(0.0, 0.0)] * 5)
    tracks = build_tracks(frames, replace(OPEN, border=8.0))
    assert tracks.xy.min() >= 8
    assert np.all(tracks.xy <= np.array([tracks.width, tracks.height]) - 8)
    assert tracks.num_tracks == (16 - 4) * (12 - 4)


def block_field(slope: float, jump: float = 0.0) -> list[FrameMotion]:
    """16x16 blocks whose vectors are those of a linear field at their centres."""
    x = np.tile(np.arange(2, 160, 4), (32, 1))
    dx = slope * (x // 16 * 16 + 8) + np.where(x >= 80, jump, 0.0)
    field = np.stack([np.zeros_like(dx), np.rint(8 * dx)], axis=-1).astype(np.int16)
    return low_delay([field] * 4, width=160, height=128, mi_size=BLOCK_16X16)


def first_steps(tracks: Tracks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions at the start of the motion of the second frame, and the displacements there."""
    start = tracks.offsets[:-1][tracks.frame[tracks.offsets[:-1]] == 0]
    step = tracks.xy[start] - tracks.xy[start + 1]
    return tracks.xy[start + 1, 0].astype(float), step[:, 0].astype(float)


def test_interpolation_lets_motion_vary_within_a_block() -> None:
    frames = block_field(1 / 16)

    def errors(interpolation: float | None) -> Any:
        options = replace(OPEN, interpolation=interpolation)
        x, dx = first_steps(build_tracks(frames, options))
        inner = (x > 8) & (x < 152)
        assert inner.sum() > 500
        return np.abs(dx - x / 16)[inner]

    assert np.max(errors(1.5)) < 0.15
    assert np.max(errors(None)) > 0.4
    # Blocks whose motion differs by a pixel are not interpolated.
    np.testing.assert_array_equal(errors(0.5), errors(None))


def test_interpolation_preserves_motion_edges() -> None:
    x, dx = first_steps(build_tracks(block_field(1 / 32, 4.0), replace(OPEN, interpolation=1.5)))
    left = (x > 8) & (x < 70)
    right = (x > 90) & (x < 150)
    for side, jump in ((left, 0.0), (right, 4.0)):
        np.testing.assert_allclose(dx[side], x[side] / 32 + jump, atol=0.3)


def test_sigma_depends_on_the_bitstream() -> None:
    def last_sigma(**changes: Any) -> float:
        frames = low_delay([(1.0, 0.5)] * 4, width=160, height=128, mi_size=BLOCK_16X16)
        tracks = build_tracks([with_units(f, **changes) for f in frames], OPEN)
        return float(np.median(tracks.sigma[tracks.offsets[1:] - 1]))

    plain = last_sigma()
    assert last_sigma(skip=1) > plain
    assert last_sigma(y_mode=GLOBALMV) > plain
    assert last_sigma(mi_size=BLOCK_8X8) < plain < last_sigma(mi_size=BLOCK_32X32)
    # Blocks with incoherent motion have a larger sigma than blocks that move alike.
    rng = np.random.default_rng(0)
    rough = rng.integers(-16, 17, (8, 10, 2)).repeat(4, axis=0).repeat(4, axis=1)
    frames = low_delay([rough.astype(np.int16)] * 4, width=160, height=128, mi_size=BLOCK_16X16)
    disorder = build_tracks(frames, replace(OPEN, min_length=2))
    steady = build_tracks(
        low_delay([(1.0, 0.5)] * 4, width=160, height=128, mi_size=BLOCK_16X16),
        replace(OPEN, min_length=2),
    )
    second = [float(np.median(t.sigma[t.offsets[:-1] + 1])) for t in (steady, disorder)]
    assert second[1] > 2 * second[0]


def shaking(seed: int = 0, frames: int = 20) -> list[FrameMotion]:
    """A camera that moves steadily and shakes by several pixels per frame."""
    rng = np.random.default_rng(seed)
    shake = np.rint(8 * rng.normal(0, 4, (frames, 2))) / 8
    return low_delay([tuple(s) for s in shake], width=160, height=120)


def test_cosine_relative_to_the_dominant_motion_survives_shaking() -> None:
    def count(relative_to: Any, cosine: float | None = 0.9) -> int:
        options = replace(OPEN, min_length=8, cosine=cosine, cosine_relative_to=relative_to)
        return build_tracks(shaking(), options).num_tracks

    free = count("none", None)
    assert free > 500
    assert count("dominant") == free
    assert count("none") == 0


def test_cosine_ends_a_track_that_moves_against_its_surroundings() -> None:
    frames = shaking()
    corner = (slice(8, 16), slice(8, 16))
    for i, f in enumerate(frames[1:]):
        # Moves back and forth by 3 px relative to the rest.
        units(f)["mv"][(*corner, 0)] += np.array([0, 24 if i % 2 else -24], np.int16)
    strict = build_tracks(frames, replace(OPEN, cosine=0.9))
    free = build_tracks(frames, OPEN)

    def steps_in_corner(tracks: Tracks) -> int:
        return sum(
            int(((xy[1:] >= 33) & (xy[1:] < 63)).all(axis=1).sum()) for _, xy in split(tracks)
        )

    assert steps_in_corner(free) > 100
    assert steps_in_corner(strict) < 0.2 * steps_in_corner(free)
    assert strict.num_tracks > 0.8 * free.num_tracks


# real streams


@pytest.mark.shared
@pytest.mark.parametrize("name", ["good_lag0", "good_cpu4_lag35", "svt4_p6", "gm_affine_scene"])
def test_tracks_follow_the_decoded_pictures(shared: Path, name: str) -> None:
    stream = shared / "conformance" / "streams" / f"{name}.ivf"
    tracks = build_tracks(read_motion(stream), SMALL_PICTURES)
    check_invariants(tracks, 4)
    with av.open(str(stream)) as container:
        images = [f.to_ndarray(format="gray") for f in container.decode(video=0)]
    assert tracks.num_frames == len(images)

    ends = np.arange(1, tracks.num_observations)
    ends = ends[tracks.frame[1:] > tracks.frame[:-1]]
    ends = ends[~np.isin(ends, tracks.offsets)]
    ends = np.random.default_rng(0).choice(ends, 2000, replace=False)

    def patches(frames: Any, xy: Any) -> Any:
        return np.stack(
            [
                cv2.getRectSubPix(images[f].astype(np.float32), (9, 9), (float(x), float(y)))
                for f, (x, y) in zip(frames, xy - np.float32(0.5), strict=True)
            ]
        )

    before = patches(tracks.frame[ends - 1], tracks.xy[ends - 1])

    def difference(shift: tuple[float, float]) -> float:
        after = patches(tracks.frame[ends], tracks.xy[ends] + np.float32(shift))
        return float(np.median(np.abs(after - before).mean(axis=(1, 2))))

    followed = difference((0.0, 0.0))
    for shift in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
        assert followed < 0.9 * difference(shift)


# any input


@st.composite
def random_video(draw: st.DrawFn) -> list[FrameMotion]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    width, height = draw(st.sampled_from([(8, 8), (37, 21), (64, 48), (130, 18)]))
    count = draw(st.integers(1, 9))
    spread = draw(st.sampled_from([0, 4, 24, 300]))
    frames: list[FrameMotion] = []
    # Each frame is shown at once, by a later header, or never.
    shown = [-1] * count
    at_once = rng.random(count) < 0.6
    waiting: list[int] = []
    waiting_after: list[list[int]] = []
    order: list[int] = []
    for i in range(count):
        if waiting and rng.random() < 0.4:
            order.append(waiting.pop(rng.integers(len(waiting))))
        at_once[i] |= len(waiting) > 4
        (order if at_once[i] else waiting).append(i)
        waiting_after.append(list(waiting))
    for i, index in enumerate(order):
        shown[index] = i
    slots = np.full(8, -1)
    for i in range(count):
        past = {
            ref: (int(slot), shown[slot])
            for ref, slot in enumerate(slots[1:], start=1)
            if slot >= 0
        }
        base = frame(i, shown[i], past, width=width, height=height, shown=bool(at_once[i]))
        shape = base.block_index.shape
        if past:
            refs = np.array(sorted(past), np.int8)
            blocks = units(base)
            blocks["ref_frame"][..., 0] = rng.choice(refs, shape)
            blocks["ref_frame"][..., 1] = rng.choice(np.append(refs, np.int8([-1, 0])), shape)
            blocks["is_inter"][:] = rng.random(shape) < 0.95
            blocks["mv"][:] = rng.integers(-spread, spread + 1, blocks["mv"].shape)
            blocks["mi_size"][:] = rng.integers(0, 22, shape)
            blocks["y_mode"][:] = rng.integers(13, 25, shape)
            blocks["skip"][:] = rng.integers(0, 2, shape)
            blocks["motion_mode"][:] = rng.integers(0, 3, shape)
            base.header["gm_type"][:] = rng.integers(0, 4, 7)
            base.header["gm_params"][:] += rng.integers(-2000, 2000, (7, 6), np.int32)
            params = np.array([[0, 0, ONE, 0, 0, ONE]], np.int32)
            blocks["warp_index"] = rng.integers(-1, 1, shape, np.int32)
            base = replace(
                base, local_warp_params=params + rng.integers(-3000, 3000, (1, 6), np.int32)
            )
        # A frame stays in a reference slot until it is shown.
        free = np.flatnonzero(~np.isin(slots, waiting_after[i]))
        slots[free[:1] if i in waiting_after[i] else free[rng.random(len(free)) < 0.4]] = i
        frames.append(replace(base, slot_decode_index=slots.astype(np.int32)))
    return frames


any_options = st.builds(
    TrackOptions,
    min_length=st.integers(1, 4),
    cosine=st.sampled_from([None, 0.5, 0.95]),
    cosine_relative_to=st.sampled_from(["dominant", "none"]),
    max_interval=st.sampled_from([None, 1, 4]),
    bridge=st.sampled_from([None, 2.0]),
    max_block_area=st.sampled_from([None, 1024]),
    max_uncoded_block_area=st.sampled_from([None, 256]),
    smoothness=st.sampled_from([None, 1.5]),
    border=st.sampled_from([None, 6.0]),
    interpolation=st.sampled_from([None, 1.5]),
    cell=st.sampled_from([None, 4, 2, 1]),
)


@given(motion=random_video(), options=any_options)
@settings(max_examples=200, deadline=None)
def test_any_motion_gives_valid_tracks(motion: list[FrameMotion], options: TrackOptions) -> None:
    if all(f.display_index < 0 for f in motion):
        with pytest.raises(VideoError):
            build_tracks(motion, options)
        return
    tracks = build_tracks(motion, options)
    check_invariants(tracks, options.min_length, options.cell or 4)
    again = build_tracks(iter(motion), options)
    for name in ("offsets", "frame", "xy", "sigma", "confirmed"):
        assert getattr(tracks, name).tobytes() == getattr(again, name).tobytes()


@given(motion=random_video(), options=any_options, every=st.integers(1, 4))
@settings(max_examples=100, deadline=None)
def test_observations_in_selected_frames_are_a_subset(
    motion: list[FrameMotion], options: TrackOptions, every: int
) -> None:
    if all(f.display_index < 0 for f in motion):
        return
    frames = np.arange(1, len(motion) + 3, every, dtype=np.int32)
    tracks = build_tracks(motion, options)
    seen = tracks.keep_frames(frames[frames < tracks.num_frames]).keep_long(2)
    some, _ = build_tracks_and_ends(motion, options, no_progress, frames=frames)
    assert some.num_frames == tracks.num_frames
    for name in ("offsets", "frame", "xy", "sigma", "confirmed"):
        assert getattr(some, name).tobytes() == getattr(seen, name).tobytes()


@given(motion=random_video(), options=any_options, of=st.integers(1, 3))
@settings(max_examples=100, deadline=None)
def test_ends_are_those_in_all_frames(
    motion: list[FrameMotion], options: TrackOptions, of: int
) -> None:
    if all(f.display_index < 0 for f in motion):
        return
    tracks = build_tracks(motion, options)
    one = np.array([0], np.int32)
    _, ends = build_tracks_and_ends(motion, options, no_progress, frames=one, tracks_per_sample=of)
    assert ends.num_frames == tracks.num_frames

    def first_and_last(tracks: Tracks) -> set[tuple[float, ...]]:
        first, last = tracks.offsets[:-1], tracks.offsets[1:] - 1
        xy, frame = tracks.xy, tracks.frame
        both = np.column_stack([frame[first], xy[first], frame[last], xy[last]])
        return set(map(tuple, both.tolist()))

    assert first_and_last(ends) <= first_and_last(tracks)
    assert of > 1 or ends.num_tracks == tracks.num_tracks


def test_kept_frames_are_renumbered() -> None:
    tracks = build_tracks(low_delay([(1.0, 0.0)] * 8), OPEN)
    alone = tracks.subsample_frames(np.array([1, 4, 7], dtype=np.int32))
    assert alone.num_frames == 3
    lasting = np.flatnonzero(alone.lengths == 3)[0]
    own = slice(*alone.offsets[lasting : lasting + 2])
    assert alone.frame[own].tolist() == [0, 1, 2]
    np.testing.assert_allclose(np.diff(alone.xy[own], axis=0), [[-3, 0]] * 2, atol=1e-5)


def test_progress_counts_coded_frames() -> None:
    seen: list[int] = []
    build_tracks(low_delay([(0.0, 0.0)] * 3), progress=lambda _, number, total: seen.append(number))
    assert seen == [1, 2, 3, 4]


def test_no_shown_frame_is_an_error() -> None:
    with pytest.raises(VideoError, match="no frame"):
        build_tracks([])


@given(
    lengths=st.lists(st.integers(1, 40), max_size=8),
    most=st.integers(1, 12),
)
@settings(deadline=None)
def test_splitting_tracks_keeps_all_observations(lengths: list[int], most: int) -> None:
    total = sum(lengths)
    whole = replace(
        Tracks.empty(40, (64, 64)),
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        frame=np.concatenate([np.empty(0), *(np.arange(n) for n in lengths)]).astype(np.int32),
        xy=np.arange(2.0 * total, dtype=np.float32).reshape(-1, 2),
        sigma=np.zeros(total, np.float32),
        confirmed=np.ones(total, np.bool_),
    )
    short = whole.split_to_length(most)
    assert np.isin(whole.offsets, short.offsets).all()
    assert short.offsets[-1] == total
    assert (short.lengths >= 1).all()
    assert (short.lengths <= most).all()
    assert short.num_tracks <= sum(math.ceil(n / most) for n in lengths)
    np.testing.assert_array_equal(short.xy, whole.xy)
