"""Reports as rows of a name and a value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # these modules are slow to import
    from colmap_av1.batch.run import BatchReport
    from colmap_av1.check.database import DatabaseCheck
    from colmap_av1.check.model import ModelCheck
    from colmap_av1.densify import DensifyReport
    from colmap_av1.evaluate.report.results import CompareReport
    from colmap_av1.map import MapReport
    from colmap_av1.match_report import MatchReport
    from colmap_av1.matching.links.report import LinkReport
    from colmap_av1.matching.shutter.of_video import VideoReadOut
    from colmap_av1.motion.info import StreamReport
    from colmap_av1.poses.joint_matches import JointEstimate
    from colmap_av1.poses.placing.placement import Place
    from colmap_av1.reconstruct import ReconstructReport

Rows = list[tuple[str, str]]

# Reference distances with a smaller share are printed as one sum.
_LEAST_LISTED_SHARE = 0.005
_NUM_LISTED_GAPS = 4
# Focal lengths with a smaller relative difference are printed as one.
_SAME_FOCAL_LENGTH = 1e-4


def match_rows(report: MatchReport) -> Rows:
    """What `match` wrote."""
    names = {0.0: "shortest", 0.5: "median", 1.0: "longest"}
    lengths = [f"{names[q]} {n}" for q, n in report.track_lengths.items() if q in names]
    images = max(report.num_images, 1)
    inlier_share = report.num_inliers / max(report.num_matches, 1)
    rows = [
        ("database", str(report.database)),
        *(("stream", str(s or "converted, not kept (see --keep_stream)")) for s in report.streams),
        *_conversion_row(report.conversion),
        ("frames", f"{report.num_frames} shown, {report.num_coded_frames} coded"),
        ("images", f"{report.num_images}, {report.num_written_images} written"),
        *_mask_row(report.masked),
        *_shutter_row(report.read_outs),
        ("tracks", str(report.num_tracks)),
        ("images per track", ", ".join(lengths)),
        (
            "keypoints",
            f"{report.num_observations}, {report.num_observations / images:.0f} per image",
        ),
        ("pairs", f"{report.num_pairs}, {report.num_verified_pairs} verified"),
        ("matches", str(report.num_matches)),
        ("inliers", f"{report.num_inliers}, {inlier_share:.1%} of the matches"),
        ("configurations", ", ".join(f"{k} {n}" for k, n in report.configs.items())),
        *_link_rows(report.links),
    ]
    if report.estimate is not None:
        rows += _estimate_rows(report.estimate, report.num_images)
        name, words = _focal_length_row(report.estimate.focal_lengths)
        is_estimated = report.focal_length is not None
        rows.append((name, words if is_estimated else f"{words}, not estimated"))
    elif report.focal_length is not None:
        rows.append(("focal length", f"{report.focal_length:.1f} px, estimated"))
    if report.forward_motion:
        rows.append(("motion", "forward: the mapper needs the options below, and known intrinsics"))
    elif report.small_angles:
        rows.append(("triangulation angles", "small: the mapper starts well with the option below"))
    if report.fixed_intrinsics and not report.forward_motion:
        rows.append(("intrinsics", "not determined by a few images: the options below keep them"))
    return [*rows, *_seconds_rows(report.seconds)]


def _estimate_rows(estimate: JointEstimate, num_images: int) -> Rows:
    """The joint estimate of all poses that matches were verified against."""
    registered = " + ".join(map(str, estimate.num_registered))
    return [
        ("joint estimate", f"{registered} of {num_images} images registered"),
        *_dynamic_row(estimate.dynamic_share),
        *_long_range_rows(estimate.long_range, estimate.long_range_largest),
    ]


def map_rows(report: MapReport) -> Rows:
    """Figures of the model with the most images."""
    figures = report.figures
    rows = [
        ("images registered", f"{figures.num_registered} of {report.num_images}"),
        *([("motion", "forward")] if report.forward_motion else []),
        ("points", str(figures.num_points)),
        ("mean reprojection error", f"{figures.mean_error:.3f} px"),
        ("mean track length", f"{figures.mean_track_length:.2f}"),
        _focal_length_row(figures.focal_lengths),
        *_expected_error_row(report.expected_error),
    ]
    if report.long_range is not None:
        rows += _long_range_rows(report.long_range.median, report.long_range.largest)
    rows += _place_rows(report.place)
    if len(report.num_registered) > 1:
        others = ", ".join(map(str, report.num_registered[1:]))
        rows.append(("further models", f"with {others} images"))
    return [*rows, ("model written to", str(report.model))]


def _focal_length_row(focal_lengths: tuple[float, float]) -> tuple[str, str]:
    """The focal length of a model, or the range if its cameras differ."""
    shortest, longest = focal_lengths
    if longest - shortest < _SAME_FOCAL_LENGTH * longest:
        return ("focal length", f"{(shortest + longest) / 2:.2f} px")
    return ("focal lengths", f"{shortest:.2f} to {longest:.2f} px")


def _expected_error_row(expected_error: float | None) -> Rows:
    """Expected error of the camera positions; no row if it is not known."""
    if expected_error is None:
        return []
    return [("camera positions", f"expect errors of {expected_error:.3%} of their extent or more")]


def reconstruct_rows(report: ReconstructReport) -> Rows:
    """What `reconstruct` made."""
    rows = [
        ("output", str(report.output)),
        *_conversion_row(report.conversion),
        (
            "images",
            f"{report.num_registered} of {report.num_images} registered, {report.num_frames} "
            "frames in the video",
        ),
        *_mask_row(report.masked),
        *_dynamic_row(report.dynamic_share),
        *((f"images of {name}", f"{n} registered") for name, n in report.registered.items()),
        *(
            (f"images of {model.output.name}", f"{model.num_registered} registered")
            for model in report.other_models
        ),
        ("key images", str(report.num_key_images)),
        ("tracks", f"{report.num_tracks}, {report.num_pose_tracks} for the poses"),
        ("mapper", report.mapper),
        *_motion_row(report.forward_motion),
        ("points", f"{report.num_points}, {report.num_observations} observations"),
        ("coverage", f"{report.coverage:.1%} of the images"),
        ("reprojection error", f"{report.mean_error:.3f} px"),
        *_long_range_rows(report.long_range, report.long_range_largest),
        _focal_length_row(report.focal_lengths),
        *_expected_error_row(report.expected_error),
        *_shutter_row(report.read_outs),
        *_place_rows(report.place),
        *_link_rows(report.links),
        *_gaussians_rows(report.gaussians),
    ]
    if report.resumed:
        rows.append(("resumed stages", ", ".join(report.resumed)))
    return [*rows, *_seconds_rows(report.seconds)]


def _motion_row(is_forward: bool) -> Rows:
    """Motion along the camera's axis, which leaves the focal length uncertain."""
    return [("motion", "forward: give known intrinsics by --camera_params")] if is_forward else []


