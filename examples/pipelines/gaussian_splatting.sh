#!/usr/bin/env bash
# The folder that graphdeco's 3D Gaussian Splatting trains on; its convert.py only undistorts.
#
#   CONVERT=gaussian-splatting/convert.py gaussian_splatting.sh VIDEO SOURCE [options of match]
#
# Before, with the frames cut into SOURCE/input:
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

# As convert.py calls it.
colmap mapper --database_path "$source/distorted/database.db" --image_path "$source/input" \
  --output_path "$source/distorted/sparse" --Mapper.ba_global_function_tolerance=0.000001

# The points that training starts from are many more than the mapper's, on its poses. convert.py
# takes model 0; the mapper may leave smaller ones before the real one.
best=$(ls -S "$source/distorted/sparse"/*/images.bin | head -n 1) || exit 1
mv "$source/distorted/sparse" "$source/distorted/mapped"
best=${best/#"$source/distorted/sparse"/"$source/distorted/mapped"}
mkdir "$source/distorted/sparse"
colmap-av1 densify --model "$(dirname "$best")" --video "$video" --image_path "$source/input" \
  --keep_stream "$source/distorted/stream.mp4" --output "$source/distorted/sparse/0" \
  ${MASK_PATH:+--mask_path "$MASK_PATH"}

python "${CONVERT:-convert.py}" -s "$source" --skip_matching
