"""How firmly points join the images on either side of each gap between neighbours in time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.names import natural_order
from colmap_av1.model.colmap_model import posed_images

# Two views of a point say nothing of how far one of them is from a third.
_FEWEST_VIEWS = 3
# A joint is doubtful, and may be looked at again, that has less than this share of the points that
# the joints of a model usually have; and weak below the other. Jerks that links mend have 15 % and
# more afterwards, models that were bent there 1 to 5 %.
_DOUBTFUL = 0.15
_WEAK = 0.07
# So many points hold any joint, however many others have: bent ones had 50 at most.
_ENOUGH = 100


@dataclass(frozen=True)
class Joints:
    """What joins neighbouring images of the same camera and folder.

    Attributes:
        pairs: names of the images before and after each joint, in the order of their names.
        num_points: int64 [n] points that join them: which images on both sides see, three of them
            at least.
    """

    pairs: tuple[tuple[str, str], ...]
    num_points: NDArray[np.int64]

    @property
    def weak(self) -> list[int]:
        """Joints, by index, that hold far less than the others do: a model may be bent there."""
        return self._below(_WEAK, most=_ENOUGH)

    @property
    def doubtful(self) -> list[int]:
        """Joints, by index, that hold much less than the others do, the weak ones among them."""
        return self._below(_DOUBTFUL)

    def _below(self, share: float, most: float = math.inf) -> list[int]:
        if len(self.num_points) == 0:
            return []
        least = min(share * float(np.median(self.num_points)), most)
        return [int(i) for i in np.flatnonzero(self.num_points < least)]

    @property
    def warning(self) -> str | None:
        """What the user should know of a model that hardly holds together somewhere."""
        if not self.weak:
            return None
        where = min(self.weak, key=lambda i: (int(self.num_points[i]), i))
        (first, second), count = self.pairs[where], int(self.num_points[where])
        more = len(self.weak) - 1
        others = f", and few at {more} more {'place' if more == 1 else 'places'}" if more else ""
        usual = int(np.median(self.num_points))
        return (
            f"only {count} points join '{first}' and what is before it to '{second}' and what "
            f"follows, usually {usual} do{others}: scale and direction may change there; film it "
            "more slowly, or reconstruct the parts on either side apart"
        )


def model_joints(reconstruction: Any) -> Joints:
    """What joins neighbouring images in a model.

    Images that are neighbours in the order of their names, as frames of a video are named, have a
    joint where one camera took both into one folder.

    Args:
        reconstruction: pycolmap.Reconstruction.
    """
    posed = posed_images(reconstruction)
    names = list(posed)
    images = [posed[names[k]] for k in natural_order(names)]
    place = {image.image_id: k for k, image in enumerate(images)}
    seen = (
        sorted({place[e.image_id] for e in point.track.elements if e.image_id in place})
        for point in reconstruction.points3D.values()
    )
    crossing = _crossing(seen, len(images))
    row = [(image.camera_id, PurePosixPath(image.name).parent) for image in images]
    joints = [k for k, (own, other) in enumerate(pairwise(row)) if own == other]
    return Joints(tuple((images[k].name, images[k + 1].name) for k in joints), crossing[joints])


def _crossing(views: Iterable[list[int]], num_images: int) -> NDArray[np.int64]:
    """Int64 [num_images] points with views at image i or before, and at i + 1 or after."""
    change = np.zeros(num_images + 1, dtype=np.int64)
    for images in views:
        if len(images) >= _FEWEST_VIEWS:
            change[images[0]] += 1
            change[images[-1]] -= 1
    return np.cumsum(change)[:num_images]
