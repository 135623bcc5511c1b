"""All front-ends by name."""

from __future__ import annotations

from colmap_av1.evaluate.frontends.av1 import av1_frontend
from colmap_av1.evaluate.frontends.frontend import Frontend
from colmap_av1.evaluate.frontends.learned import learned_frontend
from colmap_av1.evaluate.frontends.sift import sift_frontend
from colmap_av1.options import LearnedOptions, MatchOptions


def make_frontends(
    match: MatchOptions = MatchOptions(), learned: LearnedOptions = LearnedOptions()
) -> dict[str, Frontend]:
    """All front-ends by name.

    Args:
        match: options of this package's front-ends, except refinement and preset.
        learned: options of the learned front-ends.
    """
    return {
        # "av1-refined" refines tracks in the decoded pictures.
        "av1": av1_frontend("none", "default", match),
        "av1-sparse": av1_frontend("none", "sparse", match),
        "av1-dense": av1_frontend("none", "dense", match),
        "av1-refined": av1_frontend("lk", "default", match),
        "av1-refined-sparse": av1_frontend("lk", "sparse", match),
        "av1-refined-dense": av1_frontend("lk", "dense", match),
        "sift-sequential": sift_frontend("sequential"),
        "sift-exhaustive": sift_frontend("exhaustive"),
        "disk-lightglue": learned_frontend("disk", learned),
        "aliked-lightglue": learned_frontend("aliked", learned),
    }
