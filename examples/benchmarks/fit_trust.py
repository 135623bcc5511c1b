"""Fit the model of expected errors of motion and matches to clips with known cameras.

python examples/benchmarks/fit_trust.py --fit street=street.mp4:street_model \
    ditch=ditch.mp4:ditch_model --hold_out log=log_building.mp4:log_model

The rendered clip has exact ground truth; the others are compared with the epipolar geometry of a
COLMAP model, which may come from any other matches. The script prints the constants of
`csrc/tracks/trust.cc` and `refine.py`, and compares expected with actual errors, both on the
training clips and on the held-out clips.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from clips import EXAMPLES, load_render_scene
from numpy.typing import NDArray
from scipy.optimize import minimize
from sequences import model_poses

from colmap_av1 import FrameMotion, RefineOptions, Tracks, build_tracks, read_motion
from colmap_av1.tracks.refine import RefinedTracks
from colmap_av1.video.decoding import decode_frames

SAMPLES = 40_000  # Number of samples of each clip.
# Larger errors in pixels are wrong matches and are clipped to this value.
LARGEST_ERROR = {"steps": 3.0, "matches": 4.0}
NEW_VECTOR = (16, 24)  # NEWMV, NEW_NEWMV
# Block sizes in pixels by MiSize (AV1 specification, section 9.3)
BLOCK_WIDTH = np.array(
    [4, 4, 8, 8, 8, 16, 16, 16, 32, 32, 32, 64, 64, 64, 128, 128, 4, 16, 8, 32, 16, 64]
)
BLOCK_HEIGHT = np.array(
    [4, 8, 4, 8, 16, 8, 16, 32, 16, 32, 64, 32, 64, 128, 64, 128, 16, 4, 32, 8, 64, 16]
)

Floats = NDArray[np.float64]
# Returns the errors [n] or [n, 2] in pixels between positions and their ground truth.
Errors = Callable[[Tracks, NDArray[np.int64], NDArray[np.int64]], Floats]


@dataclass(frozen=True)
class Clip:
    """A video and its ground truth; clips with the same ground truth share its error."""

    name: str
    video: Path
    truth: str | None
    errors: Errors


@dataclass(frozen=True)
class Samples:
    """Features that may predict errors, [n, number of features], and the errors [n, 1 or 2]."""

    clip: Clip
    traits: Floats
    errors: Floats


@dataclass(frozen=True)
class Fit:
    """Coefficients of the logarithm of the variance, and the variance of each ground truth."""

    slopes: Floats
    truths: dict[str, float]


STEP_TRAITS = (
    *("kConstant", "kDisagreement", "kLength", "kSize"),
    *("kUncoded", "kOverlapped", "kWarped", "kNewVector"),
)
MATCH_TRAITS = ("_MATCH_CONSTANT", "_MATCH_NOISE", "_MATCH_PRIOR")


def main() -> int:
    """Fit both models, and print their coefficients and calibration."""
    parser = argparse.ArgumentParser(description="Fit the expected errors of tracks.")
    clip = "NAME=VIDEO:MODEL"
    parser.add_argument("--fit", nargs="*", default=[], metavar=clip, help="clips to fit to")
    parser.add_argument("--hold_out", nargs="*", default=[], metavar=clip, help="clips to check on")
    arguments = parser.parse_args()
    fitted = [rendered_clip(), *map(real_clip, arguments.fit)]
    held_out = [real_clip(words) for words in arguments.hold_out]
    steps: list[Samples] = []
    matches: list[Samples] = []
    for each in (*fitted, *held_out):
        motion = list(read_motion(each.video))
        tracks = build_tracks(motion)
        steps.append(step_samples(each, tracks, motion))
        matches.append(match_samples(each, tracks))
        print(f"{each.name}: {tracks.num_observations} observations", file=sys.stderr)
    for what, samples, names in (
        ("steps", steps, STEP_TRAITS),
        ("matches", matches, MATCH_TRAITS),
    ):
        bounded = [clipped(s, LARGEST_ERROR[what]) for s in samples]
        fit = fit_variance(bounded[: len(fitted)])
        print(f"{what}:")
        for name, slope in zip(names, fit.slopes, strict=True):
            print(f"  {name} = {slope:.2f}")
        for truth, variance in fit.truths.items():
            print(f"  error of the ground truth of {truth}: {np.sqrt(variance):.2f} px")
        print("  expected / actual error in px, in 8 groups by expected error:")
        for number, sample in enumerate(bounded):
            label = "" if number < len(fitted) else ", held out"
            print(f"  {sample.clip.name}{label}: {calibration(fit, sample)}")
    return 0


def rendered_clip() -> Clip:
    """The example clip, with exact ground truth."""
    render_scene = load_render_scene()
    scene = render_scene.build_scene()

    def errors(tracks: Tracks, source: NDArray[np.int64], target: NDArray[np.int64]) -> Floats:
        found = np.full((len(source), 2), np.nan)
        for a, b, rows in by_frames(tracks, source, target):
            start = tracks.xy[source[rows]].astype(np.float64)
            truth, visible = render_scene.transfer(scene, start, a, b)
            found[rows[visible]] = (tracks.xy[target[rows]] - truth)[visible]
        return found

    return Clip("scene", EXAMPLES / "scene.mp4", None, errors)


def real_clip(words: str) -> Clip:
    """A clip with a COLMAP model: errors perpendicular to the epipolar lines."""
    name, _, files = words.partition("=")
    video, _, folder = files.rpartition(":")
    if not name or not video or not folder:
        raise SystemExit(f"error: {words}: give NAME=VIDEO:MODEL")
    model = pycolmap.Reconstruction(folder)
    (camera,) = model.cameras.values()

    def errors(tracks: Tracks, source: NDArray[np.int64], target: NDArray[np.int64]) -> Floats:
        poses = model_poses(model, tracks.num_frames)
        found = np.full((len(source), 1), np.nan)
        for a, b, rows in by_frames(tracks, source, target):
            rotation = poses[b, :, :3] @ poses[a, :, :3].T
            x, y, z = poses[b, :, 3] - rotation @ poses[a, :, 3]
            essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
            line = rays(camera, tracks.xy[source[rows]]) @ essential.T
            distance = (rays(camera, tracks.xy[target[rows]]) * line).sum(axis=1)
            with np.errstate(invalid="ignore"):
                distance /= np.hypot(line[:, 0], line[:, 1])
            found[rows, 0] = camera.mean_focal_length() * distance
        return found

    return Clip(name, Path(video), str(Path(folder).resolve()), errors)


def by_frames(
    tracks: Tracks, source: NDArray[np.int64], target: NDArray[np.int64]
) -> list[tuple[int, int, NDArray[np.int64]]]:
    """The indices of the samples of each pair of frames."""
    key = tracks.frame[source].astype(np.int64) * tracks.num_frames + tracks.frame[target]
    order = np.argsort(key, kind="stable")
    values, first = np.unique(key[order], return_index=True)
    return [
        (int(value // tracks.num_frames), int(value % tracks.num_frames), rows)
        for value, rows in zip(values, np.split(order, first[1:]), strict=True)
    ]


def rays(camera: Any, xy: NDArray[np.float32]) -> Floats:
    """[n, 3] rays of positions [n, 2]."""
    normalised = np.asarray(camera.cam_from_img(xy.astype(np.float64)))
    return np.column_stack([normalised, np.ones(len(xy))])


def draw(count: int) -> NDArray[np.int64]:
    """A random sample of `count` rows."""
    rows = np.random.default_rng(0).permutation(count)[:SAMPLES]
    return np.asarray(np.sort(rows), np.int64)


def step_samples(clip: Clip, tracks: Tracks, motion: list[FrameMotion]) -> Samples:
    """Steps to the previous frame, with features of their units in the bitstream."""
    first = np.zeros(tracks.num_observations, bool)
    first[tracks.offsets[:-1]] = True
    later = np.flatnonzero(~first)
    later = later[tracks.frame[later] - tracks.frame[later - 1] == 1]
    later = later[draw(len(later))]
    traits = np.full((len(later), len(STEP_TRAITS)), np.nan)
    frames = {frame.display_index: frame for frame in motion if frame.display_index >= 0}
    for index in np.unique(tracks.frame[later]):
        if int(index) not in frames:
            continue
        rows = np.flatnonzero(tracks.frame[later] == index)
        values = unit_traits(frames[int(index)])
        cell = np.floor(tracks.xy[later[rows]] / 4).astype(np.int64)
        traits[rows] = values[cell[:, 1], cell[:, 0]]
    errors = clip.errors(tracks, later - 1, later)
    return known(Samples(clip, traits, errors))


def unit_traits(frame: FrameMotion) -> Floats:
    """[mi_rows, mi_cols, features] of the displacement to the previous frame; NaN without one."""
    width, height = BLOCK_WIDTH[frame.mi_size], BLOCK_HEIGHT[frame.mi_size]
    rows, cols = np.mgrid[: width.shape[0], : width.shape[1]]
    block = (rows // (height // 4) * (height // 4)) * width.shape[1]
    block += cols // (width // 4) * (width // 4)
    displacement = frame.displacement(0).astype(np.float64)
    interval = frame.ref_display_index[np.maximum(frame.ref_frame[..., 0], 0)]
    interval = np.where(frame.ref_frame[..., 0] > 0, interval - frame.display_index, 0)

    # Compare each unit next to a block with the adjacent unit of the block.
    total, count = np.zeros(block.size), np.zeros(block.size)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        row, col = rows + down, cols + right
        inside = (row >= 0) & (row < width.shape[0]) & (col >= 0) & (col < width.shape[1])
        row, col = np.where(inside, row, rows), np.where(inside, col, cols)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = interval / interval[row, col]
            away = np.abs(displacement - ratio[..., None] * displacement[row, col]).max(axis=-1)
        used = inside & (block[row, col] != block) & np.isfinite(away)
        np.add.at(total, block[used], away[used])
        np.add.at(count, block[used], 1)
    disagreement = np.where(count > 0, total / np.maximum(count, 1), 0.5)[block]

    traits = np.stack(
        [
            np.ones(block.shape),
            np.log(0.1 + disagreement),
            np.log1p(np.linalg.norm(displacement, axis=-1)),
            np.log2(width * height) - 6,
            frame.skip,
            frame.motion_mode == 1,
            (frame.motion_mode == 2) & (frame.warp_index >= 0),
            np.isin(frame.y_mode, NEW_VECTOR),
        ],
        axis=-1,
    ).astype(np.float64)
    traits[(interval != -1) | ~np.isfinite(displacement).all(axis=-1)] = np.nan
    return traits


def match_samples(clip: Clip, tracks: Tracks) -> Samples:
    """Matches of decoded pictures, with their residual and the bitstream's error as features."""
    source = np.full(tracks.num_observations, -1)
    noise = np.zeros(tracks.num_observations, np.float32)

    class Recorded(RefinedTracks):
        """Records what each observation was matched with."""

        def accept(
            self, observations: NDArray[np.int64], found: Any, origin: NDArray[np.int64]
        ) -> NDArray[np.bool_]:
            sure = super().accept(observations, found, origin)
            taken = observations[sure]
            source[taken] = origin[sure]
            noise[taken] = found.difference[sure] * self.templates.softness[self.track[taken]]
            return sure

    refined = Recorded.start(tracks, RefineOptions(refine="lk"), None)
    refined.refine_all(decode_frames(clip.video))
    target = np.flatnonzero(source >= 0)
    target = target[draw(len(target))]
    prior = refined.bitstream_variance[target] - refined.bitstream_variance[source[target]]
    traits = np.stack(
        [
            np.ones(len(target)),
            np.log(0.02 + noise[target]),
            np.log(0.01 + np.maximum(prior, 0)),
        ],
        axis=-1,
    ).astype(np.float64)
    found = Tracks(
        *(tracks.num_frames, tracks.width, tracks.height, tracks.offsets, tracks.frame),
        *(refined.xy, tracks.sigma, refined.confirmed),
    )
    return known(Samples(clip, traits, clip.errors(found, source[target], target)))


