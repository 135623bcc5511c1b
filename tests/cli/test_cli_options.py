"""Options on the command line are checked before anything is opened, grouped and named."""

from __future__ import annotations

import argparse
import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest

from colmap_av1.cli import main
from colmap_av1.cli.options import add_options, given
from colmap_av1.cli.parser import Parser
from colmap_av1.options import (
    CompareOptions,
    DensifyOptions,
    DensityOptions,
    MatchOptions,
    ReadOptions,
    ReconstructOptions,
    RunOptions,
    TrackOptions,
)
from colmap_av1.options.fields import Options, option, part

DATABASE, OUTPUT, VIDEO = ("--database", "a.db"), ("--output", "out"), ("--video", "none.mp4")
NEEDED = {
    "match": (*VIDEO, *DATABASE),
    "map": (*DATABASE, *OUTPUT, "--image_path", "none"),
    "reconstruct": (*VIDEO, *OUTPUT),
    "densify": (*VIDEO, *OUTPUT, "--model", "none"),
    "compare": (*VIDEO, *OUTPUT),
    "encode": (*VIDEO, *OUTPUT),
    "info": VIDEO,
    "motion": (*VIDEO, *OUTPUT),
    "export": (*DATABASE, *OUTPUT),
    "view": (*VIDEO, *OUTPUT),
}

