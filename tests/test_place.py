"""Positions and gravity in containers place a model in metres."""

from __future__ import annotations

import json
import shutil
import sqlite3
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from dense_scene import OPTIONS, SCENE, Truth
from telemetry import gps5, grav, with_gpmf

from colmap_av1 import MapOptions, OptionError, PlaceOptions, map_database, reconstruct
from colmap_av1.database.reading import read_pose_priors
from colmap_av1.geometry.colmap_model import camera_centres, posed_images, read_model
from colmap_av1.poses.placing.placement import Origin
from colmap_av1.reconstruct import ReconstructReport

ORIGIN = (59.33, 18.07, 20.0)
# The scene is enlarged tenfold, because it is small compared with GPS errors.
LARGER = 10.0


def places_of(truth: Truth) -> np.ndarray:
    """Latitude, longitude and altitude of each frame, with GPS errors."""
    rng = np.random.default_rng(0)
    metres = LARGER * camera_centres(truth.cam_from_world)
    metres = metres + rng.normal(0, 0.3, metres.shape)
    metres[[9, 30]] += [[200.0, 0, 0], [0, -50, 0]]  # two outliers
    return np.asarray(pycolmap.GPSTransform().enu_to_ellipsoid(metres, *ORIGIN))


def frame_of(name: str) -> int:
    return int(Path(name).stem.rsplit("_", 1)[1])


def away(model: Path, truth: Truth, origin: Origin | None) -> tuple[float, float, float]:
    """Maximum camera error in metres, scale, and tilt in degrees."""
    images = posed_images(read_model(model))
    frames = [frame_of(name) for name in images]
    poses = np.array([image.cam_from_world for image in images.values()])
    exact = truth.cam_from_world[frames]
    assert origin is not None
    here = np.array([[origin.latitude, origin.longitude, origin.altitude]])
    to_ellipsoid = pycolmap.GPSTransform().enu_to_ellipsoid
    at = np.asarray(to_ellipsoid(LARGER * camera_centres(exact), *ORIGIN))
    ecef = pycolmap.GPSTransform().ellipsoid_to_ecef
    apart = np.asarray(ecef(at)) - np.asarray(ecef(here))
    distance = np.abs(np.linalg.norm(apart, axis=1) - np.linalg.norm(camera_centres(poses), axis=1))
    ups = np.einsum("nji,njk->nik", poses[:, :, :3], exact[:, :, :3])[:, :, 2]
    tilt = np.rad2deg(np.arccos(np.clip(ups[:, 2].mean(), -1, 1)))
    spread = [np.linalg.norm(c - c.mean(axis=0)) for c in map(camera_centres, (poses, exact))]
    return float(distance.max()), float(spread[0] / spread[1] / LARGER), float(tilt)


@pytest.fixture(scope="module")
def placed(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> ReconstructReport:
    """The scene with the telemetry of a GoPro, whose axes differ from those of the picture."""
    folder = tmp_path_factory.mktemp("placed")
    places = places_of(truth)
    gravity = (truth.cam_from_world[:, :, :3] @ [0, 0, -1.0])[:, [2, 0, 1]] * [1, -1, 1]
    payloads = [
        (0.8, gps5(places[k : k + 20]) + grav(gravity[k : k + 20])) for k in range(0, 60, 20)
    ]
    video = with_gpmf(SCENE, folder / "gopro.mp4", payloads)
    return reconstruct(video, folder / "out", options=OPTIONS)


def test_gopro_telemetry_gives_a_model_in_metres(placed: ReconstructReport, truth: Truth) -> None:
    assert placed.place.units == "metres"
    assert placed.place.axes == "x east, y north, z up"
    written = json.loads((placed.output / "place.json").read_text())
    assert written == json.loads(json.dumps(asdict(placed.place)))
    assert placed.warnings == ()
    distance, scale, tilt = away(placed.output / "sparse" / "0", truth, placed.place.origin)
    assert distance < 1.0
    assert scale == pytest.approx(1, abs=0.03)
    assert tilt < 1.5
    points = np.array([p.xyz for p in read_model(placed.output / "sparse" / "0").points3D.values()])
    ground = np.quantile(points[:, 2], 0.02) + placed.place.origin.altitude - ORIGIN[2]
    assert abs(ground) < 2  # of a scene 10 times as large


def test_database_contains_pose_priors(
    placed: ReconstructReport, truth: Truth, tmp_path: Path
) -> None:
    """pycolmap can read them, and `map` aligns the model to them."""
    priors = read_pose_priors(placed.database)
    assert len(priors) == placed.num_key_images
    for name, prior in priors.items():
        np.testing.assert_allclose(prior.position, places_of(truth)[frame_of(name)], atol=1e-3)
    report = map_database(
        placed.database,
        placed.output / "images",
        tmp_path / "model",
        options=MapOptions(mapper="global"),
    )
    distance, scale, _ = away(report.model, truth, report.place.origin)
    assert distance < 1.5
    assert scale == pytest.approx(1, abs=0.04)
    copy = tmp_path / "copy.db"
    shutil.copyfile(placed.database, copy)
    with pycolmap.Database.open(copy) as database:
        found = database.read_all_pose_priors()
    assert len(found) == len(priors)
    assert all(p.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84 for p in found)
    moved = {n: p.position.tolist() for n, p in read_pose_priors(copy).items()}
    assert moved == {n: p.position.tolist() for n, p in priors.items()}


def test_scale_and_up_from_a_distance_and_gravity(placed: ReconstructReport, truth: Truth) -> None:
    """A resumed run only repeats the placement, with a known distance in place of positions."""
    video = placed.videos[0]
    centres = camera_centres(truth.cam_from_world)
    metres = float(np.linalg.norm(centres[3] - centres[48]))
    place = PlaceOptions(
        align="none", upright=True, scale=f"{metres}=frame_000003.jpg,frame_000048.jpg"
    )
    options = replace(OPTIONS, place=place)
    again = reconstruct(video, placed.output, options=options)
    assert "adjustment" in again.resumed
    assert "place" not in again.resumed
    assert again.place.units == "metres"
    assert again.place.origin is None
    assert "gravity" in again.place.how[0]
    images = posed_images(read_model(again.output / "sparse" / "0"))
    ends = camera_centres(np.array([images[f"frame_{k:06}.jpg"].cam_from_world for k in (3, 48)]))
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(metres, rel=1e-6)
    wrong = replace(OPTIONS, place=PlaceOptions(scale="2=frame_000003.jpg,frame_000001.jpg"))
    with pytest.raises(OptionError, match=r"frame_000001\.jpg"):
        reconstruct(video, placed.output, options=wrong)
    assert (again.output / "place.json").exists()


def test_identical_positions_are_reported(
    placed: ReconstructReport, truth: Truth, tmp_path: Path
) -> None:
    """The positions are in the columns that COLMAP 3.8 fills from EXIF data."""
    database = tmp_path / "still.db"
    shutil.copyfile(placed.database, database)
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE pose_priors")
        connection.execute("UPDATE images SET prior_tx = 59.3, prior_ty = 18.1, prior_tz = 7")
    report = map_database(
        database,
        placed.output / "images",
        tmp_path / "model",
        options=MapOptions(mapper="global"),
    )
    assert report.place.units == "arbitrary"
    (warning,) = report.warnings
    assert "--scale" in warning
