"""Draw the animated picture of the README from the example clip: motion, tracks, point cloud.

``python examples/render_overview.py`` reconstructs ``scene.mp4`` in a temporary folder and writes
``docs/images/overview.webp``. ``--model`` takes the output of an earlier
``colmap-av1 reconstruct --points survey --seeding 2`` of the clip. Needs Pillow, which the extra
``evaluate`` installs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import colmap_av1
from colmap_av1.view import view_video

EXAMPLES = Path(__file__).resolve().parent
CLIP = EXAMPLES / "scene.mp4"
OUTPUT = EXAMPLES.parent / "docs" / "images" / "overview.webp"

DENSEST = colmap_av1.ReconstructOptions(
    match=colmap_av1.MatchOptions(tracks=colmap_av1.TrackOptions(seeding=2)),
    triangulate=colmap_av1.TriangulateOptions(points="survey"),
)
DRAWING = colmap_av1.ViewOptions(draw="both", opacity=0.75, tail=12, spacing=16)
PANEL = (336, 189)
GAP = 6
CLOUD = (524, 2 * PANEL[1] + GAP)
BACKGROUND = (22, 24, 28)
CAMERA = (255, 196, 64)
SWING = np.radians(26)  # amplitude of the virtual camera's swing
SUPERSAMPLE = 2
MILLISECONDS = 80

Picture = NDArray[np.uint8]
Points = NDArray[np.float64]


def main() -> None:
    """Draw and save the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, help="output of colmap-av1 reconstruct of the clip")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--quality", type=int, default=40, help="WebP quality, 0 to 100")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        model = arguments.model
        if model is None:
            model = Path(scratch) / "scene"
            colmap_av1.reconstruct(CLIP, model, options=DENSEST)
        drawn = Path(scratch) / "motion"
        view_video(CLIP, drawn, options=DRAWING)
        panels = [read_panels(path) for path in sorted(drawn.glob("*.png"))]
    scene = Scene(pycolmap.Reconstruction(model / "sparse" / "0"), len(panels))
    titles = (
        "motion vectors in the AV1 stream",
        "tracks",
        f"COLMAP model, {len(scene.points):,} points",
    )
    frames = [compose((*panels[i], scene.draw(i)), titles) for i in range(len(panels))]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(
        arguments.output,
        save_all=True,
        append_images=frames[1:],
        duration=MILLISECONDS,
        loop=0,
        quality=arguments.quality,
        method=4,
    )
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.2f} MB")


def read_panels(path: Path) -> tuple[Picture, Picture]:
    """The two drawings of a frame, motion above tracks, in RGB and at the size of a panel."""
    both = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    half = both.shape[0] // 2
    motion, tracks = (
        np.asarray(cv2.resize(part, PANEL, interpolation=cv2.INTER_AREA), np.uint8)
        for part in (both[:half], both[half:])
    )
    return motion, tracks


class Scene:
    """The point cloud and the cameras, drawn from a virtual camera that swings around them."""

    def __init__(self, model: pycolmap.Reconstruction, num_frames: int) -> None:
        """Take points, colours and camera poses from a model."""
        points = list(model.points3D.values())
        self.points = np.array([p.xyz for p in points])
        self.colours = np.array([p.color for p in points], np.uint8)
        images = sorted(model.images.values(), key=lambda image: image.name)
        self.poses = [image.cam_from_world().inverse() for image in images]
        camera = next(iter(model.cameras.values()))
        self.size = np.array([camera.width, camera.height], float)
        self.focal = camera.mean_focal_length()
        self.num_frames = num_frames
        middle = self.poses[len(images) // 2]
        self.rotation = middle.rotation.matrix()
        depth = (self.points - middle.translation) @ self.rotation[:, 2]
        self.depth = float(np.median(depth))
        self.pivot = middle.translation + self.depth * self.rotation[:, 2]

    def draw(self, frame: int) -> Picture:
        """The panel of a frame: the nearest points last, and the cameras up to this frame."""
        width, height = (SUPERSAMPLE * size for size in CLOUD)
        # One period of the swing is the length of the clip, so that the picture repeats.
        phase = 2 * np.pi * frame / self.num_frames
        yaw = cv2.Rodrigues(np.array([0, SWING * np.sin(phase), 0]))[0]
        pitch = cv2.Rodrigues(np.array([-0.20 - 0.05 * np.cos(phase), 0, 0]))[0]
        rotation = self.rotation @ yaw @ pitch
        centre = self.pivot - 2.1 * self.depth * rotation[:, 2]
        focal = 1.32 * width

        def project(xyz: Points) -> tuple[Points, Points]:
            seen = (xyz - centre) @ rotation
            flat = focal * seen[:, :2] / seen[:, 2:] + np.array([width / 2, 0.53 * height])
            return flat, seen[:, 2]

        picture = np.full((height, width, 3), BACKGROUND, np.uint8)
        flat, depth = project(self.points)
        radius = np.clip(2.4 * SUPERSAMPLE * self.depth / depth, 3, 5).round().astype(int)
        for i in np.argsort(-depth):
            if depth[i] > 0.1 * self.depth:
                x, y = flat[i].round().astype(int).tolist()
                cv2.circle(picture, (x, y), int(radius[i]), self.colours[i].tolist(), -1)
        path, _ = project(np.array([pose.translation for pose in self.poses]))
        line = path.round().astype(np.int32)
        thin, thick = SUPERSAMPLE, 2 * SUPERSAMPLE
        cv2.polylines(picture, [line], False, (150, 120, 60), thin, cv2.LINE_AA)
        cv2.polylines(picture, [line[: frame + 1]], False, CAMERA, thick, cv2.LINE_AA)
        corners, _ = project(self.frustum(self.poses[frame]))
        apex, *base = corners.round().astype(int).tolist()
        for k, corner in enumerate(base):
            cv2.line(picture, apex, corner, CAMERA, thick, cv2.LINE_AA)
            cv2.line(picture, corner, base[(k + 1) % 4], CAMERA, thick, cv2.LINE_AA)
        return np.asarray(cv2.resize(picture, CLOUD, interpolation=cv2.INTER_AREA), np.uint8)

    def frustum(self, pose: pycolmap.Rigid3d) -> Points:
        """Centre and corners of a camera's view at a small depth: [5, 3]."""
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        rays = (corners - 0.5) * self.size / self.focal
        far = 0.13 * self.depth * np.column_stack([rays, np.ones(4)])
        local = np.vstack([np.zeros(3), far])
        return np.asarray(local @ pose.rotation.matrix().T + pose.translation)


def compose(panels: Sequence[Picture], titles: Sequence[str]) -> Image.Image:
    """One frame of the animation: motion above tracks, the cloud to their right, with titles."""
    width = PANEL[0] + GAP + CLOUD[0]
    picture = Image.new("RGB", (width, CLOUD[1]), (255, 255, 255))
    font = ImageFont.load_default(14)
    places = [(0, 0), (0, PANEL[1] + GAP), (PANEL[0] + GAP, 0)]
    draw = ImageDraw.Draw(picture)
    for place, panel, title in zip(places, panels, titles, strict=True):
        picture.paste(Image.fromarray(panel), place)
        x, y = place[0] + 8, place[1] + panel.shape[0] - 27
        left, top, right, bottom = draw.textbbox((x, y), title, font=font)
        draw.rectangle((left - 5, top - 4, right + 5, bottom + 4), fill=BACKGROUND)
        draw.text((x, y), title, font=font, fill=(255, 255, 255))
    return picture


if __name__ == "__main__":
    main()
