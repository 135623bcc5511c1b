#!/usr/bin/env bash
# COLMAP with dense points: its triangulator triangulates all tracks on the mapper's poses.
#
#   colmap_dense.sh VIDEO WORKSPACE [options of colmap-av1 match]
#
# Before:
#   colmap patch_match_stereo, stereo_fusion
set -euo pipefail

video=$1
workspace=$2
shift 2

# Few tracks for the poses, and all tracks in a second database of the same images.
mkdir -p "$workspace/sparse" "$workspace/poses" "$workspace/dense"
colmap-av1 match --database "$workspace/database.db" --video "$video" \
  --image_path "$workspace/images" --keep_stream "$workspace/stream.mp4" "$@"
colmap-av1 match --database "$workspace/dense.db" --video "$video" \
  --image_path "$workspace/images" --keep_stream "$workspace/stream.mp4" "$@" --preset dense

colmap mapper --database_path "$workspace/database.db" --image_path "$workspace/images" \
  --output_path "$workspace/sparse"

# Keep the poses of the largest model, which need not be model 0. Remove its points, because the
# triangulator refuses keypoints that are not in its database.
best=$(dirname "$(ls -S "$workspace/sparse"/*/images.bin | head -n 1)")
colmap model_converter --input_path "$best" --output_path "$workspace/poses" --output_type TXT
awk '!/^#/ { print ++n % 2 ? $0 : "" }' "$workspace/poses/images.txt" >"$workspace/poses/posed.txt"
mv "$workspace/poses/posed.txt" "$workspace/poses/images.txt"
: >"$workspace/poses/points3D.txt"

colmap point_triangulator --database_path "$workspace/dense.db" \
  --image_path "$workspace/images" --input_path "$workspace/poses" \
  --output_path "$workspace/dense"
