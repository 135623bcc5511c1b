#!/usr/bin/env bash
# hloc; 'match' and 'export' replace its extraction, pairs and matching.
#
#   hloc.sh VIDEO OUTPUTS [options of colmap-av1 match]
#
# Before, with the frames in OUTPUTS/images:
#   python -m hloc.extract_features --image_dir OUTPUTS/images --export_dir OUTPUTS
#   python -m hloc.pairs_from_exhaustive --features OUTPUTS/feats-superpoint-n4096-r1024.h5 \
#     --output OUTPUTS/pairs.txt
#   python -m hloc.match_features --pairs OUTPUTS/pairs.txt --export_dir OUTPUTS
set -euo pipefail

video=$1
outputs=$2
shift 2

mkdir -p "$outputs"
colmap-av1 match --database "$outputs/motion.db" --video "$video" \
  --image_path "$outputs/images" "$@"
colmap-av1 export --database "$outputs/motion.db" --output "$outputs"

# Only the file names change in the rest.
python -m hloc.reconstruction --sfm_dir "$outputs/sfm" --image_dir "$outputs/images" \
  --camera_mode SINGLE --features "$outputs/features.h5" --matches "$outputs/matches.h5" \
  --pairs "$outputs/pairs.txt"
