"""Program that trains 3D Gaussians on a scene.

    train_gaussians.py SCENE.npz RENDERS MILESTONE [MILESTONE ...]

It runs in a separate process because torch and pycolmap must not share one, and imports nothing
from this package. SCENE.npz is described at `write_scene` in
`colmap_av1.evaluate.training.splatting`. The last milestone is the number of iterations. After each
milestone `RENDERS/ITERATION/` has the renderings of the test images, and `RENDERS/times.csv` a line
with the training time and the number of Gaussians. If packages or the GPU are missing, the program
prints one line on standard error and exits with status 3.

The recipe is that of B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", ACM Transactions on Graphics 42 (2023), with gsplat's rasterizer and densification.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_NOT_HERE = 3
_INSTALL = "pip install gsplat pytorch-msssim"

try:
    import cv2
    import numpy as np
    import torch
    from gsplat.strategy import DefaultStrategy
    from gsplat.strategy.ops import reset_opa
    from pytorch_msssim import ssim
except ImportError as error:
    print(f"3D Gaussians need the package {error.name}: {_INSTALL}", file=sys.stderr)
    sys.exit(_NOT_HERE)

_SH_DEGREE = 3
# Value of the constant spherical harmonic.
_SH_0 = 0.5 / math.sqrt(math.pi)
_INITIAL_OPACITY = 0.1
_SSIM_WEIGHT = 0.2
_RATES = {
    "means": 1.6e-4,  # Multiplied by the size of the scene.
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 2.5e-3 / 20,
}
# Final learning rate of the means, as a share of the initial one.
_LAST_RATE = 0.01
# Iterations of the published schedule. Shorter runs densify in their first half only.
_DENSIFY_FROM, _DENSIFY_UNTIL, _RESET_EVERY, _DEGREE_EVERY = 500, 15_000, 3000, 1000

Gaussians = dict[str, torch.nn.Parameter]
# Renders (Gaussians, view, degree of the spherical harmonics); returns the image
# [height, width, 3] and gsplat's `info`.
Rasterizer = Callable[[Gaussians, "View", int], tuple[torch.Tensor, dict[str, Any]]]


@dataclass(frozen=True)
class View:
    """An image and its camera.

    Attributes:
        name: file name without folder.
        cam_from_world: float32 [4, 4].
        K: float32 [3, 3] intrinsics, the first pixel's centre at (0.5, 0.5).
        image: uint8 [height, width, 3] RGB.
    """

    name: str
    cam_from_world: torch.Tensor
    K: torch.Tensor
    image: torch.Tensor


def initial_gaussians(
    points: torch.Tensor, colors: torch.Tensor, spacing: torch.Tensor
) -> Gaussians:
    """One round Gaussian for each point.

    Args:
        points: float32 [n, 3].
        colors: float32 [n, 3], from 0 to 1.
        spacing: float32 [n] mean distance to the nearest neighbours.
    """
    n = len(points)
    opacity = torch.logit(torch.full((n,), _INITIAL_OPACITY, device=points.device))
    values = {
        "means": points,
        "scales": torch.log(spacing.clamp_min(1e-7))[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0, 0, 0], device=points.device).repeat(n, 1),
        "opacities": opacity,
        "sh0": ((colors - 0.5) / _SH_0)[:, None],
        "shN": torch.zeros((n, (_SH_DEGREE + 1) ** 2 - 1, 3), device=points.device),
    }
    return {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}


def photometric_loss(rendered: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Weighted sum of mean absolute difference and 1 - SSIM of two [height, width, 3] images."""
    difference = (rendered - image).abs().mean()
    a, b = (x.permute(2, 0, 1)[None] for x in (rendered, image))
    structure = 1 - ssim(a, b, data_range=1.0)
    return (1 - _SSIM_WEIGHT) * difference + _SSIM_WEIGHT * structure


def scene_size(views: list[View]) -> float:
    """1.1 times the largest distance of a camera from the mean of all cameras."""
    poses = torch.stack([view.cam_from_world for view in views])
    centres = -(poses[:, :3, :3].transpose(1, 2) @ poses[:, :3, 3:])[..., 0]
    size = 1.1 * float((centres - centres.mean(0)).norm(dim=1).max())
    return size if size > 0 else 1.0