def _shutter_row(read_outs: Sequence[float | None]) -> Rows:
    """Read-out times of the shutter; no row if nothing was corrected."""
    if all(read_out is None for read_out in read_outs):
        return []
    words = (f"{r:.1f} ms" if r is not None else "none" for r in read_outs)
    return [("rolling shutter", f"{', '.join(words)} from the first row to the last")]


def _place_rows(place: Place) -> Rows:
    """Coordinate system of a model, and the data that determined it."""
    at = ""
    if (origin := place.origin) is not None:
        at = f" of {origin.latitude:.7f}, {origin.longitude:.7f}, {origin.altitude:.2f} m"
    rows = [("coordinates", f"units {place.units}, axes {place.axes}{at}")]
    return rows + ([("placed by", "; ".join(place.how))] if place.how else [])


def _long_range_rows(median: float | None, largest: float | None) -> Rows:
    """Long-range epipolar error of a model that was checked."""
    if median is None:
        return [("long-range epipolar error", "unknown: no images far apart in time overlap")]
    words = f"{median:.2f} px (median), {largest:.2f} px (90th percentile)"
    return [("long-range epipolar error", words)]


def model_rows(found: ModelCheck) -> Rows:
    """Figures of a model and of its long-range check."""
    figures, long_range = found.figures, found.long_range
    return [
        ("images", f"{figures.num_registered} registered"),
        ("points", f"{figures.num_points}, mean track length {figures.mean_track_length:.2f}"),
        ("coverage", f"{figures.coverage:.1%} of the images"),
        ("mean reprojection error", f"{figures.mean_error:.3f} px"),
        *(_long_range_rows(long_range.median, long_range.largest) if long_range else ()),
        _focal_length_row(figures.focal_lengths),
        *_expected_error_row(found.expected_error),
    ]


