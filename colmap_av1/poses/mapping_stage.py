"""The stage that maps the key images with one of COLMAP's mappers."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.geometry.posed_model import (
    PosedModel,
    posed_model,
    read_posed_model,
    write_posed_model,
)
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import CameraOptions, MapOptions
from colmap_av1.poses.adjusting import have_diverged, refines_intrinsics
from colmap_av1.poses.longest_tracks import keep_longest_tracks
from colmap_av1.poses.mapper import LEAST_IMAGES, MapperEffort, map_poses
from colmap_av1.poses.match_stage import MatchesResult
from colmap_av1.poses.posed_images import PosesResult
from colmap_av1.poses.run import Run
from colmap_av1.poses.second_distortion import with_second_distortion
from colmap_av1.util.digests import digest_of
from colmap_av1.util.stages import Kept, run_stage

# With fewer tracks per image than this, a failed initialization is blamed on the tracks.
_FEW_TRACKS = 100


@dataclass(frozen=True)
class MappedResult(PosesResult):
    """Result of `mapping_stage`.

    Attributes:
        mapper: the mapper of COLMAP that estimated the poses.
        other_models: files of further models, which are not connected to the first.
    """

    mapper: str
    other_models: tuple[str, ...]


def mapping_stage(
    run: Run, matched: Kept[MatchesResult], image_set: ImageSet, keyed: ImageSet
) -> Kept[MappedResult]:
    """Estimate the poses of the key images with COLMAP's mapper."""
    options, clock = run.options, run.clock
    pose_options = options.poses
    found_before = matched.result
    forward = found_before.forward_motion
    mappers: list[Literal["incremental", "global"]]
    if pose_options.mapper != "auto":
        mappers = [pose_options.mapper]
    elif found_before.assumes_video_focal_length:
        # The global mapper needs the focal length. A zoom would mislead its estimate.
        mappers = ["incremental"]
    else:
        mappers = ["global", "incremental"]
    links = found_before.links
    reasons = {reason for gap in links.gaps for reason in gap.reasons}
    depends_on_links = links.num_between or reasons & {"contradicted", "few tracks"}
    # Where poses depend on links, walks with fast turns bend if the mapper ends early.
    effort: MapperEffort = "early" if pose_options.adjust and not depends_on_links else "full"
    attempts = [
        MapOptions(
            mapper=mapper,
            forward_motion=forward and mapper == "incremental",
            refine_intrinsics=refines_intrinsics(options),
            seed=run.context.seed,
            num_threads=pose_options.mapper_threads,
        )
        for mapper in mappers
    ]
    if refines_intrinsics(options) and mappers[-1] == "incremental":
        # With little parallax, the mapper's intrinsics may diverge. The adjustment refines them.
        attempts.append(replace(attempts[-1], refine_intrinsics=False))

    def make(partial: Path) -> MappedResult:
        with clock.measure("poses"):
            for attempt in attempts:
                # pycolmap migrates the databases that it opens to its own layout.
                database = partial / f"{attempt.mapper}.db"
                shutil.copyfile(run.output / "database.db", database)
                if attempt.mapper == "global" and pose_options.adjust:
                    keep_longest_tracks(database)
                try:
                    found = mapped_models(run, database, attempt, effort, len(keyed.sequence))
                except ModelError:
                    if attempt is attempts[-1]:
                        raise
                    continue
                if found and not have_diverged(found[0].cameras, found[0].images):
                    break
        if not found:
            camera = options.match.camera
            raise ModelError(_why_no_model(found_before, attempt.mapper, camera))
        with clock.measure("adjustment"):
            found = [with_second_distortion(run, model) for model in found]
        # Further images belong to the model of their nearest key image.
        found.sort(key=lambda model: -num_nearest(model, image_set, keyed))
        (partial / "poses").mkdir()
        files = [f"poses/{number}.npz" for number in range(len(found))]
        for file, model in zip(files, found, strict=True):
            write_posed_model(partial / file, PosedModel(model.cameras, model.images))
        return MappedResult(
            poses=files[0],
            num_registered=len(found[0].images),
            mapper=attempt.mapper,
            other_models=tuple(files[1:]),
        )

    return run_stage(
        run.stages,
        "poses",
        [
            matched.digest,
            attempts,
            pose_options.adjust,
            effort,
        ],
        MappedResult,
        products=["poses"],
        make=make,
    )