# Command, option and invalid value.
BAD = [
    ("match", "num_images", "1"),
    ("match", "image_name", "x.png"),
    ("match", "encoder", "x"),
    ("match", "TwoViewGeometry.confidence", "2"),
    ("match", "ImageReader.camera_model", "PINHOL"),
    ("match", "camera_params", "1,2"),
    ("match", "random_seed", "-1"),
    ("match", "on_existing", "keep"),
    ("map", "mapper", "auto"),
    ("reconstruct", "mapper", "best"),
    ("reconstruct", "image_name", "a.b_%d.png"),
    ("densify", "min_observations", "1"),
    ("compare", "trainer", "train"),
    ("compare", "frontends", "surf"),
    ("encode", "encoder", "x"),
    ("info", "operating_point", "32"),
    ("motion", "num_threads", "0"),
    ("view", "draw", "arrows"),
]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("command", "name", "value"), BAD)
def test_invalid_options_are_refused_before_anything_is_opened(
    command: str, name: str, value: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, *NEEDED[command], f"--{name}", value]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("colmap-av1: error: ")
    assert err.count("\n") == 1
    assert value in err
    assert "no such file" not in err
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("match --num_image 5", "--num_images?"),
        ("match --num-image=5", "--num_images?"),
        ("match --vidoe a.mp4", "--video?"),
        ("reconstruct --preset sparse", "--preset"),
        ("densify --zzzzzzzzz 1", "--zzzzzzzzz"),
        ("info --video a.mp4 b.mp4", "b.mp4"),
        ("info --video a.mp4 -q", "-q"),
        ("view --video", "--video"),
    ],
)
def test_error_for_unknown_options_suggests_the_nearest_one(
    words: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    err = capsys.readouterr().err
    assert named in err
    assert f"colmap-av1 {words.split(maxsplit=1)[0]} --help" in err
    assert err.count("\n") == 1


def help_of(command: str, word: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit, match="0"):
        main([command, word])
    return capsys.readouterr().out


def options_in(text: str) -> set[str]:
    lines = [line for line in text.splitlines() if line.startswith("  -")]
    return set(re.findall(r"--([a-z_-]+)", "\n".join(lines)))


@pytest.mark.parametrize("command", ["encode", "info", "motion", "check", "export", "map"])
def test_help_all_equals_help_of_commands_with_few_options(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert help_of(command, "--help-all", capsys) == help_of(command, "--help", capsys)


@pytest.mark.parametrize("command", ["match", "reconstruct", "densify", "compare", "view"])
def test_help_shows_few_options_and_help_all_shows_all(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    short, full = help_of(command, "--help", capsys), help_of(command, "--help-all", capsys)
    few, every = options_in(short), options_in(full)
    assert few < every
    assert len(every) > 1.5 * len(few)
    assert (
        len(few - {"help", "help-all", "database_path", "video_path", "output_path", "dynamic"})
        <= 25
    )
    assert {"help", "help-all", "quiet"} <= few
    assert options_in(help_of(command, "--help_all", capsys)) == every


def test_help_of_other_commands_is_complete(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of("info", "--help", capsys)
    assert {"operating_point", "num_threads", "strict", "max_frame_size"} <= options_in(text)
    assert "help-all" not in text


def test_help_has_a_group_for_each_kind_of_options(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of("reconstruct", "--help-all", capsys)
    titles = [line[:-1] for line in text.splitlines() if re.fullmatch(r"\w.*:", line)]
    assert titles[:4] == ["options", "reconstruction", "database and stream", "images"]
    assert {"tracks", "two-view geometry", "poses", "points", "run"} <= set(titles)
    assert "selection of tracks" not in titles
    assert "Shown frames" not in text
    assert "%" in text  # in frame_%06d.png, not interpreted as a format


def parse(words: str, kind: type[Options]) -> Options:
    command = Parser(prog="test")
    add_options(command, kind)
    return given(command.parse_args(words.split()), kind)


def test_nested_options_are_built_from_arguments() -> None:
    words = "--min_length 6 --min_images 2 --num_threads 3 --random_seed 4 --strict --fps 2"
    options = parse(words, MatchOptions)
    assert isinstance(options, MatchOptions)
    assert options.tracks == TrackOptions(min_length=6)
    assert options.density == DensityOptions(min_images=2)
    assert options.run == RunOptions(num_threads=3, seed=4)
    assert options.read == ReadOptions(strict=True)
    assert options.reading == ReadOptions(strict=True, num_threads=3)
    assert options.images.fps == 2
    assert parse("", CompareOptions) == CompareOptions()
    made = parse("--mapper global --points survey --min_angle 3 --cell 2", ReconstructOptions)
    assert isinstance(made, ReconstructOptions)
    assert (made.poses.mapper, made.triangulate.min_angle) == ("global", 3)
    assert made.match.tracks.cell == 2


def test_min_length_does_not_set_min_images() -> None:
    options = parse("--min_length 6", MatchOptions)
    assert isinstance(options, MatchOptions)
    assert options.density == DensityOptions()


def test_names_of_colmap_and_of_earlier_versions_are_accepted() -> None:
    words = (
        "--ImageReader.camera_model PINHOLE --ImageReader.single_camera 0 "
        "--TwoViewGeometry.max_error 3 --TwoViewGeometry.min_num_inliers 20 "
        "--TwoViewGeometry.max_num_trials 50 --seed 5 --num_threads 2"
    )
    options = parse(words, MatchOptions)
    assert isinstance(options, MatchOptions)
    assert options.camera.camera_model == "PINHOLE"
    assert not options.camera.single_camera
    assert (options.verify.max_error, options.verify.min_num_inliers) == (3, 20)
    assert options.verify.max_iterations == 50
    assert options.run == RunOptions(num_threads=2, seed=5)
    assert parse("--seed 5", MatchOptions) == parse("--random_seed 5", MatchOptions)


@pytest.mark.parametrize(
    ("kind", "unused"),
    [
        (DensifyOptions, "--num_images 3"),
        (DensifyOptions, "--camera_model PINHOLE"),
        (DensifyOptions, "--random_seed 1"),
        (ReconstructOptions, "--preset dense"),
        (ReconstructOptions, "--on_existing append"),
        (CompareOptions, "--refine lk"),
        (CompareOptions, "--single_camera 0"),
    ],
)
def test_options_without_effect_are_not_offered(kind: type[Options], unused: str) -> None:
    with pytest.raises(SystemExit):
        parse(unused, kind)


@dataclass(frozen=True)
class _Filter(Options):
    title: ClassVar[str] = "filter"

    strength: float = option(0.5, "how strongly; None: never said", above=0)


@dataclass(frozen=True)
class _Everything(Options):
    title: ClassVar[str] = "everything"

    first: _Filter = part(_Filter(strength=2.0))
    names: tuple[str, ...] = option(("a", "b"), "what to 100%", common=True)


def test_options_are_derived_from_fields() -> None:
    assert parse("", _Everything) == _Everything()
    assert parse("--strength 3 --names c,d", _Everything) == _Everything(_Filter(3.0), ("c", "d"))
    command = Parser(prog="test")
    add_options(command, _Everything)
    text = command.format_help()
    assert "how strongly; none: never said [2]" in text
    assert "what to 100% [a,b]" in text
    assert [field.name for field in dataclasses.fields(_Everything)] == ["first", "names"]


def test_one_name_cannot_set_two_options() -> None:
    @dataclass(frozen=True)
    class _Twice(Options):
        first: _Filter = part(_Filter())
        strength: float = option(1.0, "another")

    command = Parser(prog="test")
    with pytest.raises(argparse.ArgumentError, match="--strength"):
        add_options(command, type("Twice", (_Twice,), {"__module__": __name__}))
