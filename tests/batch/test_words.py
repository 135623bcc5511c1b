"""The command line for options: it restores the same options."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from colmap_av1 import (
    CameraOptions,
    DensifyOptions,
    ImageOptions,
    MaskOptions,
    MatchOptions,
    ReadOptions,
    ReconstructOptions,
    RunOptions,
)
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.parser import Parser
from colmap_av1.options.fields import Options
from colmap_av1.options.words import words_of

MATCH = MatchOptions(
    images=ImageOptions(every=7, image_name="a b=%03d.jpg"),
    masks=MaskOptions(mask_path="/some/masks"),
    camera=CameraOptions(camera_params="500,2.5,3,-0.1"),
    run=RunOptions(seed=5),
    reencode=True,
)


@pytest.mark.parametrize(
    "options",
    [
        MatchOptions(),
        MATCH,
        ReadOptions(strict=True, num_threads=3, max_frame_size=1000),
        ReconstructOptions(match=MATCH, moving="keep"),
        DensifyOptions(match=MatchOptions(images=ImageOptions(every=2))),
    ],
)
def test_command_line_restores_the_options(options: Options) -> None:
    parser = Parser(prog="x")
    add_options(parser, type(options))
    namespace: argparse.Namespace = parser.parse_args(words_of(options))
    assert given(namespace, type(options)) == options
    assert words_of(type(options)()) == []


def test_paths_on_the_command_line_are_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = words_of(MatchOptions(masks=MaskOptions(mask_path="masks")))
    assert words == [f"--mask_path={tmp_path / 'masks'}"]
