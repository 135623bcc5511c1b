from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from colmap_av1.errors import OptionError
from colmap_av1.option_checks import check_options
from colmap_av1.options import (
    CameraOptions,
    DensityOptions,
    ImageOptions,
    MatchOptions,
    PairOptions,
    ReadOptions,
    RefineOptions,
    VerifyOptions,
)

SIZE = (192, 128)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"read": ReadOptions(operating_point=-1)}, "operating_point is -1: give 0 to 31"),
        ({"read": ReadOptions(num_threads=0)}, "num_threads is 0: give 1 or more"),
        ({"read": ReadOptions(max_frame_size=0)}, "max_frame_size is 0: give samples above 0"),
        ({"images": ImageOptions(every=0)}, "every is 0: give 1 or more"),
        ({"images": ImageOptions(image_name="x.png")}, "'x.png' needs exactly one number field"),
        ({"on_existing": "keep"}, "on_existing is 'keep': give error, append, replace"),
        ({"camera": CameraOptions(camera_model="NONE")}, "unknown camera model 'NONE'"),
        ({"camera": CameraOptions("PINHOLE", "1,2")}, "camera_params"),
        ({"refine": RefineOptions(refine_window=4)}, "refine_window is 4"),
        ({"density": DensityOptions(spacing=-1)}, "spacing is -1"),
        ({"pairs": PairOptions(offsets=())}, "offsets"),
        ({"verify": VerifyOptions(max_error=0)}, "max_error is 0"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_every_kind_of_option_is_checked(given: dict[str, Any], message: str) -> None:
    check_options(MatchOptions(), SIZE)
    with pytest.raises(OptionError, match=message):
        check_options(replace(MatchOptions(), **given), SIZE)