def _conversion_row(conversion: str | None) -> Rows:
    return [] if conversion is None else [("converted", conversion)]


def _mask_row(masked: float | None) -> Rows:
    return [] if masked is None else [("masks", f"exclude {masked:.1%} of the pixels")]


def _dynamic_row(share: float | None) -> Rows:
    return [] if share is None else [("dynamic pixels", f"{share:.1%}")]


def _link_rows(links: LinkReport) -> Rows:
    """SIFT links and gaps; no row if no features were matched."""
    if links.num_images == 0:
        return []
    frames = links.frames_of_gaps()
    shown = ", ".join(_named(gap, links.videos) for gap in frames[:_NUM_LISTED_GAPS])
    more = ", ..." if len(frames) > _NUM_LISTED_GAPS else ""
    gaps = f", gaps at frames {shown}{more}" if frames else ""
    pairs = (
        f"{links.num_links} pairs from {links.num_images} images, "
        f"{links.num_loop_closures} loop closures"
    )
    between = f", {links.num_between} between videos or photos" if links.num_between else ""
    return [("SIFT links", f"{pairs}{between}{gaps}")]


def _named(gap: Sequence[int], videos: Sequence[tuple[str, int]]) -> str:
    """The frames of a gap, counted from the start of their video, with its name if several."""
    from colmap_av1.matching.links.report import gap_in_video

    name, before, after = gap_in_video(gap, videos)
    return f"{name} {before}-{after}".strip()


def densify_rows(report: DensifyReport) -> Rows:
    """What `densify` made."""
    return [
        ("output", str(report.output)),
        *_conversion_row(report.conversion),
        ("images", str(report.num_images)),
        *_mask_row(report.masked),
        ("tracks", f"{report.num_tracks}, {report.agreement:.1%} agree with the poses"),
        ("points", f"{report.num_points}, {report.num_model_points} in the given model"),
        (
            "coverage",
            f"{report.coverage:.1%} of the images, {report.model_coverage:.1%} in the given model",
        ),
        ("reprojection error", f"{report.mean_error:.3f} px"),
        *_gaussians_rows(report.gaussians),
        *_seconds_rows(report.seconds),
    ]


def batch_rows(report: BatchReport) -> Rows:
    """Results and cost of a batch."""
    kept = f", {report.num_kept} of them in earlier runs" if report.num_kept else ""
    rows = [
        ("output", report.output),
        ("videos", str(report.num_videos)),
        ("done", f"{report.num_done}{kept}"),
        ("failed", ", ".join(f"{n} {reason}" for reason, n in report.failed.items()) or "0"),
        ("retried", str(report.num_retried)),
        ("seconds", f"{report.seconds:.2f}"),
        ("CPU seconds", f"{report.cpu_seconds:.2f}"),
    ]
    if report.video_seconds > 0:
        minutes = report.video_seconds / 60
        hours = report.cpu_seconds / 3600 / minutes * 1000
        rows.append(("cost", f"{hours:.1f} CPU hours per 1,000 minutes of video"))
    return rows


def compare_rows(report: CompareReport) -> Rows:
    """Results of `compare`, a row for each front-end."""
    rows = []
    for column in report.columns:
        words = "no model"
        if column.model is not None:
            words = (
                f"{column.model.num_registered} of {report.num_images} images, "
                f"{column.model.num_points} points, {column.model.coverage:.1%} coverage, "
                f"{column.model.mean_error:.3f} px, "
                f"{sum(column.cpu_seconds.values()):.1f} s of CPU time"
            )
        rows.append((column.name, words))
    return [*rows, ("report", str(report.output / "report.html"))]


