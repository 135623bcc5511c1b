#!/usr/bin/env bash
# The folder that nerfstudio trains on; its ns-process-data does all but the matching.
#
#   nerfstudio.sh VIDEO DATA [options of colmap-av1 match]
#
# Before:
#   ns-process-data video --data VIDEO --output-dir DATA
set -euo pipefail

video=$1
data=$2
shift 2

mkdir -p "$data/colmap/sparse"
colmap-av1 match --database "$data/colmap/database.db" --video "$video" \
  --image_path "$data/frames" --camera_model OPENCV "$@"
colmap mapper --database_path "$data/colmap/database.db" --image_path "$data/frames" \
  --output_path "$data/colmap/sparse" --Mapper.ba_global_function_tolerance=1e-6

# ns-process-data takes model 0; the mapper may leave smaller ones before the real one.
best=$(ls -S "$data/colmap/sparse"/*/images.bin | head -n 1) || exit 1
best=$(dirname "$best")
if [[ $best != "$data/colmap/sparse/0" ]]; then
  mv "$data/colmap/sparse/0" "$data/colmap/sparse/smaller"
  mv "$best" "$data/colmap/sparse/0"
fi
colmap bundle_adjuster --input_path "$data/colmap/sparse/0" \
  --output_path "$data/colmap/sparse/0" --BundleAdjustment.refine_principal_point 1

ns-process-data images --data "$data/frames" --output-dir "$data" --skip-colmap
