"""Options of image pairs, links and two-view geometries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# A fundamental matrix needs seven matches; the eighth is the first that can contradict it.
MIN_MATCHES = 8


@dataclass(frozen=True)
class PairOptions(Options):
    """Which image pairs are written.

    Examples:
        >>> from colmap_av1 import MatchOptions, PairOptions
        >>> options = MatchOptions(pairs=PairOptions(offsets=(1, 2, 4, 8)))
        >>> options.pairs.offsets
        (1, 2, 4, 8)
    """

    title: ClassVar[str] = "image pairs"

    offsets: tuple[int, ...] = option(
        (1, 2, 3, 4, 5, 6, 8, 10),
        "distances in images at which every image is paired",
        least=1,
    )
    growth: float = option(
        1.4,
        "beyond the last offset, each distance is this factor times the previous one, up to the "
        "longest at which images share enough tracks; 1: no pairs beyond the last offset",
        least=1,
    )
    max_span: int | None = option(
        None,
        "largest distance in images between the images of a pair; None: as far as tracks reach",
        least=1,
    )
    min_matches: int = option(15, "fewest tracks that the images of a pair share", least=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.offsets:
            raise OptionError("offsets is (): give one or more distances")


@dataclass(frozen=True)
class LinkOptions(Options):
    """SIFT links between images that motion does not connect.

    Examples:
        >>> from colmap_av1 import LinkOptions, MatchOptions
        >>> options = MatchOptions(links=LinkOptions("none"))
        >>> options.links.links
        'none'
    """

    title: ClassVar[str] = "links"

    links: Literal["auto", "none", "sift"] = option(
        "auto",
        "auto: match SIFT features across gaps in the motion, where the camera moves fast or few "
        "points join the images, and, in videos much longer than tracks reach, at loop closures; "
        "sift: look for loop closures in any video; none: use motion alone",
        common=True,
    )
    max_link_features: int = option(1500, "largest number of features of a picture", least=50)
    link_candidates: int = option(
        10, "number of most similar images with which each key image is matched", least=1
    )


@dataclass(frozen=True)
class VerifyOptions(Options):
    """How matches are verified; the thresholds of two-view geometries are COLMAP's defaults.

    Examples:
        >>> from colmap_av1 import MatchOptions, VerifyOptions
        >>> options = MatchOptions(verify=VerifyOptions("pairs"))
        >>> options.verify.verify
        'pairs'
    """

    title: ClassVar[str] = "two-view geometry"

    verify: Literal["auto", "joint", "pairs"] = option(
        "auto",
        "joint: estimate the poses of all images, as reconstruct does, and keep matches that agree "
        "with them; pairs: verify each image pair separately; auto: joint if images are written or "
        "exist and none of offsets, growth, max_span and single_camera 0 is given, else pairs",
        common=True,
    )
    max_error: float = option(
        4.0,
        "largest Sampson error (E, F) or transfer error (H) of an inlier, in pixels",
        above=0,
        unit="a number of pixels",
        colmap="TwoViewGeometry.max_error",
    )
    min_num_inliers: int = option(
        15,
        "fewest inliers of a two-view geometry",
        least=1,
        colmap="TwoViewGeometry.min_num_inliers",
    )
    min_e_f_inlier_ratio: float = option(
        0.95,
        "trust the focal length prior if the essential matrix has more than this fraction of the "
        "fundamental matrix's inliers",
        least=0,
        most=1,
        unit="a fraction",
    )
    max_h_inlier_ratio: float = option(
        0.8,
        "a pair is planar or panoramic if the homography has more than this fraction of the "
        "inliers",
        least=0,
        most=1,
        unit="a fraction",
    )
    max_samples: int = option(
        128,
        "number of matches, spread over the image, that the robust estimators use; a model is "
        "refined on more matches and tested on all",
        least=MIN_MATCHES,
    )
    max_iterations: int = option(
        10000,
        "largest number of iterations of the robust estimators",
        least=1,
        colmap="TwoViewGeometry.max_num_trials",
    )
    confidence: float = option(
        0.999,
        "probability of an outlier-free sample at which a robust estimator stops",
        least=0,
        most=1,
        unit="a probability",
        colmap="TwoViewGeometry.confidence",
    )
