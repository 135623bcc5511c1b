"""Map a matched database with pycolmap and print the model's figures.

python examples/map_with_pycolmap.py --database demo.db --image_path demo_frames --output demo_model
"""

import argparse
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap


def main() -> int:
    """Map, keep the model with the most images, print what it is worth."""
    parser = argparse.ArgumentParser(description="Map a COLMAP database with pycolmap.")
    parser.add_argument("--database", type=Path, required=True, help="COLMAP database with matches")
    parser.add_argument("--image_path", type=Path, required=True, help="folder of its images")
    parser.add_argument("--output", type=Path, required=True, help="folder for the model")
    parser.add_argument(
        "--forward_motion",
        action="store_true",
        help="the camera moves along its axis: start with such a pair, keep the intrinsics",
    )
    parser.add_argument("--seed", type=int, default=0, help="the mapper's random seed")
    arguments = parser.parse_args()
    if not arguments.database.is_file():
        parser.error(f"no database at {arguments.database}: run `colmap-av1 match` first")
    if not arguments.image_path.is_dir():
        parser.error(f"no folder at {arguments.image_path}: give the images of the database")

    with closing(sqlite3.connect(arguments.database)) as database:
        images_in_database = database.execute("SELECT COUNT(*) FROM images").fetchone()[0]
    pycolmap.set_random_seed(arguments.seed)
    arguments.output.mkdir(parents=True, exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    if arguments.forward_motion:
        options.mapper.init_max_forward_motion = 1.0
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(
        arguments.database, arguments.image_path, arguments.output, options=options
    )
    if not models:
        print(
            f"error: no model came out of {arguments.database}: its images share too few matches "
            "or too little parallax",
            file=sys.stderr,
        )
        return 1

    # The mapper may leave a bogus model of two images beside the real one.
    model = max(models.values(), key=lambda m: m.num_reg_images())
    model.write(arguments.output)
    focal = np.mean([camera.mean_focal_length() for camera in model.cameras.values()])
    print(f"images registered        {model.num_reg_images()} of {images_in_database}")
    print(f"points                   {model.num_points3D()}")
    print(f"mean reprojection error  {model.compute_mean_reprojection_error():.3f} px")
    print(f"mean track length        {model.compute_mean_track_length():.2f}")
    print(f"focal length             {focal:.2f} px")
    print(f"model written to         {arguments.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
