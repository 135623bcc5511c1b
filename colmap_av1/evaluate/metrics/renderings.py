"""Metrics of rendered images against photographs: PSNR-Y, SSIM, VMAF, LPIPS, sharpness."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np

from colmap_av1.errors import EvaluationError, ImageError
from colmap_av1.evaluate.programs import run_program
from colmap_av1.images.files import read_image
from colmap_av1.util.arrays import Bools, Floats, Picture
from colmap_av1.util.processes import bound

# Patch size in pixels of Zhu and Milanfar's Q, and its significance level: the share of patches of
# pure noise that count as structure.
_PATCH = 8
_SIGNIFICANCE = 0.001
_LPIPS_SCRIPT = Path(__file__).with_name("lpips_distances.py")


@dataclass(frozen=True)
class RenderingMetrics:
    """Metrics of rendered images, float64 [n] each, in the order of the images.

    Attributes:
        psnr_y: peak signal-to-noise ratio of the luma in dB (60 for equal images).
        ssim_db: structural similarity s of the luma as -10 log10(1 - s), in dB; infinite for
            equal images.
        vmaf: VMAF (model vmaf_v0.6.1), 0 to 100.
        sharpness: Zhu and Milanfar's Q of the rendered image.
        sharpness_difference: absolute difference to the Q of the reference.
        lpips: LPIPS (AlexNet) distance, 0 for equal images; None if not available.
        no_lpips: why LPIPS is not available; empty if it is.
    """

    psnr_y: Floats
    ssim_db: Floats
    vmaf: Floats
    sharpness: Floats
    sharpness_difference: Floats
    lpips: Floats | None
    no_lpips: str


def rendering_metrics(rendered: Sequence[Path], references: Sequence[Path]) -> RenderingMetrics:
    """Compare rendered images with the photographs of the same views.

    libvmaf measures PSNR-Y, SSIM and VMAF, on BT.709 luma in limited range, as for video.

    Args:
        rendered: image files.
        references: file of the photograph of each, of the same size.

    Raises:
        ImageError: a file is missing or not an image, or the sizes of a pair differ.
    """
    if len(rendered) != len(references) or not rendered:
        raise ImageError(
            f"{len(rendered)} rendered images for {len(references)} references: give one for each"
        )
    sharpness = []
    by_size: dict[tuple[int, ...], list[int]] = {}
    for i, (image_path, reference_path) in enumerate(zip(rendered, references, strict=True)):
        image, reference = _read(image_path), _read(reference_path)
        if image.shape != reference.shape:
            raise ImageError(
                f"{image_path} is {image.shape[1]}x{image.shape[0]}, {reference_path} "
                f"{reference.shape[1]}x{reference.shape[0]}: render at the size of the photographs"
            )
        by_size.setdefault(image.shape, []).append(i)
        # The patches with structure are those of the reference, for both images.
        structure = _is_structure(_luma(reference))
        sharpness.append([_sharpness(_luma(x), structure) for x in (image, reference)])
    values = np.empty((len(rendered), 3))
    for indices in by_size.values():
        pairs = [(rendered[i], references[i]) for i in indices]
        values[indices] = _vmaf(pairs)
    lpips, no_lpips = _lpips(rendered, references)
    q = np.array(sharpness)
    with np.errstate(divide="ignore"):
        ssim_db = -10 * np.log10(1 - values[:, 1])
    return RenderingMetrics(
        psnr_y=values[:, 0],
        ssim_db=ssim_db,
        vmaf=values[:, 2],
        sharpness=q[:, 0],
        sharpness_difference=np.abs(q[:, 0] - q[:, 1]),
        lpips=lpips,
        no_lpips=no_lpips,
    )


def _sharpness(luma: Floats, structure: Bools) -> float:
    """Zhu and Milanfar's no-reference sharpness measure Q.

    X. Zhu and P. Milanfar, "Automatic Parameter Selection for Denoising Algorithms Using a
    No-Reference Measure of Image Content", IEEE Transactions on Image Processing 19 (2010):
    the singular values s1 >= s2 of a patch's gradients give s1 (s1 - s2) / (s1 + s2), summed
    over the patches with a dominant direction and divided by the number of all patches.
    """
    s1, s2 = _singular_values(luma)
    total = s1 + s2
    q = np.divide(s1 * (s1 - s2), total, out=np.zeros_like(s1), where=total > 0)
    return float(q[structure].sum() / max(q.size, 1))


def _is_structure(luma: Floats) -> Bools:
    """Bool [rows, cols]: patches whose gradient coherence is too high for pure noise."""
    s1, s2 = _singular_values(luma)
    total = s1 + s2
    coherence = np.divide(s1 - s2, total, out=np.zeros_like(s1), where=total > 0)
    tail = _SIGNIFICANCE ** (1 / (_PATCH**2 - 1))
    return np.asarray(coherence > np.sqrt((1 - tail) / (1 + tail)))


def _singular_values(luma: Floats) -> tuple[Floats, Floats]:
    """Singular values of the [64, 2] gradient matrix of each 8x8 patch: [rows, cols] each."""
    dy, dx = (np.asarray(d, dtype=np.float64) for d in np.gradient(luma))
    rows, cols = luma.shape[0] // _PATCH, luma.shape[1] // _PATCH

    def patch_sums(values: Floats) -> Floats:
        whole = values[: rows * _PATCH, : cols * _PATCH]
        return np.asarray(whole.reshape(rows, _PATCH, cols, _PATCH).sum(axis=(1, 3)))

    xx, xy, yy = patch_sums(dx * dx), patch_sums(dx * dy), patch_sums(dy * dy)
    spread = np.hypot((xx - yy) / 2, xy)
    mean = (xx + yy) / 2
    return np.sqrt(mean + spread), np.sqrt(np.maximum(mean - spread, 0))


def _luma(image: Picture) -> Floats:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.float64)


def _read(path: Path) -> Picture:
    try:
        return read_image(path)
    except ImageError as error:
        raise ImageError(f"{error}; render it again") from error


def _vmaf(pairs: Sequence[tuple[Path, Path]]) -> Floats:
    """PSNR-Y, SSIM and VMAF of pairs of image files of the same size: float64 [n, 3]."""
    height, width = _read(pairs[0][0]).shape[:2]
    # Both images are sent in one stream, the rendered image above its reference.
    graph = (
        "scale=out_color_matrix=bt709:out_range=tv,format=yuv444p,split[x][y];"
        f"[x]crop={width}:{height}:0:0[a];[y]crop={width}:{height}:0:{height}[b];"
        "[a][b]libvmaf=feature=name=psnr|name=float_ssim:log_fmt=json:log_path=log.json"
    )
    with tempfile.TemporaryDirectory() as folder:
        # fmt: off
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(),
            "-v", "error",
            "-f", "rawvideo",
            "-pix_fmt", "bgr24",
            "-s", f"{width}x{2 * height}",
            "-i", "-",
            "-filter_complex", graph,
            "-f", "null",
            "-",
        ]
        # fmt: on
        with subprocess.Popen(
            bound(command), cwd=folder, stdin=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            pipe: Any = process.stdin
            # If ffmpeg ends early, its message is reported below.
            with contextlib.suppress(BrokenPipeError):
                for path in itertools.chain.from_iterable(pairs):
                    pipe.write(_read(path).tobytes())
            words = process.communicate()[1].decode(errors="replace").split("\n")
        if process.returncode != 0:
            reason = next((line for line in words if line.strip()), "it ended without a message")
            raise ImageError(f"ffmpeg cannot measure VMAF: {reason}")
        frames: list[dict[str, Any]] = json.loads((Path(folder) / "log.json").read_text())["frames"]
    names = ("psnr_y", "float_ssim", "vmaf")
    return np.array([[frame["metrics"][name] for name in names] for frame in frames])


def _lpips(rendered: Sequence[Path], references: Sequence[Path]) -> tuple[Floats | None, str]:
    """LPIPS of pairs of files, or None and the reason why it is not available."""
    files = [[str(a), str(b)] for a, b in zip(rendered, references, strict=True)]
    try:
        distances = run_program(_LPIPS_SCRIPT, files)
    except EvaluationError as error:
        return None, str(error)
    return np.array(distances, dtype=np.float64), ""
