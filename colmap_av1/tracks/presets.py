"""The presets: how many tracks are used, few for poses, more for maps, all for dense points."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from colmap_av1.options import DensityOptions


@dataclass(frozen=True)
class Limits:
    """The limits in force, see DensityOptions; 0 is none."""

    max_tracks_per_image: int
    spacing: float
    min_images: int
    max_sigma: float
    wide_tracks: int


# max_sigma is for images of every frame; where images lie n frames apart it is sqrt(n) times that,
# as errors grow from step to step.
PRESETS = {
    # Poses need wide baselines; points do not, and long tracks take a mapper's time.
    "sparse": Limits(1500, spacing=12.0, min_images=3, max_sigma=0.8, wide_tracks=1000),
    "default": Limits(3500, spacing=7.5, min_images=3, max_sigma=0.8, wide_tracks=300),
    "dense": Limits(0, spacing=0.0, min_images=1, max_sigma=0.0, wide_tracks=0),
}


def limits_of(options: DensityOptions) -> Limits:
    """The limits of the preset, with those of the options in place of its own."""
    names = [field.name for field in fields(Limits)]
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    return replace(PRESETS[options.preset], **given)
