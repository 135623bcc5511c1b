"""Options check their values on construction, as declared by their fields."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import colmap_av1
from colmap_av1 import options as all_options
from colmap_av1.errors import OptionError
from colmap_av1.images.files import WRITE_PARAMETERS
from colmap_av1.options import (
    CameraOptions,
    CompareOptions,
    DensifyOptions,
    DensityOptions,
    EncodeOptions,
    ExportOptions,
    ImageOptions,
    LearnedOptions,
    MapOptions,
    MatchOptions,
    PairOptions,
    PoseOptions,
    ReadOptions,
    ReconstructOptions,
    RefineOptions,
    RunOptions,
    TrackOptions,
    TriangulateOptions,
    VerifyOptions,
    ViewOptions,
)
from colmap_av1.options.fields import Options, declared_of, field_types, option
from colmap_av1.options.images import IMAGE_EXTENSIONS
from colmap_av1.options.words import words_of
from colmap_av1.tracks.selection import PRESETS
from colmap_av1.util.digests import digest_of
from colmap_av1.video.encoders import ENCODERS

KINDS = [
    kind
    for kind in map(vars(all_options).get, all_options.__all__)
    if isinstance(kind, type) and issubclass(kind, Options)
]
NAN, INF = float("nan"), float("inf")

REFUSED: list[tuple[type, dict[str, Any]]] = [
    (ReadOptions, {"operating_point": -1}),
    (ReadOptions, {"operating_point": 32}),
    (ReadOptions, {"num_threads": 0}),
    (ReadOptions, {"max_frame_size": 0}),
    (EncodeOptions, {"encoder": "x264"}),
    (EncodeOptions, {"quality": 64}),
    (EncodeOptions, {"quality": -1}),
    (ImageOptions, {"every": 0}),
    (ImageOptions, {"num_images": 1}),
    (ImageOptions, {"fps": -1}),
    (ImageOptions, {"fps": 1e30}),
    (ImageOptions, {"every": 2, "fps": 3}),
    (ImageOptions, {"num_images": 2, "frame_list": "a"}),
    (ImageOptions, {"select": "depth"}),
    (ImageOptions, {"select": "parallax"}),
    (ImageOptions, {"image_name": "x.png"}),
    (ImageOptions, {"image_name": "%d_%d.png"}),
    (ImageOptions, {"image_name": "%d.gif"}),
    (ImageOptions, {"image_name": "a/%d.png"}),
    (MatchOptions, {"on_existing": "keep"}),
    (CameraOptions, {"camera_model": "PINHOL"}),
    (CameraOptions, {"camera_model": "INVALID"}),
    (CameraOptions, {"camera_model": "EQUIRECTANGULAR"}),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "1,2,3"},
    ),
    (CameraOptions, {"camera_model": "PINHOLE", "camera_params": "1;2;3;4"}),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "500,500,nan,240"},
    ),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "500,0,320,240"},
    ),
    (CameraOptions, {"camera_params": "1,2"}),
    (TrackOptions, {"min_length": 0}),
    (TrackOptions, {"cosine": 1.5}),
    (TrackOptions, {"cosine": NAN}),
    (TrackOptions, {"cosine_relative_to": "median"}),
    (TrackOptions, {"cosine_scale": -1.0}),
    (TrackOptions, {"cosine_scale": INF}),
    (TrackOptions, {"max_block_area": -5}),
    (TrackOptions, {"max_interval": 2**31}),
    (TrackOptions, {"smoothness": NAN}),
    (TrackOptions, {"border": -1.0}),
    (TrackOptions, {"interpolation": -1.0}),
    (TrackOptions, {"bridge": -1.0}),
    (TrackOptions, {"cell": 3}),
    (TrackOptions, {"seeding": 3}),
    (TrackOptions, {"seeding": 2, "cell": 4}),
    (RefineOptions, {"refine": "sift"}),
    (RefineOptions, {"refine_window": 8}),
    (RefineOptions, {"refine_window": 3}),
    (RefineOptions, {"refine_move": 0.0}),
    (RefineOptions, {"refine_difference": NAN}),
    (DensityOptions, {"preset": "medium"}),
    (DensityOptions, {"max_tracks_per_image": -1}),
    (DensityOptions, {"spacing": NAN}),
    (DensityOptions, {"spacing": -1}),
    (DensityOptions, {"min_images": -2}),
    (DensityOptions, {"max_sigma": -0.5}),
    (DensityOptions, {"wide_tracks": -1}),
    (PairOptions, {"offsets": ()}),
    (PairOptions, {"offsets": (1, 0)}),
    (PairOptions, {"growth": 0.5}),
    (PairOptions, {"growth": INF}),
    (PairOptions, {"max_span": 0}),
    (PairOptions, {"min_matches": 0}),
    (VerifyOptions, {"max_error": 0}),
    (VerifyOptions, {"max_error": INF}),
    (VerifyOptions, {"min_num_inliers": 0}),
    (VerifyOptions, {"max_h_inlier_ratio": 1.5}),
    (VerifyOptions, {"min_e_f_inlier_ratio": 1.5}),
    (VerifyOptions, {"confidence": -0.1}),
    (VerifyOptions, {"max_samples": 3}),
    (VerifyOptions, {"max_iterations": 0}),
    (RunOptions, {"seed": -1}),
    (RunOptions, {"num_threads": 0}),
    (TriangulateOptions, {"max_reprojection_error": 0}),
    (TriangulateOptions, {"min_angle": 90}),
    (TriangulateOptions, {"min_angle": -1}),
    (TriangulateOptions, {"min_observations": 1}),
    (TriangulateOptions, {"max_depth_error": 0}),
    (MapOptions, {"mapper": "auto"}),
    (MapOptions, {"mapper": "global", "forward_motion": True}),
    (MapOptions, {"mapper": "global", "init_min_tri_angle": 4.0}),
    (MapOptions, {"init_min_tri_angle": 90.0}),
    (MapOptions, {"seed": -1}),
    (MapOptions, {"num_threads": 0}),
    (PoseOptions, {"mapper": "best"}),
    (PoseOptions, {"pose_tracks_per_image": 1}),
    (PoseOptions, {"mapper_threads": 0}),
    (
        ReconstructOptions,
        {"match": MatchOptions(images=ImageOptions(image_name="a_%d.png")), "image_type": "jpg"},
    ),
    (ReconstructOptions, {"image_type": "bmp"}),
    (ExportOptions, {"verified": 2}),
    (LearnedOptions, {"max_keypoints": 15}),
    (LearnedOptions, {"max_image_size": 63}),
    (LearnedOptions, {"learned_every": 0}),
    (LearnedOptions, {"learned_offsets": ()}),
    (LearnedOptions, {"learned_offsets": (1, 0)}),
    (CompareOptions, {"iterations": 0}),
    (CompareOptions, {"milestones": (0,)}),
    (CompareOptions, {"trainer": "train"}),
    (CompareOptions, {"trainer": "train {data} {"}),
    (CompareOptions, {"trainer": "train '{data}"}),
    (CompareOptions, {"trainer": "train {data.parent}"}),
    (CompareOptions, {"trainer": "train {data} {}"}),
    (CompareOptions, {"trainer": "train {data:>9}"}),
    (CompareOptions, {"trainer": "train {data!r}"}),
    (CompareOptions, {"trainer": "train {data} && echo"}),
    (CompareOptions, {"trainer": "train {data} 2>x"}),
    (CompareOptions, {"trainer": "sh -c 'train {data}'"}),
    (CompareOptions, {"trainer": "nice /bin/bash -ec 'a \"{data}\"' {data}"}),
    (CompareOptions, {"trainer": "python3 -c 'print(\"{data}\")'"}),
    (ViewOptions, {"draw": "arrows"}),
    (ViewOptions, {"opacity": 2}),
    (ViewOptions, {"tail": -1}),
    (ViewOptions, {"spacing": 0}),
]

WRONG_TYPES: list[tuple[type, dict[str, Any]]] = [
    (ImageOptions, {"num_images": "5"}),
    (ImageOptions, {"num_images": 5.0}),
    (ImageOptions, {"every": True}),
    (ImageOptions, {"fps": "2"}),
    (ImageOptions, {"frame_list": 3}),
    (ImageOptions, {"image_name": None}),
    (ImageOptions, {"skip_blurred": 1}),
    (ImageOptions, {"select": ["time"]}),
    (PoseOptions, {"refine_intrinsics": "no"}),
    (PoseOptions, {"mapper": None}),
    (PairOptions, {"offsets": [1, 2]}),
    (PairOptions, {"offsets": (1, "2")}),
    (CompareOptions, {"frontends": "av1"}),
    (MatchOptions, {"images": TrackOptions()}),
    (MatchOptions, {"read": None}),
]


@pytest.mark.parametrize(
    ("kind", "given"),
    REFUSED + WRONG_TYPES,
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_invalid_values_are_refused_on_construction(kind: type, given: dict[str, Any]) -> None:
    """The error is one line and names the option."""
    name = "|".join(given).replace("_", "[ _]")
    with pytest.raises(OptionError, match=name) as caught:
        kind(**given)
    assert "\n" not in str(caught.value)
    with pytest.raises(OptionError, match=name):
        replace(kind(), **given)


def test_image_names_that_trainers_cannot_use_are_refused() -> None:
    match = MatchOptions(images=ImageOptions(image_name="a.b_%d.png"))
    with pytest.raises(OptionError, match="image_name"):
        ReconstructOptions(match=match)


@pytest.mark.parametrize("kind", KINDS)
def test_every_choice_is_checked(kind: type[Any]) -> None:
    for name, hint in field_types(kind).items():
        if typing.get_origin(hint) is typing.Literal:
            with pytest.raises(OptionError, match=name):
                kind(**{name: "none of these"})


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_has_a_help_text_and_every_kind_a_title(kind: type[Any]) -> None:
    assert kind.title
    for field in dataclasses.fields(kind):
        if not isinstance(field.default, Options):
            assert declared_of(field).help, field.name


def test_every_kind_is_exported() -> None:
    assert {kind.__name__ for kind in KINDS} <= set(colmap_av1.__all__)
    own = [k for k in Options.__subclasses__() if k.__module__.startswith("colmap_av1.")]
    assert set(KINDS) == set(own)
    assert sorted(colmap_av1.__all__) == colmap_av1.__all__


def test_numpy_numbers_fractions_and_paths_are_accepted() -> None:
    """Numbers become plain ones, so that options have a digest and a command line."""
    images = ImageOptions(num_images=np.int64(40))
    assert type(images.num_images) is int
    assert digest_of([images]) == digest_of([ImageOptions(num_images=40)])
    assert words_of(ImageOptions(fps=Fraction(5, 2))) == ["--fps=2.5"]
    pairs = PairOptions(offsets=(np.int64(3),))
    assert digest_of([pairs]) == digest_of([PairOptions(offsets=(3,))])
    tracks = TrackOptions(cosine=np.float32(0.5))
    assert digest_of([tracks]) == digest_of([TrackOptions(cosine=0.5)])
    assert ImageOptions(frame_list=Path("a.txt")).frame_list == Path("a.txt")


def test_camera_params_without_a_model_may_be_for_non_square_pixels() -> None:
    assert CameraOptions(camera_params="500,320,240,0").camera_model is None
    assert CameraOptions(camera_params="500,400,320,240,0,0,0,0").camera_model is None


def test_num_threads_of_the_run_applies_to_reading() -> None:
    run = RunOptions(num_threads=3)
    assert MatchOptions(run=run).reading == ReadOptions(num_threads=3)
    own = ReadOptions(num_threads=2, strict=True)
    assert MatchOptions(run=run, read=own).reading == own


def test_a_field_declares_its_own_bounds() -> None:
    @dataclass(frozen=True)
    class _More(Options):
        depth: float | None = option(1.0, "how deep", above=0, most=2, unit="metres")
        sides: tuple[int, ...] = option((1,), "which", among=(1, 2))

    globals()["_More"] = _More
    assert _More(depth=None, sides=(1, 2)) == _More(None, (1, 2))
    for given in ({"depth": 0}, {"depth": 2.5}, {"sides": (3,)}):
        with pytest.raises(OptionError, match=next(iter(given))):
            _More(**given)


def test_choices_match_the_implementations() -> None:
    encoders = typing.get_args(field_types(EncodeOptions)["encoder"])
    assert encoders == ("auto", *ENCODERS)
    assert typing.get_args(field_types(DensityOptions)["preset"]) == tuple(PRESETS)
    assert set(IMAGE_EXTENSIONS) == set(WRITE_PARAMETERS)


def test_declared_unused_options_exist() -> None:
    for kind in (DensifyOptions, ReconstructOptions, CompareOptions, MatchOptions):
        for field in dataclasses.fields(kind):
            for path in declared_of(field).unused:
                part = field.default
                for name in path.split("."):
                    part = getattr(part, name)


@pytest.mark.parametrize(
    ("name", "image_type", "expected"),
    [
        ("frame_%06d", None, "frame_%06d.jpg"),
        ("frame_%06d", "png", "frame_%06d.png"),
        ("shot%d.png", None, "shot%d.png"),
    ],
)
def test_image_type_sets_the_extension(
    name: str, image_type: Literal["png"] | None, expected: str
) -> None:
    images = ImageOptions(image_name=name)
    options = ReconstructOptions(match=MatchOptions(images=images), image_type=image_type)
    assert options.with_extension.match.images.file_name == expected
    assert options.with_extension.with_extension == options.with_extension