def train(
    gaussians: Gaussians,
    views: list[View],
    rasterize: Rasterizer,
    iterations: int,
) -> Iterator[int]:
    """Optimise the Gaussians in place, and yield the number of each iteration after it.

    Args:
        gaussians: parameters by name, see `initial_gaussians`.
        views: training images; each is used once in a random order before any is used again.
        rasterize: renders a view.
        iterations: number of iterations.
    """
    size = scene_size(views)
    optimizers = {
        name: torch.optim.Adam([p], lr=_RATES[name] * (size if name == "means" else 1), eps=1e-15)
        for name, p in gaussians.items()
    }
    falling = torch.optim.lr_scheduler.ExponentialLR(
        optimizers["means"], _LAST_RATE ** (1 / iterations)
    )
    strategy = DefaultStrategy(
        refine_start_iter=_DENSIFY_FROM,
        refine_stop_iter=min(_DENSIFY_UNTIL, iterations // 2),
        reset_every=_RESET_EVERY,
    )
    strategy.check_sanity(gaussians, optimizers)
    state = strategy.initialize_state(scene_scale=size)
    generator = torch.Generator().manual_seed(0)
    order: list[int] = []
    for iteration in range(1, iterations + 1):
        if not order:
            order = torch.randperm(len(views), generator=generator).tolist()
        view = views[order.pop()]
        degree = min(_SH_DEGREE, iteration // _DEGREE_EVERY)
        rendered, info = rasterize(gaussians, view, degree)
        strategy.step_pre_backward(gaussians, optimizers, state, iteration, info)
        loss = photometric_loss(rendered, view.image.to(rendered.device) / 255.0)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        falling.step()
        strategy.step_post_backward(gaussians, optimizers, state, iteration, info)
        yield iteration
        # The strategy of gsplat 1.5.3 never resets opacities: its condition contains `0 & step`.
        # The caller renders before a reset, as the published trainer does: after it, the Gaussians
        # are nearly transparent.
        if iteration % _RESET_EVERY == 0 and iteration < strategy.refine_stop_iter:
            reset_opa(gaussians, optimizers, state, value=2 * strategy.prune_opa)


def read_scene(path: Path, device: str) -> tuple[Gaussians, list[View], list[View]]:
    """The initial Gaussians, the training views and the test views."""
    with np.load(path) as scene:
        arrays = {name: scene[name] for name in scene.files}
    views = []
    for i, file in enumerate(arrays["files"].tolist()):
        # cv2.imread cannot open paths that are not UTF-8.
        image = cv2.imdecode(np.fromfile(file, dtype=np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(f"{file}: is missing or not an image")
        views.append(
            View(
                name=Path(file).name,
                cam_from_world=torch.from_numpy(arrays["cam_from_world"][i]).to(device),
                K=torch.from_numpy(arrays["K"][i]).to(device),
                image=torch.from_numpy(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)),
            )
        )
    start = (torch.from_numpy(arrays[name]).to(device) for name in ("points", "colors", "spacing"))
    is_test = arrays["is_test"].tolist()
    return (
        initial_gaussians(*start),
        [view for view, test in zip(views, is_test, strict=True) if not test],
        [view for view, test in zip(views, is_test, strict=True) if test],
    )


def run(
    scene: Path, renders: Path, rasterize: Rasterizer, device: str, milestones: list[int]
) -> None:
    """Train, and render the test images at the milestones."""
    gaussians, train_views, test_views = read_scene(scene, device)
    times = renders / "times.csv"
    times.write_text("iterations,seconds,gaussians\n")
    seconds, started = 0.0, time.perf_counter()
    for iteration in train(gaussians, train_views, rasterize, milestones[-1]):
        if iteration not in milestones:
            continue
        if device == "cuda":
            torch.cuda.synchronize()
        seconds += time.perf_counter() - started
        folder = renders / str(iteration)
        folder.mkdir()
        for view in test_views:
            with torch.no_grad():
                rendered = rasterize(gaussians, view, _SH_DEGREE)[0]
            pixels = (rendered.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
            path = (folder / view.name).with_suffix(".png")
            picture = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
            cv2.imencode(".png", picture)[1].tofile(path)
        with times.open("a") as file:
            file.write(f"{iteration},{seconds},{len(gaussians['means'])}\n")
        # Do not count the time of rendering test images.
        started = time.perf_counter()


def gsplat_rasterizer() -> Rasterizer:
    """A rasterizer that uses gsplat on a GPU."""
    from gsplat import rasterization  # noqa: PLC0415 - needs CUDA

    def rasterize(
        gaussians: Gaussians, view: View, degree: int
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        height, width = view.image.shape[:2]
        rendered, _, info = rasterization(
            means=gaussians["means"],
            quats=gaussians["quats"],
            scales=torch.exp(gaussians["scales"]),
            opacities=torch.sigmoid(gaussians["opacities"]),
            colors=torch.cat([gaussians["sh0"], gaussians["shN"]], 1),
            viewmats=view.cam_from_world[None],
            Ks=view.K[None],
            width=width,
            height=height,
            sh_degree=degree,
            packed=False,
        )
        return rendered[0], info

    return rasterize


def main() -> int:
    """Train on the scene given by the command line."""
    if not torch.cuda.is_available():
        print(
            "training 3D Gaussians needs an NVIDIA GPU with CUDA, which is missing",
            file=sys.stderr,
        )
        return _NOT_HERE
    scene, renders, *milestones = sys.argv[1:]
    run(Path(scene), Path(renders), gsplat_rasterizer(), "cuda", [int(n) for n in milestones])
    return 0


if __name__ == "__main__":
    sys.exit(main())
