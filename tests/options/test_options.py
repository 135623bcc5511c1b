"""Options refuse what cannot work when they are made, by what their fields declare."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import colmap_av1
from colmap_av1 import options as all_options
from colmap_av1.errors import OptionError
from colmap_av1.images.names import WRITE_PARAMETERS
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
    MapperOptions,
    MatchOptions,
    PairOptions,
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
from colmap_av1.tracks.selection import PRESETS
from colmap_av1.video.encoders import ENCODERS

KINDS = [
    kind
    for kind in map(vars(all_options).get, all_options.__all__)
    if isinstance(kind, type) and issubclass(kind, Options)
]
NAN, INF = float("nan"), float("inf")

REFUSED: list[tuple[type, dict[str, Any], str]] = [
    (ReadOptions, {"operating_point": -1}, "operating_point is -1: give 0 to 31"),
    (ReadOptions, {"operating_point": 32}, "operating_point is 32: give 0 to 31"),
    (ReadOptions, {"num_threads": 0}, "num_threads is 0: give 1 or more, or None"),
    (ReadOptions, {"max_frame_size": 0}, "max_frame_size is 0: give samples above 0"),
    (EncodeOptions, {"encoder": "x264"}, "encoder is 'x264': give auto, nvenc, qsv"),
    (EncodeOptions, {"quality": 64}, "quality is 64: give 0 to 63"),
    (EncodeOptions, {"quality": -1}, "quality is -1: give 0 to 63"),
    (ImageOptions, {"every": 0}, "every is 0: give 1 or more"),
    (ImageOptions, {"num_images": 1}, "num_images is 1: give 2 or more"),
    (ImageOptions, {"fps": -1}, "fps is -1: give images per second above 0"),
    (ImageOptions, {"fps": 1e30}, r"fps is 1e\+30: give 2147483647 at most"),
    (ImageOptions, {"every": 2, "fps": 3}, "every and fps both say"),
    (ImageOptions, {"num_images": 2, "frame_list": "a"}, "num_images and frame_list both say"),
    (ImageOptions, {"select": "depth"}, "select is 'depth': give time, parallax"),
    (ImageOptions, {"select": "parallax"}, "give num_images"),
    (ImageOptions, {"image_name": "x.png"}, "'x.png' needs exactly one number field"),
    (ImageOptions, {"image_name": "%d_%d.png"}, "needs exactly one number field"),
    (ImageOptions, {"image_name": "a.b_%d"}, "ends in .png"),
    (ImageOptions, {"image_name": "%d.gif"}, r"ends in \.png, \.jpg or \.jpeg"),
    (ImageOptions, {"image_name": "a/%d.png"}, "give a plain file name"),
    (MatchOptions, {"on_existing": "keep"}, "on_existing is 'keep': give error, append, replace"),
    (CameraOptions, {"camera_model": "PINHOL"}, "unknown camera model 'PINHOL'"),
    (CameraOptions, {"camera_model": "INVALID"}, "unknown camera model 'INVALID'"),
    (CameraOptions, {"camera_model": "EQUIRECTANGULAR"}, "no focal length"),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "1,2,3"},
        "takes 4 numbers, fx, fy, cx, cy",
    ),
    (CameraOptions, {"camera_model": "PINHOLE", "camera_params": "1;2;3;4"}, "cannot read"),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "500,500,nan,240"},
        "do not fit",
    ),
    (
        CameraOptions,
        {"camera_model": "PINHOLE", "camera_params": "500,0,320,240"},
        "focal length of 0 or less",
    ),
    (CameraOptions, {"camera_params": "1,2"}, "camera_params '1,2' do not fit: SIMPLE_RADIAL"),
    (TrackOptions, {"min_length": 0}, "min_length is 0: give 1 or more"),
    (TrackOptions, {"cosine": 1.5}, "cosine is 1.5: give -1 to 1, or None"),
    (TrackOptions, {"cosine": NAN}, "cosine is nan: give -1 to 1"),
    (TrackOptions, {"cosine_relative_to": "median"}, "cosine_relative_to is 'median'"),
    (TrackOptions, {"cosine_scale": -1.0}, "cosine_scale is -1.0: give 0 or more pixels"),
    (TrackOptions, {"cosine_scale": INF}, "cosine_scale is inf: give 0 or more pixels"),
    (TrackOptions, {"max_block_area": -5}, "max_block_area is -5: give 0 or more, or None"),
    (TrackOptions, {"max_interval": 2**31}, "max_interval is 2147483648: give 2147483647 at most"),
    (TrackOptions, {"smoothness": NAN}, "smoothness is nan"),
    (TrackOptions, {"border": -1.0}, "border is -1.0"),
    (TrackOptions, {"interpolation": -1.0}, "interpolation is -1.0"),
    (TrackOptions, {"bridge": -1.0}, "bridge is -1.0"),
    (TrackOptions, {"cell": 3}, "cell is 3: give 4, 2 or 1 pixels, or None"),
    (TrackOptions, {"seeding": 3}, "seeding is 3: give 8, 4, 2 or 1 pixels"),
    (TrackOptions, {"seeding": 2, "cell": 4}, "seeding is 2, below cell 4"),
    (RefineOptions, {"refine": "sift"}, "refine is 'sift': give none, lk"),
    (RefineOptions, {"refine_window": 8}, "refine_window is 8: give an odd number from 5 to 101"),
    (RefineOptions, {"refine_window": 3}, "refine_window is 3: give 5 to 101"),
    (RefineOptions, {"refine_move": 0.0}, "refine_move is 0.0: give pixels above 0"),
    (RefineOptions, {"refine_difference": NAN}, "refine_difference is nan"),
    (DensityOptions, {"preset": "medium"}, "preset is 'medium': give sparse, default, dense"),
    (DensityOptions, {"max_tracks_per_image": -1}, "max_tracks_per_image is -1"),
    (DensityOptions, {"spacing": NAN}, "spacing is nan"),
    (DensityOptions, {"spacing": -1}, "spacing is -1: give 0 or more"),
    (DensityOptions, {"min_images": -2}, "min_images is -2"),
    (DensityOptions, {"max_sigma": -0.5}, "max_sigma is -0.5"),
    (DensityOptions, {"wide_tracks": -1}, "wide_tracks is -1"),
    (PairOptions, {"offsets": ()}, "offsets is"),
    (PairOptions, {"offsets": (1, 0)}, r"offsets is \(1, 0\): give a tuple of whole numbers, 1 or"),
    (PairOptions, {"growth": 0.5}, "growth is 0.5: give 1 or more"),
    (PairOptions, {"growth": INF}, "growth is inf"),
    (PairOptions, {"max_span": 0}, "max_span is 0"),
    (PairOptions, {"min_matches": 0}, "min_matches is 0"),
    (VerifyOptions, {"max_error": 0}, "max_error is 0: give a number of pixels above 0"),
    (VerifyOptions, {"max_error": INF}, "max_error is inf: give a number of pixels above 0"),
    (VerifyOptions, {"min_num_inliers": 0}, "min_num_inliers is 0"),
    (VerifyOptions, {"max_h_inlier_ratio": 1.5}, "max_h_inlier_ratio is 1.5: give a fraction from"),
    (VerifyOptions, {"min_e_f_inlier_ratio": 1.5}, "min_e_f_inlier_ratio is 1.5"),
    (VerifyOptions, {"confidence": -0.1}, "confidence is -0.1: give a probability from 0 to 1"),
    (VerifyOptions, {"max_samples": 3}, "max_samples is 3: give 8 or more"),
    (VerifyOptions, {"max_iterations": 0}, "max_iterations is 0"),
    (RunOptions, {"seed": -1}, "seed is -1: give 0 or more"),
    (RunOptions, {"num_threads": 0}, "num_threads is 0: give 1 or more, or None"),
    (TriangulateOptions, {"max_reprojection_error": 0}, "max_reprojection_error is 0: give pixels"),
    (TriangulateOptions, {"min_angle": 90}, "min_angle is 90: give degrees from 0 to below 90"),
    (TriangulateOptions, {"min_angle": -1}, "min_angle is -1"),
    (TriangulateOptions, {"min_observations": 1}, "min_observations is 1: give 2 or more"),
    (TriangulateOptions, {"max_depth_error": 0}, "max_depth_error is 0: give a fraction above 0"),
    (MapOptions, {"mapper": "auto"}, "mapper is 'auto': give incremental, global"),
    (MapOptions, {"mapper": "global", "forward_motion": True}, "give --mapper incremental"),
    (MapOptions, {"seed": -1}, "seed is -1: give 0 or more"),
    (MapOptions, {"num_threads": 0}, "num_threads is 0: give 1 or more"),
    (MapperOptions, {"mapper": "best"}, "mapper is 'best': give auto, incremental, global"),
    (MapperOptions, {"pose_tracks_per_image": 1}, "pose_tracks_per_image is 1: give 50 or more"),
    (MapperOptions, {"mapper_threads": 0}, "mapper_threads is 0: give 1 or more"),
    (
        ReconstructOptions,
        {"match": MatchOptions(camera=CameraOptions(single_camera=False))},
        "single_camera is 0",
    ),
    (
        ReconstructOptions,
        {"match": MatchOptions(images=ImageOptions(image_name="a.b_%d.png"))},
        "image_name 'a.b_%d.png'",
    ),
    (
        ReconstructOptions,
        {"match": MatchOptions(images=ImageOptions(image_name="a_%d.png")), "image_type": "jpg"},
        "leave out image_type or the extension",
    ),
    (ReconstructOptions, {"image_type": "bmp"}, "image_type is 'bmp': give jpg, png"),
    (ExportOptions, {"format": "xml"}, "format is 'xml': give hloc"),
    (LearnedOptions, {"max_keypoints": 15}, "max_keypoints is 15"),
    (LearnedOptions, {"max_image_size": 63}, "max_image_size is 63"),
    (LearnedOptions, {"learned_every": 0}, "learned_every is 0"),
    (LearnedOptions, {"learned_offsets": ()}, "learned_offsets is"),
    (LearnedOptions, {"learned_offsets": (1, 0)}, r"learned_offsets is \(1, 0\)"),
    (CompareOptions, {"iterations": 0}, "iterations is 0"),
    (CompareOptions, {"milestones": (0,)}, r"milestones is \(0,\)"),
    (CompareOptions, {"trainer": "train"}, "trainer 'train': give 'gsplat', or a command with"),
    (CompareOptions, {"trainer": "train {data} {"}, "write {{ for a brace"),
    (CompareOptions, {"trainer": "train '{data}"}, "No closing quotation: quote it as for a shell"),
    (CompareOptions, {"trainer": "train {data.parent}"}, "with {data} and others of {data},"),
    (CompareOptions, {"trainer": "train {data} {}"}, "with {data} and others of {data},"),
    (CompareOptions, {"trainer": "train {data:>9}"}, "give {data} without a format"),
    (CompareOptions, {"trainer": "train {data!r}"}, "give {data} without a format"),
    (CompareOptions, {"trainer": "train {data} && echo"}, "no shell reads it, so && means nothing"),
    (CompareOptions, {"trainer": "train {data} 2>x"}, "no shell reads it, so 2>x means nothing"),
    (CompareOptions, {"trainer": "sh -c 'train {data}'"}, "sh would take a folder's name for code"),
    (CompareOptions, {"trainer": "nice /bin/bash -ec 'a \"{data}\"' {data}"}, "bash would take a"),
    (CompareOptions, {"trainer": "python3 -c 'print(\"{data}\")'"}, "python3 would take a folder"),
    (ViewOptions, {"draw": "arrows"}, "draw is 'arrows': give motion, tracks, both"),
    (ViewOptions, {"opacity": 2}, "opacity is 2: give an opacity from 0 to 1"),
    (ViewOptions, {"tail": -1}, "tail is -1: give 0 or more frames"),
    (ViewOptions, {"spacing": 0}, "spacing is 0: give 1 or more pixels"),
]

WRONG_TYPES: list[tuple[type, dict[str, Any], str]] = [
    (ImageOptions, {"num_images": "5"}, "num_images is '5': give a whole number, 2 or more"),
    (ImageOptions, {"num_images": 5.0}, r"num_images is 5\.0: give a whole number"),
    (ImageOptions, {"every": True}, "every is True: give a whole number"),
    (ImageOptions, {"fps": "2"}, "fps is '2': give a number, images per second above 0"),
    (ImageOptions, {"frame_list": 3}, "frame_list is 3: give a path, or None"),
    (ImageOptions, {"image_name": None}, "image_name is None: give a text"),
    (ImageOptions, {"skip_blurred": 1}, "skip_blurred is 1: give True or False"),
    (ImageOptions, {"select": ["time"]}, r"select is \['time'\]: give time, parallax"),
    (MapperOptions, {"refine_intrinsics": "no"}, "refine_intrinsics is 'no': give True or False, "),
    (MapperOptions, {"mapper": None}, "mapper is None: give auto"),
    (PairOptions, {"offsets": [1, 2]}, r"offsets is \[1, 2\]: give a tuple of whole numbers"),
    (PairOptions, {"offsets": (1, "2")}, "offsets is"),
    (CompareOptions, {"frontends": "av1"}, "frontends is 'av1': give a tuple of texts"),
    (MatchOptions, {"images": TrackOptions()}, "images is TrackOptions: give ImageOptions"),
    (MatchOptions, {"read": None}, "read is None: give ReadOptions"),
]


@pytest.mark.parametrize(
    ("kind", "given", "message"),
    REFUSED + WRONG_TYPES,
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_values_that_cannot_work_are_refused_when_made(
    kind: type, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(OptionError, match=message) as caught:
        kind(**given)
    assert "\n" not in str(caught.value)
    with pytest.raises(OptionError, match=message):
        replace(kind(), **given)


@pytest.mark.parametrize("kind", KINDS)
def test_every_choice_is_checked(kind: type[Any]) -> None:
    for name, hint in field_types(kind).items():
        if typing.get_origin(hint) is typing.Literal:
            with pytest.raises(OptionError, match=f"{name} is 'none of these': give "):
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


def test_numbers_of_numpy_and_paths_are_taken() -> None:
    assert PairOptions(offsets=(np.int64(3),)).offsets == (3,)
    assert TrackOptions(cosine=np.float32(0.5), border=3).border == 3
    assert ImageOptions(frame_list=Path("a.txt")).frame_list == Path("a.txt")


def test_parameters_without_a_model_may_be_those_of_oblong_pixels() -> None:
    assert CameraOptions(camera_params="500,320,240,0").camera_model is None
    assert CameraOptions(camera_params="500,400,320,240,0,0,0,0").camera_model is None


def test_threads_of_the_run_read_the_bitstream() -> None:
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


def test_choices_are_those_of_what_they_choose() -> None:
    encoders = typing.get_args(field_types(EncodeOptions)["encoder"])
    assert encoders == ("auto", *ENCODERS)
    assert typing.get_args(field_types(DensityOptions)["preset"]) == tuple(PRESETS)
    assert set(IMAGE_EXTENSIONS) == set(WRITE_PARAMETERS)


def test_parts_that_are_unused_exist() -> None:
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
def test_formats_of_images_of_reconstruct(
    name: str, image_type: Literal["png"] | None, expected: str
) -> None:
    images = ImageOptions(image_name=name)
    options = ReconstructOptions(match=MatchOptions(images=images), image_type=image_type)
    assert options.with_extension.match.images.file_name == expected
    assert options.with_extension.with_extension == options.with_extension
