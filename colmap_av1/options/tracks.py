"""Options of chaining motion into tracks, refining them and selecting among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# Widths in pixels of the cells that hold one track each: motion is coded in units of 4 px.
_CELLS = (4, 2, 1)
_LARGEST_WINDOW = 101  # in pixels; a template of each track is kept in memory


@dataclass(frozen=True)
class TrackOptions(Options):
    """How displacements are chained into tracks.

    Examples:
        >>> from colmap_av1 import MatchOptions, TrackOptions
        >>> options = MatchOptions(tracks=TrackOptions(min_length=6))
        >>> options.tracks.min_length
        6
    """

    title: ClassVar[str] = "tracks"

    min_length: int | None = option(
        None,
        "shortest track, in shown frames of the video; None: 4, or for tracks that only add points "
        "to a dense model the smaller of 3 and min_observations",
        least=1,
    )
    cosine: float | None = option(
        0.3,
        "end a track if the space-time cosine between its motion and the motion predicted from "
        "the previous step falls below this; None: never",
        least=-1,
        most=1,
    )
    cosine_relative_to: Literal["dominant", "none"] = option(
        "dominant",
        "dominant: the prediction follows changes of the frame's dominant motion, so that a "
        "shaking camera does not end tracks; none: the prediction assumes constant motion",
    )
    cosine_scale: float = option(
        1.0,
        "time component of the space-time vectors, in pixels per shown frame; the direction of "
        "motion well below it is not tested",
        least=0,
        unit="pixels",
    )
    max_interval: int | None = option(
        16, "longest step of a displacement, in shown frames; None: no limit", least=0
    )
    max_block_area: int | None = option(
        1024,
        "largest block whose motion is trusted, in px^2, except for blocks that follow an affine "
        "motion of nearly the whole picture, as with a still camera or a flat scene; None: no "
        "limit",
        least=0,
    )
    max_uncoded_block_area: int | None = option(
        1024,
        "max_block_area of blocks without coded residual, whose prediction the encoder never "
        "corrected",
        least=0,
    )
    smoothness: float | None = option(
        4.0,
        "reject a block whose displacement d differs from that of most units around it by more "
        "than this many pixels times (1 + |d|/8); None: no such test",
        least=0,
    )
    border: float | None = option(
        14.0,
        "reject motion that starts or ends within this many pixels of the picture's edge, where "
        "the encoder compares with padding; None: trust all",
        least=0,
    )
    interpolation: float | None = option(
        1.5,
        "interpolate motion within a block towards neighbouring blocks whose displacements differ "
        "by less than this many pixels; None: the whole block has one motion",
        least=0,
    )
    bridge: float | None = option(
        2.0,
        "continue tracks across blocks without motion, such as intra blocks, and across gaps "
        "between displaced blocks, if the motion on either side differs by less than this many "
        "pixels; None: end them there",
        least=0,
    )
    cell: int | None = option(
        None,
        "width in pixels of the cells of a frame that hold one track each; if two tracks meet in a "
        "cell, the longer is kept. None: 4, or 2 for points of a dense model if motion is searched "
        "in pictures of full size, but at most seeding",
        among=_CELLS,
        unit="pixels",
    )
    seeding: int = option(
        4,
        "width in pixels of the squares of a frame in which a track is started if they hold none, "
        "not less than cell. Motion is coded in units of 4; 8 gives a quarter of the tracks",
        among=(8, *_CELLS),
        unit="pixels",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cell is not None and self.seeding < self.cell:
            raise OptionError(
                f"seeding is {self.seeding}, less than cell, {self.cell}: give a smaller cell or a "
                "larger seeding"
            )


@dataclass(frozen=True)
class RefineOptions(Options):
    """How track positions are refined on decoded pictures.

    Examples:
        >>> from colmap_av1 import MatchOptions, RefineOptions
        >>> options = MatchOptions(refine=RefineOptions("lk"))
        >>> options.refine.refine
        'lk'
    """

    title: ClassVar[str] = "refinement"

    refine: Literal["none", "lk"] = option(
        "none",
        "lk: refine track positions to subpixel accuracy by Lucas-Kanade on the decoded pictures; "
        "none: decode no pictures",
        common=True,
    )
    refine_window: int = option(
        9, "width of the matched window in pixels, odd", least=5, most=_LARGEST_WINDOW
    )
    refine_move: float = option(
        1.5, "largest correction of a position along either axis, in pixels", above=0, unit="pixels"
    )
    refine_difference: float = option(
        0.25,
        "largest mean difference of two matched windows, as a fraction of their contrast",
        above=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.refine_window % 2 == 0:
            raise OptionError(
                f"refine_window is {self.refine_window}: give an odd number from 5 to "
                f"{_LARGEST_WINDOW}"
            )


@dataclass(frozen=True)
class DensityOptions(Options):
    """Which tracks are used; options that are None are set by the preset.

    Examples:
        >>> from colmap_av1 import DensityOptions, MatchOptions
        >>> options = MatchOptions(density=DensityOptions("sparse"))
        >>> options.density.preset
        'sparse'
    """

    title: ClassVar[str] = "selection of tracks"

    preset: Literal["sparse", "default", "dense"] = option(
        "default",
        "sparse: the few most accurate tracks, for poses; default: for maps; dense: all tracks",
        common=True,
    )
    max_tracks_per_image: int | None = option(
        None, "largest number of tracks per image, the most accurate first; 0: no limit", least=0
    )
    spacing: float | None = option(
        None,
        "width in pixels of the cells of an image, each of which selects one track; values below 1 "
        "count as 1; 0: no cells",
        least=0,
    )
    min_images: int | None = option(
        None, "fewest images that observe a track (min_length counts frames)", least=0
    )
    max_sigma: float | None = option(
        None,
        "largest standard deviation of a position relative to the track's first one, in pixels; "
        "0: no limit",
        least=0,
    )
    wide_tracks: int | None = option(
        None,
        "number of further tracks per image for wide baselines: tracks that moved nearly the "
        "farthest, with errors up to a thirtieth of that distance; 0: none",
        least=0,
    )
