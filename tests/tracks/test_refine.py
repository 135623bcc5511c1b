from __future__ import annotations

import cv2
import numpy as np
import pytest
import render_scene
from conftest import PROJECT
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.motion.reading import read_motion
from colmap_av1.options import RefineOptions
from colmap_av1.tracks.refine import refine_spread_tracks, refine_tracks
from colmap_av1.tracks.texture import texture_at, texture_of
from colmap_av1.tracks.tracks import Tracks, build_tracks
from colmap_av1.video.decoding import decode_frames

WIDTH, HEIGHT, FRAMES = 320, 240, 12
LK = RefineOptions(refine="lk")
STEP = np.array([1.3, -0.45])
FLAT = 80  # columns on the left without texture
EXAMPLES = PROJECT / "examples"
EXAMPLE = EXAMPLES / "scene.mp4"


def texture(size: int, seed: int = 0) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed).normal(size=(size, size)).astype(np.float32)
    return np.asarray(128 + 160 * cv2.GaussianBlur(noise, (0, 0), 1.6), np.float32)


def pictures(noise: float = 1.0) -> list[tuple[int, NDArray[np.uint8]]]:
    """A textured plane that moves by STEP per frame, and a flat strip that does not move."""
    rng = np.random.default_rng(1)
    plane = texture(512)
    frames = []
    for index in range(FRAMES):
        centre = (256.0, 256.0) - index * STEP
        patch = cv2.getRectSubPix(plane, (WIDTH, HEIGHT), (float(centre[0]), float(centre[1])))
        patch[:, :FLAT] = 90
        patch += rng.normal(0, noise, patch.shape)
        frames.append((index, np.clip(np.rint(patch), 0, 255).astype(np.uint8)))
    return frames


def moving_tracks(step_error: float, seed: int = 2) -> tuple[Tracks, NDArray[np.float64]]:
    """Tracks with errors of `step_error` pixels per step, and their true positions."""
    rng = np.random.default_rng(seed)
    start = rng.uniform((30, 40), (WIDTH - 40, HEIGHT - 30), (800, 2))
    start = start[np.abs(start[:, 0] - FLAT) > 25]
    moves = np.where(start[:, :1] > FLAT, STEP, 0.0)
    truth = start[:, None] + np.arange(FRAMES)[:, None] * moves[:, None]
    errors = rng.normal(0, step_error, truth.shape)
    errors[:, 0] = 0
    xy = (truth + np.cumsum(errors, axis=1)).astype(np.float32).reshape(-1, 2)
    sigma = np.tile(step_error * np.sqrt(np.arange(FRAMES)), len(start)).astype(np.float32)
    tracks = Tracks(
        num_frames=FRAMES,
        width=WIDTH,
        height=HEIGHT,
        offsets=np.arange(len(start) + 1, dtype=np.int64) * FRAMES,
        frame=np.tile(np.arange(FRAMES, dtype=np.int32), len(start)),
        xy=xy,
        sigma=sigma,
        confirmed=np.zeros(len(xy), bool),
    )
    return tracks, truth.reshape(-1, 2)


def is_textured(tracks: Tracks) -> NDArray[np.bool_]:
    first = tracks.xy[tracks.offsets[:-1], 0]
    return np.asarray(np.repeat(first > FLAT, tracks.lengths))


def test_refinement_reduces_errors_without_drift() -> None:
    tracks, truth = moving_tracks(0.3)
    refined = refine_tracks(tracks, pictures(), LK)
    textured = is_textured(tracks)
    later = tracks.frame > 0
    assert refined.confirmed[textured & later].mean() > 0.98
    error = np.linalg.norm(refined.xy - truth, axis=1)
    before = np.linalg.norm(tracks.xy - truth, axis=1)
    last = textured & (tracks.frame == FRAMES - 1)
    assert np.median(before[last]) > 1.0
    assert np.median(error[last]) < 0.06
    assert np.percentile(error[textured & refined.confirmed], 99) < 0.3
    # Sigma decreases, but is not smaller than the errors.
    sure = last & refined.confirmed
    assert np.median(refined.sigma[sure] / tracks.sigma[sure]) < 0.5
    assert np.sqrt(np.mean(error[sure] ** 2)) < np.sqrt(np.mean(refined.sigma[sure] ** 2))


