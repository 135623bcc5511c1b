"""This package's `match` as a front-end."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

from colmap_av1.evaluate.frontends.footage import Footage, frame_list
from colmap_av1.evaluate.frontends.frontend import Filled, Frontend
from colmap_av1.match import match
from colmap_av1.options import ImageOptions, MatchOptions

Preset = Literal["sparse", "default", "dense"]


def av1_frontend(refine: Literal["none", "lk"], preset: Preset, options: MatchOptions) -> Frontend:
    """This package's `match`, with the given options except refinement and preset."""
    given = replace(
        options,
        refine=replace(options.refine, refine=refine),
        density=replace(options.density, preset=preset),
    )
    # The location of the stream does not change the result.
    anywhere = replace(given, keep_stream=None)
    return Frontend(partial(_match, given), lambda _: (anywhere,))


def _match(options: MatchOptions, footage: Footage, database: Path) -> Filled:
    images = ImageOptions(frame_list=frame_list(footage, database.with_name("frames.txt")))
    options = replace(options, camera=footage.camera, images=images, on_existing="error")
    report = match(database, footage.video, image_path=footage.image_path, options=options)
    return Filled(report.seconds, report.warnings)
