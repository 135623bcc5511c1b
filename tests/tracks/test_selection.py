from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from colmap_av1.options import DensityOptions
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks

WIDTH, HEIGHT, FRAMES = 320, 240, 30
ANY = {"max_tracks_per_image": 0, "spacing": 0.0, "min_images": 1, "max_sigma": 0.0}


def random_tracks(num_tracks: int = 3000, seed: int = 0) -> Tracks:
    """Tracks that stay within a pixel of their start, with smaller errors in the left half."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, FRAMES - 3, num_tracks)
    length = np.minimum(rng.integers(3, 20, num_tracks), FRAMES - first)
    track = np.repeat(np.arange(num_tracks), length)
    offsets = np.concatenate([[0], np.cumsum(length)]).astype(np.int64)
    step = np.arange(len(track)) - offsets[:-1][track]
    start = rng.uniform((2, 2), (WIDTH - 2, HEIGHT - 2), (num_tracks, 2))
    xy = start[track] + rng.uniform(-0.5, 0.5, (len(track), 2))
    slope = np.where(start[:, 0] < WIDTH / 2, 0.1, 0.2)
    return Tracks(
        num_frames=FRAMES,
        width=WIDTH,
        height=HEIGHT,
        offsets=offsets,
        frame=(first[track] + step).astype(np.int32),
        xy=xy.astype(np.float32),
        sigma=(slope[track] * np.sqrt(step)).astype(np.float32),
        confirmed=np.zeros(len(track), bool),
    )


def per_image(tracks: Tracks) -> Any:
    return np.bincount(tracks.frame, minlength=FRAMES)


def test_dense_keeps_everything() -> None:
    tracks = random_tracks()
    assert select_tracks(tracks, DensityOptions(preset="dense")) is tracks


def test_presets_are_ordered() -> None:
    tracks = random_tracks(20000)
    sizes = [
        len(select_tracks(tracks, DensityOptions(preset=preset)).frame)
        for preset in ("sparse", "default", "dense")
    ]
    assert 0 < sizes[0] < sizes[1] < sizes[2]


def test_max_tracks_per_image_is_respected() -> None:
    tracks = random_tracks()
    chosen = select_tracks(tracks, DensityOptions(**ANY | {"max_tracks_per_image": 100}))
    counts = per_image(chosen)
    assert counts.max() == 100
    assert np.median(counts) > 90
    assert per_image(tracks).max() > 300


def test_spacing_spreads_tracks_over_the_image() -> None:
    tracks = random_tracks()
    chosen = select_tracks(tracks, DensityOptions(**ANY | {"spacing": 20.0}))

    def cells(subset: Tracks) -> Any:
        col, row = (subset.xy // 20).astype(int).T
        return np.unique(np.stack([subset.frame, row, col]), axis=1, return_counts=True)

    found, counts = cells(chosen)
    assert (counts == 1).mean() > 0.8
    # Nearly every cell that has a track keeps one.
    assert found.shape[1] > 0.8 * cells(tracks)[0].shape[1]


def test_accurate_and_long_tracks_are_preferred() -> None:
    tracks = random_tracks()
    options = DensityOptions(**ANY | {"max_tracks_per_image": 60, "min_images": 3})
    chosen = select_tracks(tracks, options)
    assert (chosen.xy[:, 0] < WIDTH / 2).mean() > 0.6
    assert chosen.lengths.mean() > 1.15 * tracks.lengths.mean()


def test_max_sigma_and_min_images_are_respected() -> None:
    tracks = random_tracks()
    chosen = select_tracks(tracks, DensityOptions(**ANY | {"max_sigma": 0.5, "min_images": 5}))
    assert chosen.sigma.max() <= 0.5
    assert chosen.lengths.min() >= 5
    # Nothing else is dropped.
    expected = tracks.keep_observations(tracks.sigma <= 0.5)
    assert chosen.num_tracks == (expected.lengths >= 5).sum()


def test_presets_adapt_to_the_spacing_of_images() -> None:
    tracks = random_tracks()
    # Every fourth frame is an image, so errors grow by four steps from image to image.
    spaced = tracks.keep_observations(tracks.frame % 4 == 0)
    chosen = select_tracks(spaced, DensityOptions())
    largest = chosen.sigma.max()
    assert largest > 0.8
    sigma = spaced.sigma.astype(float)
    first = np.repeat(sigma[spaced.offsets[:-1]], spaced.lengths)
    reach = np.sqrt(np.maximum(sigma**2 - first**2, 0))
    given = select_tracks(spaced, DensityOptions(max_sigma=0.5, min_images=1))
    assert len(given.frame) <= (reach <= 0.5).sum()
    # Errors are relative to the first remaining observation.
    late = tracks.keep_observations(tracks.sigma >= 0.3)
    assert len(select_tracks(late, DensityOptions(**ANY | {"max_sigma": 0.2})).frame) > 0


def moving(tracks: Tracks, pixels: float) -> Tracks:
    """The tracks, with every second one moving by this many pixels per frame."""
    track = tracks.track
    step = np.arange(len(track)) - tracks.offsets[:-1][track]
    way = np.float32([pixels, 0]) * (step * (track % 2 == 0))[:, None].astype(np.float32)
    return replace(tracks, xy=tracks.xy + way)


def test_max_sigma_does_not_apply_to_tracks_that_move_far() -> None:
    tracks = random_tracks()
    options = DensityOptions(**ANY | {"max_sigma": 0.5, "wide_tracks": 10**6})
    near = select_tracks(tracks, options)
    # The motion is far more than thirty times the error.
    quick = select_tracks(moving(tracks, 40), options)
    moves = tracks.track % 2 == 0
    assert near.num_observations < 0.9 * tracks.num_observations
    assert len(quick.frame) == moves.sum() + ((tracks.sigma <= 0.5) & ~moves).sum()


def test_images_keep_their_widest_tracks() -> None:
    tracks = moving(random_tracks(4000), 40)
    sizes: list[int] = []
    for wide_tracks in (0, 20, 60):
        options = DensityOptions(**ANY | {"max_sigma": 0.3, "wide_tracks": wide_tracks})
        chosen = select_tracks(tracks, options)
        start = np.repeat(chosen.xy[chosen.offsets[:-1], 0], chosen.lengths)
        unsure = chosen.sigma > 0.3
        way = chosen.xy[:, 0] - start
        for frame in range(12, FRAMES):
            own = chosen.frame == frame
            farthest = np.sort(way[own])[-wide_tracks:].min() if wide_tracks else np.inf
            # At least this many, and some more with the same error and less motion.
            assert np.count_nonzero(own & (way >= 0.8 * farthest)) >= wide_tracks
            assert (wide_tracks > 0) == np.any(own & unsure)
            if wide_tracks:
                assert np.count_nonzero(own & unsure & (way < 0.8 * farthest)) < 10 * wide_tracks
        sizes.append(chosen.num_observations)
    assert sizes == sorted(set(sizes))
    assert sizes[-1] < 0.9 * tracks.num_observations


def test_keep_observations_preserves_tracks() -> None:
    tracks = random_tracks(50)
    kept = np.random.default_rng(1).random(tracks.num_observations) < 0.3
    kept[tracks.offsets[3] : tracks.offsets[4]] = False
    subset = tracks.keep_observations(kept)
    expected = [
        tracks.xy[a:b][kept[a:b]]
        for a, b in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True)
        if kept[a:b].any()
    ]
    assert subset.num_tracks == len(expected) < 50
    for i, xy in enumerate(expected):
        np.testing.assert_array_equal(subset.xy[subset.offsets[i] : subset.offsets[i + 1]], xy)


def test_selection_of_no_tracks_is_empty() -> None:
    tracks = random_tracks()
    none = tracks.keep_observations(np.zeros(tracks.num_observations, bool))
    assert len(none.offsets) == 1
    for preset in ("sparse", "default", "dense"):
        assert len(select_tracks(none, DensityOptions(preset=preset)).frame) == 0


def test_selection_is_deterministic() -> None:
    tracks = random_tracks()
    options = DensityOptions(preset="sparse")
    first, again = select_tracks(tracks, options), select_tracks(replace(tracks), options)
    assert first.xy.tobytes() == again.xy.tobytes()