def test_tracks_without_texture_keep_their_motion() -> None:
    tracks, _ = moving_tracks(0.3)
    refined = refine_tracks(tracks, pictures(), LK)
    flat = ~is_textured(tracks)
    assert flat.sum() > 200
    assert not refined.confirmed[flat].any()
    np.testing.assert_allclose(refined.xy[flat], tracks.xy[flat], atol=1e-4)
    np.testing.assert_allclose(refined.sigma[flat], tracks.sigma[flat], rtol=1e-4)
    assert refined.num_observations == tracks.num_observations


def test_wrong_step_is_not_confirmed() -> None:
    tracks, truth = moving_tracks(0.05)
    # From frame 5 on, every third track is wrong by 8 px.
    off = np.repeat(np.arange(tracks.num_tracks) % 3 == 0, FRAMES) & (tracks.frame >= 5)
    tracks.xy[off] += np.float32(8)
    refined = refine_tracks(tracks, pictures(), LK)
    textured = is_textured(tracks)
    at_jump = off & textured & (tracks.frame == 5)
    assert refined.confirmed[at_jump].mean() < 0.1
    error = np.linalg.norm(refined.xy - truth, axis=1)
    # Tracking restarts with a new template at the wrong position, so the error stays the same.
    np.testing.assert_allclose(np.median(error[at_jump]), 8 * np.sqrt(2), atol=0.3)
    assert np.median(error[textured & ~off]) < 0.06


def test_positions_that_leave_the_picture_are_not_confirmed() -> None:
    # A texture moves down by a pixel per frame, and tracks near the bottom leave the picture.
    width, height, count = 320, 60, 14
    noise = np.random.default_rng(1).integers(0, 256, (400, 400)).astype(np.float32)
    scene = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    frames = [
        (i, scene[100 - i : 100 - i + height, 40 : 40 + width].astype(np.uint8))
        for i in range(count)
    ]
    start = np.arange(8, 310, 2, dtype=np.float32)
    xy = np.empty((len(start), count, 2), np.float32)
    xy[..., 0] = start[:, None]
    xy[..., 1] = np.minimum(height - 9 + np.arange(count), height)
    number = len(start) * count
    tracks = Tracks(
        num_frames=count,
        width=width,
        height=height,
        offsets=np.arange(0, number + 1, count),
        frame=np.tile(np.arange(count, dtype=np.int32), len(start)),
        xy=xy.reshape(-1, 2),
        sigma=np.tile(np.linspace(0, 0.5, count, dtype=np.float32), len(start)),
        confirmed=np.zeros(number, np.bool_),
    )
    refined = refine_tracks(tracks, frames, RefineOptions(refine="lk"))
    confirmed = refined.xy[refined.confirmed]
    assert len(confirmed) > len(start)
    assert confirmed[:, 1].max() < height


def test_tracks_in_missing_frames_keep_their_motion() -> None:
    tracks, truth = moving_tracks(0.3)
    shown = [frame for frame in pictures() if frame[0] not in (4, 5, FRAMES - 1)]
    refined = refine_tracks(tracks, shown, LK)
    missing = np.isin(tracks.frame, (4, 5, FRAMES - 1))
    assert not refined.confirmed[missing].any()
    steps = np.flatnonzero(missing)
    np.testing.assert_allclose(
        refined.xy[steps] - refined.xy[steps - 1],
        tracks.xy[steps] - tracks.xy[steps - 1],
        atol=1e-3,
    )
    # Later frames find the template again.
    later = is_textured(tracks) & (tracks.frame == 8)
    assert np.median(np.linalg.norm((refined.xy - truth)[later], axis=1)) < 0.06


def test_threads_and_colour_do_not_change_the_result() -> None:
    tracks, _ = moving_tracks(0.3)
    frames = pictures()
    first = refine_tracks(tracks, frames, LK)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        again = refine_tracks(tracks, frames, LK)
    finally:
        cv2.setNumThreads(threads)
    in_colour = ((i, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)) for i, image in frames)
    for other in (again, refine_tracks(tracks, in_colour, LK)):
        for name in ("xy", "sigma", "confirmed"):
            assert getattr(first, name).tobytes() == getattr(other, name).tobytes()


def test_frames_of_another_size_or_order_are_refused() -> None:
    tracks, _ = moving_tracks(0.3)
    frames = pictures()
    small = [(0, frames[0][1][:-2])]
    with pytest.raises(ImageError, match="320x238"):
        refine_tracks(tracks, small, LK)
    with pytest.raises(ImageError, match="order"):
        refine_tracks(tracks, [frames[1], frames[0]], LK)
    with pytest.raises(ImageError, match="order"):
        refine_tracks(tracks, [(FRAMES, frames[0][1])], LK)


