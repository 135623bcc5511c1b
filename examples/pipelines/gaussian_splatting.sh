#!/usr/bin/env bash
# A folder for graphdeco's 3D Gaussian Splatting; its convert.py only undistorts.
#
#   CONVERT=gaussian-splatting/convert.py gaussian_splatting.sh VIDEO SOURCE [options of match]
#
# Before, with the frames in SOURCE/input:
#   python convert.py -s SOURCE
set -euo pipefail

video=$1
source=$2
shift 2

mkdir -p "$source/distorted/sparse"
colmap-av1 match --database "$source/distorted/database.db" --video "$video" \
  --image_path "$source/input" --camera_model OPENCV \
  --keep_stream "$source/distorted/stream.mp4" \
  ${MASK_PATH:+--mask_path "$MASK_PATH"} "$@"

# The options are those of convert.py.
colmap mapper --database_path "$source/distorted/database.db" --image_path "$source/input" \
  --output_path "$source/distorted/sparse" --Mapper.ba_global_function_tolerance=0.000001

# Densify the largest model, which need not be model 0, and write it as model 0 for convert.py.
best=$(ls -S "$source/distorted/sparse"/*/images.bin | head -n 1) || exit 1
mv "$source/distorted/sparse" "$source/distorted/mapped"
best=${best/#"$source/distorted/sparse"/"$source/distorted/mapped"}
mkdir "$source/distorted/sparse"
colmap-av1 densify --model "$(dirname "$best")" --video "$video" --image_path "$source/input" \
  --keep_stream "$source/distorted/stream.mp4" --output "$source/distorted/sparse/0" \
  ${MASK_PATH:+--mask_path "$MASK_PATH"}

python "${CONVERT:-convert.py}" -s "$source" --skip_matching
