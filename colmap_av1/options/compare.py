"""Options of a comparison with other front-ends."""

from __future__ import annotations

import string
from dataclasses import dataclass
from typing import ClassVar

from colmap_av1.errors import OptionError
from colmap_av1.options.commands import MatchOptions
from colmap_av1.options.fields import Options, option, part
from colmap_av1.options.model import TriangulateOptions

# The trainer that is built in; others are shell commands with these placeholders.
GSPLAT = "gsplat"
PLACEHOLDERS = ("data", "test", "output", "renders", "iterations", "name")


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
        unused=("density", "on_existing", "refine.refine", "camera.single_camera"),
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
        "trains 3D Gaussians on half of each model's images: gsplat, which needs CUDA, or a shell "
        "command with {data}, the folder of that half, and as needed {test}, that of the other "
        "half, {output}, {renders}, which receives the renderings of the test images, {iterations} "
        "and {name}",
        common=True,
    )
    iterations: int = option(30_000, "iterations of the training", least=1)
    milestones: tuple[int, ...] = option(
        (1000, 3000, 7000, 15_000),
        "iterations after which gsplat's renderings are measured as well",
        least=1,
    )
    split: bool = option(False, "write the two halves even where nothing is trained")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.trainer is not None:
            _check_trainer(self.trainer)


def _check_trainer(trainer: str) -> None:
    """Refuse a command whose placeholders are unknown."""
    if trainer == GSPLAT:
        return
    known = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
    try:
        fields = {name for _, name, _, _ in string.Formatter().parse(trainer) if name is not None}
    except ValueError as error:
        raise OptionError(f"trainer '{trainer}': {error}: write {{{{ for a brace") from error
    if not fields <= set(PLACEHOLDERS) or "data" not in fields:
        raise OptionError(
            f"trainer '{trainer}': give '{GSPLAT}', or a command with {{data}} and others of "
            f"{known}"
        )
