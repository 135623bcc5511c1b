"""Results of stages that tests do not run."""

from __future__ import annotations

from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.poses.match_stage import MatchesResult

# The match stage of no images, without links. Tests replace what they depend on.
MATCHES = MatchesResult(
    links=LinkReport(),
    warnings=(),
    key_images=(),
    num_pose_tracks=0,
    assumes_video_focal_length=False,
    forward_motion=False,
    depth=DepthEvidence(0, 0, is_focal_length_known=False),
    num_pairs=0,
    num_flat_pairs=0,
    num_verified_pairs=0,
    keypoints_per_image=0.0,
)
