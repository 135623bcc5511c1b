"""All front-ends by their names: one file each, behind the interface of `frontend`."""

from __future__ import annotations

from pathlib import Path

from colmap_av1.errors import OptionError
from colmap_av1.evaluate.frontends.av1 import av1_frontend
from colmap_av1.evaluate.frontends.footage import Footage
from colmap_av1.evaluate.frontends.frontend import (
    Frontend,
    FrontendRun,
    run_measured_frontend,
)
from colmap_av1.evaluate.frontends.learned import learned_frontend
from colmap_av1.evaluate.frontends.sift import exhaustive_sift, sequential_sift
from colmap_av1.options import LearnedOptions, MatchOptions


def make_frontends(
    match: MatchOptions | None = None, learned: LearnedOptions | None = None
) -> dict[str, Frontend]:
    """All front-ends by their names.

    Args:
        match: options of this package's; refinement and preset are those of the name.
        learned: options of the learned ones.
    """
    return {
        # What a mapper gets from the bitstream alone; `-refined` after a look at the pictures.
        "av1": av1_frontend("none", "default", match),
        "av1-sparse": av1_frontend("none", "sparse", match),
        "av1-dense": av1_frontend("none", "dense", match),
        "av1-refined": av1_frontend("lk", "default", match),
        "av1-refined-sparse": av1_frontend("lk", "sparse", match),
        "av1-refined-dense": av1_frontend("lk", "dense", match),
        "sift-sequential": sequential_sift(),
        "sift-exhaustive": exhaustive_sift(),
        "disk-lightglue": learned_frontend("disk", learned),
        "aliked-lightglue": learned_frontend("aliked", learned),
    }


FRONTENDS = make_frontends()


def run_frontend(
    name: str, footage: Footage, folder: Path, frontend: Frontend | None = None
) -> FrontendRun:
    """Fill a database and measure what it takes; a finished run is not repeated.

    Args:
        name: one of FRONTENDS, or the name of `frontend`.
        footage: video and images.
        folder: gets `database.db`, `log.txt` and the figures.
        frontend: the front-end, where it is none of FRONTENDS.

    Raises:
        OptionError: there is no such front-end.
        ColmapAv1Error: the front-end refuses the footage.
        EvaluationError: it failed.
    """
    if frontend is None:
        if name not in FRONTENDS:
            raise OptionError(f"front-end '{name}': give one of {', '.join(FRONTENDS)}")
        frontend = FRONTENDS[name]
    return run_measured_frontend(name, footage, folder, frontend)
