"""LPIPS of image pairs, as a program: torch must not share a process with pycolmap.

Standard input: a JSON list of [rendered file, reference file]; standard output: a JSON list
of distances. Where the packages or the weights are missing, one line on standard error says
so, with exit status 3. Run by `colmap_av1.evaluate.metrics.renderings`; imports nothing of
the package.
"""

import contextlib
import json
import sys
from pathlib import Path

_NOT_HERE = 3


def main() -> int:
    """Measure the pairs named on standard input."""
    try:
        import cv2  # noqa: PLC0415 - after the check that torch is there, in any order
        import lpips  # noqa: PLC0415
        import numpy as np  # noqa: PLC0415
        import torch  # noqa: PLC0415
    except ImportError as error:
        print(f"LPIPS needs the package {error.name}: pip install lpips", file=sys.stderr)
        return _NOT_HERE
    # The package carries the weights of the distance, torchvision fetches the network's.
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "alexnet-owt-7be5be79.pth"
    if not weights.is_file():
        print(
            f"LPIPS needs AlexNet's weights at {weights}: fetch them with torchvision",
            file=sys.stderr,
        )
        return _NOT_HERE
    with contextlib.redirect_stdout(sys.stderr):
        distance = lpips.LPIPS(net="alex", verbose=False).eval()

    def read(path: str) -> "torch.Tensor":
        # OpenCV opens no path that is not UTF-8.
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
        image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
        return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 127.5 - 1

    with torch.inference_mode():
        distances = [float(distance(read(a), read(b))) for a, b in json.load(sys.stdin)]
    json.dump(distances, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
