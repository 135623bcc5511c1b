"""Runs `train_gaussians.py` with a rasterizer that needs no GPU.

The first argument is the path of the script, the others are its arguments. The rasterizer is exact
and slow: it evaluates every Gaussian at every pixel, nearest first, with view-independent colours.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import torch

PROGRAM = Path(sys.argv.pop(1))


def rasterize(gaussians, view, degree):
    height, width = view.image.shape[:2]
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    camera = gaussians["means"] @ rotation.T + translation
    x, y, z = camera.unbind(1)
    z = z.clamp_min(0.01)
    fx, fy = view.K[0, 0], view.K[1, 1]
    means2d = torch.stack([fx * x / z + view.K[0, 2], fy * y / z + view.K[1, 2]], 1)[None]
    if means2d.requires_grad:
        means2d.retain_grad()

    w, i, j, k = torch.nn.functional.normalize(gaussians["quats"]).unbind(1)
    turn = torch.stack(
        [
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ],
        1,
    ).reshape(-1, 3, 3)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], 1)
    axes = jacobian.reshape(-1, 2, 3) @ rotation @ turn * gaussians["scales"].exp()[:, None]
    covariance = axes @ axes.transpose(1, 2) + 0.3 * torch.eye(2)

    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 1, 2) + 0.5
    offset = pixels - means2d
    distance = torch.einsum("pni,nij,pnj->pn", offset, torch.linalg.inv(covariance), offset)
    alpha = torch.sigmoid(gaussians["opacities"]) * torch.exp(-distance / 2)
    alpha = (alpha * (camera[:, 2] > 0.01)).clamp_max(0.999)[:, torch.argsort(z)]
    behind = torch.cumprod(1 - alpha, 1)
    weight = alpha * torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], 1)
    color = (gaussians["sh0"][:, 0] * 0.28209479177387814 + 0.5).clamp_min(0)[torch.argsort(z)]
    radii = (3 * torch.linalg.eigvalsh(covariance.detach())[:, 1:].sqrt()).repeat(1, 2)[None]
    info = {
        **{"means2d": means2d, "radii": radii, "gaussian_ids": None},
        **{"width": width, "height": height, "n_cameras": 1},
    }
    return (weight @ color).reshape(height, width, 3), info


if __name__ == "__main__":
    torch.manual_seed(0)
    torch.set_num_threads(1)
    program = runpy.run_path(str(PROGRAM), run_name="program")
    scene, renders, *milestones = sys.argv[1:]
    program["run"](Path(scene), Path(renders), rasterize, "cpu", [int(n) for n in milestones])