def info_rows(report: StreamReport) -> Rows:
    """The structure of a stream."""
    rate = f"{report.frame_rate:.2f} per second" if report.frame_rate else "unknown"
    distances = sorted(report.reference_distances.items(), key=lambda item: -item[1])
    listed = [item for item in distances if item[1] >= _LEAST_LISTED_SHARE]
    references = [f"{distance:+d} {share:.1%}" for distance, share in listed]
    if len(listed) < len(distances):
        rest = sum(share for _, share in distances[len(listed) :])
        references.append(f"others {rest:.1%}")
    if report.hidden_reference_share > 0:
        references.append(f"hidden {report.hidden_reference_share:.1%}")
    frames = (
        f"{report.num_shown} shown, {report.num_coded} coded, {report.num_hidden} never shown, "
        f"{report.num_intra_frames} intra"
    )
    if report.num_cut:
        frames += f", {report.num_cut} hidden by an edit list"
    motion = "none"
    if not math.isnan(report.median_motion):
        share = report.median_motion / max(report.width, report.height)
        motion = f"{report.median_motion:.2f} px per frame, {share:.1%} of the longer side"
    display = report.display
    mirrored = ", then mirrored top to bottom" if display.is_mirrored else ""
    cropped = any(display.crop)
    return [
        ("video", str(report.path)),
        ("container", report.container),
        ("codec", "av1"),
        ("size", f"{report.width}x{report.height}"),
        ("rotation", f"{display.rotation}{mirrored}"),
        *([("cropped", "{} left, {} top, {} right, {} bottom".format(*display.crop))] * cropped),
        *([("pixel aspect", f"{display.pixel_aspect:.3f}")] * (display.pixel_aspect != 1)),
        ("frame rate", rate),
        ("frames", frames),
        ("references", ", ".join(references) or "none"),
        ("inter-coded area", f"{report.inter_share:.1%}"),
        ("median motion", motion),
        ("bytes per frame", f"{report.bytes_per_frame:.0f}"),
        ("bits per pixel", f"{report.bits_per_pixel:.3f}"),
        ("for matching", "; ".join(report.reasons) or "good"),
    ]


def read_out_rows(found: VideoReadOut | str | None) -> Rows:
    """The read-out time of the shutter, or why it is not observable; None: not requested."""
    if found is None:
        return []
    if isinstance(found, str):
        return [("rolling shutter", f"not observable: {found}")]
    words = f"{found.milliseconds:.1f} +- {found.error:.1f} ms from the first row to the last"
    return [("rolling shutter", words)]


def check_rows(report: DatabaseCheck) -> Rows:
    """Contents of a database, and whether the mappers can use it."""
    sizes = [f"{w}x{h} {n}" for (w, h), n in report.image_sizes.items()]
    shapes = [f"{n} with {c} columns" for c, n in report.keypoint_columns.items()]
    share = report.num_matched_keypoints / max(report.num_keypoints, 1)
    rows = [
        ("database", str(report.database)),
        ("layout", f"COLMAP {report.layout} (version {report.user_version})"),
        ("opened by", f"COLMAP {report.readers}"),
        ("images", f"{report.num_images}, {report.num_connected_images} connected"),
        ("sizes", ", ".join(sizes) or "none"),
        ("cameras", f"{report.num_cameras}, {report.num_priors} with a known focal length"),
        ("keypoints", f"{report.num_keypoints}, {share:.1%} matched"),
        ("keypoint rows", ", ".join(shapes) or "none"),
        ("descriptors", f"in {report.num_described_images} images"),
        (
            "pairs",
            f"{report.num_pairs} with inliers, {report.num_used_pairs} used, "
            f"{report.num_empty_pairs} empty",
        ),
        ("inliers", str(report.num_inliers)),
        ("configurations", ", ".join(f"{k} {n}" for k, n in report.configs.items()) or "none"),
    ]
    if report.parallax is not None:
        wide = report.parallax
        how = "" if wide.focal_known else " for a default focal length"
        angle = "unknown" if wide.angle is None else f"{wide.angle:.1f} degrees{how}"
        pair = f"widest pair {wide.displacement:.0f} px ({' - '.join(wide.names)})"
        rows.append(("parallax", f"{angle}, {pair}"))
    rows += [(finding.severity, finding.text) for finding in report.findings]
    warned = any(finding.severity == "warning" for finding in report.findings)
    ready = "usable, see the warnings" if warned else "good"
    rows.append(("for mapping", ready if report.mappable else "not ready"))
    return rows


def _gaussians_rows(path: Path | None) -> Rows:
    return [("gaussians", str(path))] if path is not None else []


def _seconds_rows(seconds: dict[str, float]) -> Rows:
    rows = [(f"seconds, {stage}", f"{s:.2f}") for stage, s in seconds.items()]
    return [*rows, ("seconds, total", f"{sum(seconds.values()):.2f}")]


def without_seconds(rows: Rows) -> Rows:
    """The rows without the times of stages."""
    return [row for row in rows if not row[0].startswith("seconds")]
