"""Options of chaining motion into tracks, refining these and selecting among them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from colmap_av1.errors import OptionError
from colmap_av1.options.fields import Options, option

# Width in pixels of the units that motion is coded for, and of the squares that divide them.
_CELLS = (4, 2, 1)
_LARGEST_WINDOW = 101  # a template of each track is kept in memory


@dataclass(frozen=True)
class TrackOptions(Options):
    """How displacements are chained into tracks."""

    title: ClassVar[str] = "tracks"

    min_length: int | None = option(
        None,
        "shortest track, in shown frames of the video; None: 4, but 3, or min_observations where "
        "that is less, for tracks that contribute only points to a dense model",
        least=1,
    )
    cosine: float | None = option(
        0.3,
        "end a track where the space-time cosine between its motion and the motion predicted from "
        "the step before falls below this; None: never",
        least=-1,
        most=1,
    )
    cosine_relative_to: Literal["dominant", "none"] = option(
        "dominant",
        "dominant: the prediction follows changes of the frame's dominant motion, so that a "
        "shaking camera ends no track; none: it assumes constant motion",
    )
    cosine_scale: float = option(
        1.0,
        "time component of the space-time vectors, in pixels per shown frame: motion well below "
        "it has no direction to test",
        least=0,
        unit="pixels",
    )
    max_interval: int | None = option(
        16, "longest step of a displacement, in shown frames; None: any", least=0
    )
    max_block_area: int | None = option(
        1024,
        "largest block whose motion is trusted, in px^2, but for blocks that move as nearly all of "
        "the picture does, by one affine motion: of a camera that stands still, or sees something "
        "flat; None: any",
        least=0,
    )
    max_uncoded_block_area: int | None = option(
        1024,
        "the same for blocks without coded residual, whose prediction the encoder never corrected",
        least=0,
    )
    smoothness: float | None = option(
        4.0,
        "reject a block whose displacement d differs by more than this many pixels plus |d|/8 "
        "times as many from that of most units around it; None: no such test",
        least=0,
    )
    border: float | None = option(
        14.0,
        "reject motion that starts or ends within this many pixels of the picture's edge, where "
        "the encoder had only padding to compare with; None: trust all",
        least=0,
    )
    interpolation: float | None = option(
        1.5,
        "interpolate motion within a block towards neighbouring blocks whose displacements differ "
        "by less than this many pixels; None: a block moves as one",
        least=0,
    )
    bridge: float | None = option(
        2.0,
        "continue tracks across blocks without motion, such as intra blocks, and across gaps "
        "between displaced blocks, where the motion on either side differs by less than this many "
        "pixels; None: end them there",
        least=0,
    )
    cell: int | None = option(
        None,
        "width in pixels of the squares of a frame that hold one track each: where two tracks "
        "meet in one, the longer is kept. None: 4, or 2 for points of a dense model where motion "
        "is searched in pictures of full size, or that of seeding where it is less",
        among=_CELLS,
        unit="pixels",
    )
    seeding: int = option(
        4,
        "width in pixels of the squares of a frame in which a track is started where they hold "
        "none, not less than cell. Motion is coded for squares of 4; of 8, tracks are a quarter as "
        "many",
        among=(8, *_CELLS),
        unit="pixels",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cell is not None and self.seeding < self.cell:
            raise OptionError(
                f"seeding is {self.seeding}, below cell {self.cell}: squares that tracks start in "
                "cannot be smaller than those that hold one: give a smaller cell"
            )


@dataclass(frozen=True)
class RefineOptions(Options):
    """How track positions are corrected on decoded pictures."""

    title: ClassVar[str] = "refinement"

    refine: Literal["none", "lk"] = option(
        "none",
        "lk: correct track positions to subpixel accuracy by Lucas-Kanade on the decoded pictures; "
        "none: decode nothing",
        common=True,
    )
    refine_window: int = option(
        9, "width in pixels of the window that is matched, odd", least=5, most=_LARGEST_WINDOW
    )
    refine_move: float = option(
        1.5, "largest correction of a position along either axis, in pixels", above=0, unit="pixels"
    )
    refine_difference: float = option(
        0.25,
        "largest mean difference of two windows that match, as a fraction of their contrast",
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
    """How many of the tracks are used; options that are None are set by the preset."""

    title: ClassVar[str] = "selection of tracks"

    preset: Literal["sparse", "default", "dense"] = option(
        "default",
        "sparse: few tracks, the most accurate, for poses; default: for maps; dense: all tracks",
        common=True,
    )
    max_tracks_per_image: int | None = option(
        None, "most tracks of an image, the most accurate first; 0: any number", least=0
    )
    spacing: float | None = option(
        None,
        "width in pixels of the cells of an image that one track each is selected for; 0: no cells",
        least=0,
    )
    min_images: int | None = option(
        None, "fewest images with an observation of a track (min_length counts frames)", least=0
    )
    max_sigma: float | None = option(
        None,
        "largest standard deviation of a position relative to the track's first one, in pixels; "
        "0: any",
        least=0,
    )
    wide_tracks: int | None = option(
        None,
        "further tracks of each image for wide baselines: those that moved nearly as far as any, "
        "with errors up to a thirtieth of that distance; 0: none",
        least=0,
    )