def mapped_models(
    run: Run, database: Path, options: MapOptions, effort: MapperEffort, num_images: int
) -> list[PosedModel]:
    """Map a database, and read the models of more than a few images, with their points.

    Args:
        run: the run.
        database: the database, which pycolmap may change.
        options: options of the mapper.
        effort: see `map_poses`.
        num_images: number of its images.

    Raises:
        ModelError: the mapper fails.
    """
    with tempfile.TemporaryDirectory() as models:
        sizes = map_poses(
            database,
            Path(models),
            options,
            image_path=None,
            log=run.stages / "mapper.log",
            num_images=num_images,
            progress=run.progress,
            effort=effort,
        )
        return [
            posed_model(read_model(Path(models) / str(number)), with_points=True)
            for number, size in enumerate(sizes)
            if size >= LEAST_IMAGES
        ]


def num_nearest(model: PosedModel, image_set: ImageSet, keyed: ImageSet) -> int:
    """The number of images whose nearest key image is in a model.

    Args:
        model: a model of key images.
        image_set: all images.
        keyed: all key images.
    """
    key = keyed.images.frames
    nearest = np.searchsorted((key[1:] + key[:-1]) / 2, image_set.images.frames)
    is_in_model = np.isin(keyed.images.names, list(model.by_name))
    return int(np.count_nonzero(is_in_model[nearest]))


def with_model_first(run: Run, mapped: Kept[MappedResult], model_file: str) -> Kept[MappedResult]:
    """The models of the mapper, with another one as the first.

    Args:
        run: the run.
        mapped: the models, see `mapping_stage`.
        model_file: the file of the new first model.
    """
    num_registered = len(read_posed_model(run.stages / model_file).images)
    before = (mapped.result.poses, *mapped.result.other_models)
    others = [own for own in before if own != model_file]
    result = replace(
        mapped.result,
        poses=model_file,
        num_registered=num_registered,
        other_models=tuple(others),
    )
    return replace(mapped, result=result, digest=digest_of([mapped.digest, model_file]))


def _why_no_model(found: MatchesResult, mapper: str, camera: CameraOptions) -> str:
    """Why a mapper found no model with these camera options, and the remedy."""
    is_global = mapper == "global"
    failure = f"COLMAP's {mapper} mapper finds no {'model' if is_global else 'initial pair'}"
    other = "incremental" if is_global else "global"
    options = ("camera_model", "camera_params")
    missing = [f"--{name}" for name in options if getattr(camera, name) is None]
    give = f"give {' and '.join(missing) or 'other --camera_params'}, or try --mapper {other}"
    most_agree = found.num_verified_pairs >= found.num_pairs / 2
    if most_agree and found.num_flat_pairs > found.num_verified_pairs / 2:
        return (
            f"{failure}: too little parallax, in {found.num_flat_pairs} of "
            f"{found.num_verified_pairs} pairs the camera only rotates or the scene is flat: "
            "move sideways while filming, or give a longer part of the video"
        )
    if not most_agree or found.keypoints_per_image < _FEW_TRACKS:
        return (
            f"{failure}: too few tracks, {found.keypoints_per_image:.0f} per image and "
            f"{found.num_verified_pairs} of {found.num_pairs} verified pairs: "
            "see 'colmap-av1 info' for what the stream lacks, or convert it again with --reencode 1"
        )
    if found.assumes_video_focal_length:
        return (
            f"{failure}: the focal length is a default and may be far off, or there is too little "
            f"parallax, as when the camera moves along its optical axis: {give}"
        )
    return (
        f"{failure}: too little parallax between images that share tracks, or wrong intrinsics: "
        f"{give}"
    )
