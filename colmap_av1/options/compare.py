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

# The built-in trainer. Other trainers are commands with these placeholders.
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
# Programs that execute the word after -c.
_SHELL = re.compile(r"(.*/)?((ba|da|k|z)?sh|python[0-9.]*)")
# Words that only a shell interprets.
_OPERATOR = re.compile(r"&|&&|\||\|\||;|\d*[<>].*")


@dataclass(frozen=True)
class LearnedOptions(Options):
    """How learned features are extracted and matched for a comparison.

    Examples:
        >>> from colmap_av1 import CompareOptions, LearnedOptions
        >>> options = CompareOptions(learned=LearnedOptions(max_keypoints=4096))
        >>> options.learned.max_keypoints
        4096
    """

    title: ClassVar[str] = "learned features"

    max_keypoints: int = option(2048, "largest number of keypoints per image", least=16)
    max_image_size: int = option(
        1024, "images are scaled down to this many pixels along the longer side", least=64
    )
    learned_every: int = option(
        1, "match only every n-th image; the others are not registered", least=1
    )
    learned_offsets: tuple[int, ...] | None = option(
        None,
        "distances between the images of a pair, counted in matched images; None: all pairs of up "
        "to 30 images, else 1,2,4,8",
        least=1,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learned_offsets == ():
            raise OptionError("learned_offsets is (): give one or more distances, or None")


@dataclass(frozen=True)
class CompareOptions(Options):
    """Options of `compare`, with those of `match` except track selection and existing rows.

    Examples:
        >>> from colmap_av1 import CompareOptions
        >>> options = CompareOptions(frontends=("av1", "sift-sequential"))
        >>> options.frontends
        ('av1', 'sift-sequential')
    """

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
        "aliked-lightglue; and NAME=FEATURES.h5:MATCHES.h5 for matches of other programs in hloc's "
        "format",
        common=True,
    )
    all_tracks: bool = option(
        True, "for each model of this package, add one with all tracks and the same poses"
    )
    trainer: str | None = option(
        None,
        "train 3D Gaussians on half of each model's images: gsplat, which needs CUDA, or a command "
        "with {data}, the folder of that half. Further placeholders: {test}, the folder of the "
        "other half; {gaussians}, a .ply of initial Gaussians; {output}; {renders}, the folder for "
        "renderings of the test images; {iterations}; {milestones}, such as 1000,3000, after which "
        "to render into {renders}/1000 and so on; {name}. No shell is used unless the command is "
        "sh -c 'LINE' sh {data} ..., where LINE uses \"$1\"",
        common=True,
    )
    iterations: int = option(30_000, "iterations of the training", least=1)
    milestones: tuple[int, ...] = option(
        (1000, 3000, 7000, 15_000),
        "also measure renderings after these iterations, with gsplat or a command with "
        "{milestones}",
        least=1,
    )
    split: bool = option(False, "write the two halves even without training")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.trainer is not None and self.trainer != GSPLAT:
            words_of_trainer(self.trainer)


def words_of_trainer(trainer: str) -> list[str]:
    """Split a trainer's command into words as a shell does, and check its placeholders.

    Raises:
        OptionError: the command cannot be split, a placeholder is unknown or has a format, {data}
            is missing, the command needs a shell, or a shell would execute a value as code.
    """
    known = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
    remedy = "quote it as for a shell"
    try:
        words = shlex.split(trainer)
        remedy = "write {{ for a brace"
        fields = [field for word in words for field in _fields(word)]
    except ValueError as error:
        raise OptionError(f"trainer '{trainer}': {error}: {remedy}") from error
    names = {name for name, _, _ in fields}
    if not names <= set(PLACEHOLDERS) or "data" not in names:
        raise OptionError(
            f"trainer '{trainer}' lacks {{data}} or has an unknown placeholder: give '{GSPLAT}', "
            f"or a command with {{data}} and any of {known}"
        )
    formatted = next((name for name, spec, conversion in fields if spec or conversion), None)
    if formatted is not None:
        raise OptionError(f"trainer '{trainer}': {{{formatted}}} has a format: give it without one")
    _check_shell(trainer, words)
    return words


def _fields(word: str) -> list[tuple[str, str | None, str | None]]:
    """Name, format and conversion of each placeholder in a word."""
    parsed = string.Formatter().parse(word)
    return [(name, spec, conversion) for _, name, spec, conversion in parsed if name is not None]


def _check_shell(trainer: str, words: list[str]) -> None:
    """Raise if the command needs a shell, or has a placeholder inside a shell's code."""
    example = 'sh -c \'train "$1" && render "$1" "$2"\' sh {data} {renders}'
    shell = next((i for i, word in enumerate(words) if _SHELL.fullmatch(word)), len(words))
    option = next((i for i in range(shell, len(words)) if re.match(r"-\w*c", words[i])), len(words))
    if any(_fields(line) for line in words[option + 1 : option + 2]):
        raise OptionError(
            f"trainer '{trainer}': {words[shell]} would execute a folder's name as code: give "
            f"placeholders after the code, as in {example}"
        )
    operator = next((word for word in words if _OPERATOR.fullmatch(word)), None)
    if operator is not None:
        raise OptionError(
            f"trainer '{trainer}': {operator} needs a shell, and none is used: call one, as in "
            f"{example}"
        )
