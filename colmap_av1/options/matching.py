"""Options of image pairs and of their two-view geometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# A fundamental matrix takes seven matches; an eighth is the first that can disagree.
MIN_MATCHES = 8


@dataclass(frozen=True)
class PairOptions(Options):
    """Which image pairs are written."""

    title: ClassVar[str] = "image pairs"

    offsets: tuple[int, ...] = option(
        (1, 2, 3, 4, 5, 6, 8, 10),
        "distances, counted in images, at which every image is paired",
        least=1,
    )
    growth: float = option(
        1.4,
        "beyond the last offset each distance is this times the one before, up to the longest at "
        "which images still share enough tracks; 1: no pairs beyond the last offset",
        least=1,
    )
    max_span: int | None = option(
        None,
        "largest distance between the images of a pair, counted in images; None: as far as tracks "
        "reach",
        least=1,
    )
    min_matches: int = option(15, "fewest shared tracks of a pair", least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.offsets:
            raise OptionError("offsets is (): give one or more distances")


@dataclass(frozen=True)
class LinkOptions(Options):
    """Links by pictures, where motion does not connect images that see the same."""

    title: ClassVar[str] = "links"

    links: Literal["auto", "none", "sift"] = option(
        "auto",
        "auto: match pictures across gaps that motion does not carry over, where the camera moves "
        "fast and, in videos much longer than tracks reach, between places seen again; sift: look "
        "for places seen again in any video; none: use motion alone",
        common=True,
    )
    max_link_features: int = option(1500, "most features of a picture", least=50)
    link_candidates: int = option(
        10, "images most like it with which each key image is matched", least=1
    )


@dataclass(frozen=True)
class VerifyOptions(Options):
    """How matches are verified; the thresholds of two-view geometries are COLMAP's."""

    title: ClassVar[str] = "two-view geometry"
    colmap_prefix: ClassVar[str] = "TwoViewGeometry"

    verify: Literal["auto", "joint", "pairs"] = option(
        "auto",
        "joint: estimate the poses of all images, as reconstruct does, and match what agrees with "
        "them; pairs: verify each pair of images on its own matches; auto: joint if images are "
        "written or exist and neither pairs nor a camera per image are asked for, else pairs",
        common=True,
    )
    max_error: float = option(
        4.0,
        "largest Sampson error (E, F) or transfer error (H) of an inlier, in pixels",
        above=0,
        unit="a number of pixels",
    )
    min_num_inliers: int = option(15, "fewest inliers of a two-view geometry", least=1)
    min_e_f_inlier_ratio: float = option(
        0.95,
        "the focal length prior is trusted where the essential matrix has more than this fraction "
        "of the fundamental matrix's inliers",
        least=0,
        most=1,
        unit="a fraction",
    )
    max_h_inlier_ratio: float = option(
        0.8,
        "a pair is planar or panoramic where the homography has more than this fraction of the "
        "inliers",
        least=0,
        most=1,
        unit="a fraction",
    )
    max_samples: int = option(
        128,
        "matches, spread over the image, on which the robust estimators search; a model is "
        "refined on more of them and tested on all",
        least=MIN_MATCHES,
    )
    max_iterations: int = option(10000, "most iterations of the robust estimators", least=1)
    confidence: float = option(
        0.999,
        "probability of an outlier-free sample at which a robust estimator stops",
        least=0,
        most=1,
        unit="a probability",
    )