def test_progress_counts_frames() -> None:
    tracks, _ = moving_tracks(0.3)
    seen: list[int] = []
    refine_tracks(tracks, pictures(), LK, seen.append)
    assert seen == list(range(1, FRAMES + 1))


def test_errors_and_sigmas_on_the_example_clip() -> None:
    tracks = build_tracks(read_motion(EXAMPLE))
    refined = refine_tracks(tracks, decode_frames(EXAMPLE), LK)
    later = np.ones(tracks.num_observations, bool)
    later[tracks.offsets[:-1]] = False
    assert refined.confirmed[later].mean() > 0.9
    np.testing.assert_array_equal(refined.xy[~later], tracks.xy[~later])
    np.testing.assert_array_equal(refined.offsets, tracks.offsets)

    scene = render_scene.build_scene()
    # Tracks that start in every twentieth frame, compared after four steps.
    start = tracks.offsets[:-1][tracks.lengths > 4]
    start = start[(tracks.frame[start] % 20 == 0) & (tracks.frame[start + 4] % 20 == 4)]
    truth = np.full((len(start), 2), np.nan)
    for first in np.unique(tracks.frame[start]):
        of_first = np.flatnonzero(tracks.frame[start] == first)
        there, visible = render_scene.transfer(
            scene, tracks.xy[start[of_first]], int(first), int(first) + 4
        )
        truth[of_first[visible]] = there[visible]
    for found, largest in ((tracks, 0.11), (refined, 0.09)):
        errors = np.clip(found.xy[start + 4] - truth, -4, 4)
        seen = np.isfinite(errors).all(axis=1)
        assert seen.sum() > 2000
        assert np.median(np.abs(errors[seen])) < largest
        # In each tercile of sigma, the actual error agrees with sigma.
        order = np.argsort(found.sigma[start + 4][seen])
        for part in np.array_split(order, 3):
            expected = np.sqrt(np.mean(found.sigma[start + 4][seen][part] ** 2))
            actual = np.sqrt(np.mean(errors[seen][part] ** 2))
            assert 0.5 < actual / expected < 2


def test_spread_tracks_are_refined_in_the_images_only() -> None:
    tracks, truth = moving_tracks(0.15)
    frames = np.arange(0, FRAMES, 3, dtype=np.int32)
    asked = [item for item in pictures() if item[0] in frames]
    done: list[int] = []
    refined = refine_spread_tracks(tracks, frames, asked, done.append)
    assert done == [1, 2, 3, 4]
    np.testing.assert_array_equal(refined.offsets, tracks.offsets)
    np.testing.assert_array_equal(refined.frame, tracks.frame)
    elsewhere = ~np.isin(tracks.frame, frames)
    np.testing.assert_array_equal(refined.xy[elsewhere], tracks.xy[elsewhere])
    np.testing.assert_array_equal(refined.sigma[elsewhere], tracks.sigma[elsewhere])
    textured = refined.confirmed & (tracks.frame > 0)
    # Only tracks 10 pixels apart are refined.
    assert 300 < textured.sum() / 3 < tracks.num_tracks
    error = np.linalg.norm(refined.xy - truth.reshape(-1, 2), axis=1)[textured]
    before = np.linalg.norm(tracks.xy - truth.reshape(-1, 2), axis=1)[textured]
    assert np.median(error) < 0.25 * np.median(before)
    assert (refined.sigma[textured] < tracks.sigma[textured]).mean() > 0.9


def test_tracks_are_unchanged_with_too_few_images() -> None:
    tracks, _ = moving_tracks(0.15)
    frames = np.array([0, FRAMES - 1], dtype=np.int32)
    # Two images are too few for a selection.
    refined = refine_spread_tracks(tracks, frames, pictures()[:1])
    np.testing.assert_array_equal(refined.xy, tracks.xy)


def test_texture_of_windows_matches_that_of_the_whole_picture() -> None:
    picture = np.clip(texture(160), 0, 255).astype(np.uint8)[:120]
    # Windows and their gradients do not reach the edges.
    at = np.random.default_rng(3).integers(9, (160 - 9, 120 - 9), (12, 2))
    for some in (at, np.repeat(at, 3, axis=0)):  # with many windows, computed for the whole picture
        for found, of_all in zip(
            texture_at(picture, some, 15), texture_of(picture, 15), strict=True
        ):
            np.testing.assert_allclose(found, of_all[some[:, 1], some[:, 0]], rtol=1e-4)
