#!/usr/bin/env bash
# COLMAP with SIFT features; 'match' appends keypoints and matches from motion.
#
#   colmap_with_sift.sh VIDEO WORKSPACE [options of colmap-av1 match]
#
# Before: the same without the line of colmap-av1. SIFT connects overlapping images far apart in
# time, which motion does not; motion gives many more points. Without a GPU:
#   export EXTRACTOR_OPTIONS='--SiftExtraction.use_gpu 0' MATCHER_OPTIONS='--SiftMatching.use_gpu 0'
set -euo pipefail

video=$1
workspace=$2
shift 2

mkdir -p "$workspace/images" "$workspace/sparse"
ffmpeg -v error -i "$video" "$workspace/images/%04d.png"
colmap feature_extractor --database_path "$workspace/database.db" \
  --image_path "$workspace/images" --ImageReader.single_camera 1 ${EXTRACTOR_OPTIONS:-}
colmap sequential_matcher --database_path "$workspace/database.db" ${MATCHER_OPTIONS:-}

colmap-av1 match --database "$workspace/database.db" --video "$video" --on_existing append "$@"

colmap mapper --database_path "$workspace/database.db" --image_path "$workspace/images" \
  --output_path "$workspace/sparse"
