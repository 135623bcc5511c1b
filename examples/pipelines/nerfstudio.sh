#!/usr/bin/env bash
# A folder for nerfstudio; ns-process-data writes it without matching.
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
  --image_path "$data/frames" --camera_model OPENCV \
  --keep_stream "$data/colmap/stream.mp4" \
  ${MASK_PATH:+--mask_path "$MASK_PATH"} "$@"
colmap mapper --database_path "$data/colmap/database.db" --image_path "$data/frames" \
  --output_path "$data/colmap/sparse" --Mapper.ba_global_function_tolerance=1e-6

# Use the largest model, which need not be model 0.
best=$(ls -S "$data/colmap/sparse"/*/images.bin | head -n 1) || exit 1
best=$(dirname "$best")
colmap bundle_adjuster --input_path "$best" --output_path "$best" \
  --BundleAdjustment.refine_principal_point 1

# Densify this model, and write it as model 0 for ns-process-data.
mv "$data/colmap/sparse" "$data/colmap/mapped"
best=${best/#"$data/colmap/sparse"/"$data/colmap/mapped"}
mkdir "$data/colmap/sparse"
colmap-av1 densify --model "$best" --video "$video" --image_path "$data/frames" \
  --keep_stream "$data/colmap/stream.mp4" --output "$data/colmap/sparse/0" \
  ${MASK_PATH:+--mask_path "$MASK_PATH"}

ns-process-data images --data "$data/frames" --output-dir "$data" --skip-colmap