def known(samples: Samples) -> Samples:
    """The samples with ground truth and all features."""
    rows = np.isfinite(samples.errors).all(axis=1) & np.isfinite(samples.traits).all(axis=1)
    return Samples(samples.clip, samples.traits[rows], samples.errors[rows])


def clipped(samples: Samples, largest: float) -> Samples:
    """The samples with errors clipped to `largest`."""
    errors = np.clip(samples.errors, -largest, largest)
    return Samples(samples.clip, samples.traits, errors)


def fit_variance(samples: list[Samples]) -> Fit:
    """Fit the variance of normally distributed errors, with the same weight for every clip."""
    truths = sorted({s.clip.truth for s in samples if s.clip.truth is not None})
    axes = [s.errors.shape[1] for s in samples]
    traits = np.concatenate([np.repeat(s.traits, n, 0) for s, n in zip(samples, axes, strict=True)])
    square = np.concatenate([s.errors.ravel() ** 2 for s in samples])
    weight = np.concatenate([np.full(s.errors.size, 1 / s.errors.size) for s in samples])
    truth = np.concatenate(
        [
            np.full(s.errors.size, -1 if s.clip.truth is None else truths.index(s.clip.truth))
            for s in samples
        ]
    )
    num_traits = traits.shape[1]

    def loss(parameters: Floats) -> tuple[float, Floats]:
        own = np.exp(np.clip(traits @ parameters[:num_traits], -14, 5))
        floor = np.append(np.exp(parameters[num_traits:]), 0)[truth]
        variance = own + floor
        slope = weight * (1 - square / variance) / variance
        of_truths = [np.sum((slope * floor)[truth == t]) for t in range(len(truths))]
        value = np.sum(weight * (square / variance + np.log(variance)))
        return float(value), np.concatenate([traits.T @ (slope * own), of_truths])

    start = np.concatenate([[-2], np.zeros(num_traits - 1), np.full(len(truths), np.log(0.02))])
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 500}).x
    names = (Path(name).name for name in truths)
    return Fit(
        found[:num_traits], dict(zip(names, np.exp(found[num_traits:]).tolist(), strict=True))
    )


def calibration(fit: Fit, samples: Samples, parts: int = 8) -> str:
    """Expected and actual error in groups of equal size, smallest expected error first."""
    expected = np.exp(samples.traits @ fit.slopes)
    square = (samples.errors**2).mean(axis=1)
    return " ".join(
        f"{np.sqrt(expected[part].mean()):.2f}/{np.sqrt(square[part].mean()):.2f}"
        for part in np.array_split(np.argsort(expected, kind="stable"), parts)
    )


if __name__ == "__main__":
    sys.exit(main())
