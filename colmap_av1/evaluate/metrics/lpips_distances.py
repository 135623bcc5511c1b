"""Program that measures LPIPS distances of image pairs.

It runs in a separate process because torch and pycolmap must not share one, and imports nothing
from this package. Standard input is a JSON list of [rendered file, reference file]; standard output
is a JSON list of distances. If packages or weights are missing, the program prints one line on
standard error and exits with status 3.
"""

import contextlib
import json
import sys
from pathlib import Path

_NOT_HERE = 3


def main() -> int:
    """Measure the pairs named on standard input."""
    try:
        import cv2  # noqa: PLC0415 - the packages are optional
        import lpips  # noqa: PLC0415
        import numpy as np  # noqa: PLC0415
        import torch  # noqa: PLC0415
    except ImportError as error:
        print(f"LPIPS needs the package {error.name}: pip install lpips", file=sys.stderr)
        return _NOT_HERE
    # The package lpips includes the weights of the distance, but not those of the network.
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "alexnet-owt-7be5be79.pth"
    if not weights.is_file():
        print(
            f"LPIPS needs AlexNet's weights at {weights}: download them with torchvision",
            file=sys.stderr,
        )
        return _NOT_HERE
    with contextlib.redirect_stdout(sys.stderr):
        distance = lpips.LPIPS(net="alex", verbose=False).eval()

    def read(path: str) -> "torch.Tensor":
        # cv2.imread cannot open paths that are not UTF-8.
        pixels = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
        image = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
        return torch.from_numpy(image).permute(2, 0, 1)[None].float() / 127.5 - 1

    with torch.inference_mode():
        distances = [float(distance(read(a), read(b))) for a, b in json.load(sys.stdin)]
    json.dump(distances, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
