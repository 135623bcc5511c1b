"""Options of a comparison with other front-ends."""

from __future__ import annotations

import re
import shlex
import string
from dataclasses import dataclass
from typing import ClassVar

from colmap_av1.errors import OptionError
from colmap_av1.options.commands import MatchOptions
from colmap_av1.options.fields import Options, option, part
from colmap_av1.options.model import TriangulateOptions

# The trainer that is built in; others are commands with these placeholders.
GSPLAT = "gsplat"
PLACEHOLDERS = (
    "data",
    "test",
    "gaussians",
    "output",
    "renders",
    "iterations",
    "milestones",
    "name",
)
# Programs that run the word after -c.
_SHELL = re.compile(r"(.*/)?((ba|da|k|z)?sh|python[0-9.]*)")
# Words that only a shell understands.
_OPERATOR = re.compile(r"&|&&|\||\|\||;|\d*[<>].*")


@dataclass(frozen=True)
class LearnedOptions(Options):
    """How learned features are extracted and matched for a comparison."""

    title: ClassVar[str] = "learned features"

    max_keypoints: int = option(2048, "most keypoints of an image", least=16)
    max_image_size: int = option(
        1024, "images are scaled down to this many pixels along the longer side", least=64
    )
    learned_every: int = option(
        1, "match every n-th image only; the others are left without a pose", least=1
    )
    learned_offsets: tuple[int, ...] | None = option(
        None,
        "distances between the images of a pair, counted in images that are matched; None: all "
        "pairs of up to 30 images, else 1,2,4,8",
        least=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learned_offsets == ():
            raise OptionError("learned_offsets is (): give one or more distances, or None")


@dataclass(frozen=True)
class CompareOptions(Options):
    """Options of `compare`; those of `match` apply but for track selection and existing rows."""

    title: ClassVar[str] = "comparison"

    match: MatchOptions = part(
        MatchOptions(),
        unused=("density", "masks", "on_existing", "refine.refine", "camera.single_camera"),
    )
    learned: LearnedOptions = part(LearnedOptions())
    triangulate: TriangulateOptions = part(TriangulateOptions())
    frontends: tuple[str, ...] = option(
        ("av1", "av1-refined", "sift-exhaustive", "sift-sequential"),
        "front-ends to compare, in this order: av1, av1-sparse, av1-dense, av1-refined, "
        "av1-refined-sparse, av1-refined-dense, sift-exhaustive, sift-sequential, disk-lightglue, "
        "aliked-lightglue, and matches of other programs in hloc's layout as "
        "NAME=FEATURES.h5:MATCHES.h5",
        common=True,
    )
    all_tracks: bool = option(
        True, "for each of this package's models, add one with all tracks on the same poses"
    )
    trainer: str | None = option(
        None,
        "trains 3D Gaussians on half of each model's images: gsplat, which needs CUDA, or a "
        "command with {data}, the folder of that half, and as needed {test}, that of the other "
        "half, {gaussians}, a .ply of initial Gaussians of the points, {output}, {renders}, which "
        "receives the renderings of the test images, {iterations}, {milestones}, as in 1000,3000, "
        "after each of which it then renders into {renders}/1000 and so on, and {name}; a shell "
        "reads it only where it is sh -c 'LINE' sh {data} ..., \"$1\" in LINE",
        common=True,
    )
    iterations: int = option(30_000, "iterations of the training", least=1)
    milestones: tuple[int, ...] = option(
        (1000, 3000, 7000, 15_000),
        "iterations after which renderings are measured as well, of gsplat or of a command with "
        "{milestones}",
        least=1,
    )
    split: bool = option(False, "write the two halves even where nothing is trained")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.trainer is not None and self.trainer != GSPLAT:
            words_of_trainer(self.trainer)


def words_of_trainer(trainer: str) -> list[str]:
    """The words of a trainer's command, split as a shell does, with their placeholders.

    Raises:
        OptionError: it cannot be split, a placeholder is unknown or has a format, {data} is
            missing, or a shell would have to read it, or would read a value as code.
    """
    known = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
    way_out = "quote it as for a shell"
    try:
        words = shlex.split(trainer)
        way_out = "write {{ for a brace"
        fields = [field for word in words for field in _fields(word)]
    except ValueError as error:
        raise OptionError(f"trainer '{trainer}': {error}: {way_out}") from error
    names = {name for name, _, _ in fields}
    if not names <= set(PLACEHOLDERS) or "data" not in names:
        raise OptionError(
            f"trainer '{trainer}': give '{GSPLAT}', or a command with {{data}} and others of "
            f"{known}"
        )
    formatted = next((name for name, spec, conversion in fields if spec or conversion), None)
    if formatted is not None:
        raise OptionError(f"trainer '{trainer}': give {{{formatted}}} without a format")
    _check_shell(trainer, words)
    return words


def _fields(word: str) -> list[tuple[str, str | None, str | None]]:
    """Name, format and conversion of each placeholder in a word."""
    parsed = string.Formatter().parse(word)
    return [(name, spec, conversion) for _, name, spec, conversion in parsed if name is not None]


def _check_shell(trainer: str, words: list[str]) -> None:
    """Refuse a command that only a shell understands, and values within a shell's line."""
    example = 'sh -c \'train "$1" && render "$1" "$2"\' sh {data} {renders}'
    shell = next((i for i, word in enumerate(words) if _SHELL.fullmatch(word)), len(words))
    option = next((i for i in range(shell, len(words)) if re.match(r"-\w*c", words[i])), len(words))
    if any(_fields(line) for line in words[option + 1 : option + 2]):
        raise OptionError(
            f"trainer '{trainer}': {words[shell]} would take a folder's name for code: give "
            f"placeholders after its line, as in {example}"
        )
    operator = next((word for word in words if _OPERATOR.fullmatch(word)), None)
    if operator is not None:
        raise OptionError(
            f"trainer '{trainer}': no shell reads it, so {operator} means nothing: ask for one, "
            f"as in {example}"
        )
