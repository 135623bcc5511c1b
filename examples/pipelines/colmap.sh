#!/usr/bin/env bash
# COLMAP; 'match' replaces extracting frames, feature extraction and matching.
#
#   colmap.sh VIDEO WORKSPACE [options of colmap-av1 match]
#
# Before:
#   ffmpeg -i VIDEO -qscale:v 1 WORKSPACE/images/%04d.jpg
#   colmap feature_extractor --database_path WORKSPACE/database.db \
#     --image_path WORKSPACE/images --ImageReader.single_camera 1
#   colmap sequential_matcher --database_path WORKSPACE/database.db
set -euo pipefail

video=$1
workspace=$2
shift 2

mkdir -p "$workspace/sparse"
colmap-av1 match --database "$workspace/database.db" --video "$video" \
  --image_path "$workspace/images" "$@"

# The rest is unchanged.
colmap mapper --database_path "$workspace/database.db" --image_path "$workspace/images" \
  --output_path "$workspace/sparse"
