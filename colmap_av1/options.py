"""Options of every stage: frozen dataclasses whose field comments are the help text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

OnExisting = Literal["error", "append", "replace"]
Mapper = Literal["incremental", "global"]


@dataclass(frozen=True)
class ReadOptions:
    """How the bitstream is read."""

    # operating point of a scalable stream (7.20, choose_operating_point)
    operating_point: int = 0
    # threads that parse tiles, and groups of frames that start at a key frame, side by side;
    # None: one per CPU. The result does not depend on it
    num_threads: int | None = None
    # fail on a damaged stream instead of using the frames before the damage
    strict: bool = False
    # largest accepted frame, in luma samples; guards memory against hostile headers
    max_frame_size: int = 16384 * 16384


@dataclass(frozen=True)
class EncodeOptions:
    """How a video that is not AV1 is converted."""

    # the encoder; 'auto': the first that works, hardware before software
    encoder: Literal["auto", "nvenc", "qsv", "amf", "vaapi", "libaom", "svt"] = "auto"
    # constant quantiser, 0 (best) to 63; None: the encoder's default
    quality: int | None = None
    # preset on the encoder's own scale: -cpu-used of libaom (5 and up its realtime mode), -preset
    # of others; None: its default
    speed: int | None = None


@dataclass(frozen=True)
class TrackOptions:
    """How displacements are chained into tracks."""

    # shown frames a track is seen in at least; None: 4, and 3, or min_observations where that
    # is less, for tracks that only points of a dense model come from
    min_length: int | None = None
    # end a track where the space-time cosine between its motion and the motion predicted
    # from the step before falls below this; None: never
    cosine: float | None = 0.3
    # 'dominant': predict the change of the frame's dominant motion too, so a shaking
    # camera ends no track; 'none': expect the motion to stay as it was
    cosine_relative_to: Literal["dominant", "none"] = "dominant"
    # time component of the space-time vectors, in pixels per shown frame: motion well
    # below it has no direction to test
    cosine_scale: float = 1.0
    # longest step a displacement may take, in shown frames; None: any
    max_interval: int | None = 16
    # largest block whose motion is trusted, in px^2; None: any
    max_block_area: int | None = 1024
    # the same for blocks without coded residual, which the encoder never corrected
    max_uncoded_block_area: int | None = 1024
    # do not trust a block whose displacement d differs by more than this many pixels, and
    # |d|/8 times as many on top, from that of most units around it; None: no such test
    smoothness: float | None = 4.0
    # do not trust motion that starts or ends within this many pixels of the picture's edge:
    # the encoder had no picture to compare with beyond it; None: trust all
    border: float | None = 14.0
    # let motion vary within a block, towards blocks beside it whose displacements differ by
    # less than this many pixels; None: move a block as one
    interpolation: float | None = 1.5
    # carry tracks over blocks without motion, such as intra ones, and over gaps that blocks leave
    # between them, where the motion on either side differs by less than this many pixels; None:
    # end them there
    bridge: float | None = 2.0
    # width in pixels of the squares of a frame that hold one track each, 4, 2 or 1: of two tracks
    # that come to lie in one the longer goes on. None: 4, and 2 where points of a dense model are
    # wanted
    cell: int | None = None
    # width in pixels of the squares of a frame that a track starts in where they hold none: 4, 2
    # or 1, not below that of a cell. Motion is coded for squares of 4
    seeding: int = 4


@dataclass(frozen=True)
class RefineOptions:
    """How track positions are corrected on decoded pictures."""

    # 'lk': correct positions by Lucas-Kanade on the decoded pictures; 'none': decode nothing
    refine: Literal["none", "lk"] = "none"
    # width in pixels of the window that is matched, odd
    refine_window: int = 9
    # pixels along either axis by which a position may be corrected
    refine_move: float = 1.5
    # mean difference of two windows that match, as a share of their contrast
    refine_difference: float = 0.25


@dataclass(frozen=True)
class DensityOptions:
    """How many of the tracks are used; options that are None are set by the preset."""

    # 'sparse': few and sure ones, for poses; 'default': for maps; 'dense': all
    preset: Literal["sparse", "default", "dense"] = "default"
    # tracks an image sees at most, the surest first; 0: any number
    max_tracks_per_image: int | None = None
    # width in pixels of the cells of an image that one track each is wanted in; 0: any
    spacing: float | None = None
    # images a track is seen in at least
    min_length: int | None = None
    # largest expected error of a position against its track's first, in pixels; 0: any
    max_sigma: float | None = None
    # tracks an image keeps beyond that, for views from far apart: those that moved nearly as far
    # as any, with errors up to a thirtieth of the way; 0: none
    wide_tracks: int | None = None


@dataclass(frozen=True)
class PairOptions:
    """Which image pairs are written."""

    # distances between the images of a pair, in images, that every image is paired at
    offsets: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 8, 10)
    # beyond the last offset each distance is this times the one before, up to the longest
    # span that still shares enough tracks; 1: no pairs beyond the last offset
    growth: float = 1.4
    # largest distance between the images of a pair; None: as far as tracks reach
    max_span: int | None = None
    # shared tracks a pair needs
    min_matches: int = 15


@dataclass(frozen=True)
class VerifyOptions:
    """How the two-view geometry of a pair is found; the defaults are COLMAP's."""

    # largest Sampson (E, F) or transfer (H) error of an inlier, in pixels
    max_error: float = 4.0
    # inliers a geometry needs
    min_num_inliers: int = 15
    # the focal length prior is believed where E has more than this share of F's inliers
    min_e_f_inlier_ratio: float = 0.95
    # a pair is planar or panoramic where the homography that COLMAP finds has more than this share
    # of the inliers
    max_h_inlier_ratio: float = 0.8
    # matches that models are searched on, spread over the image; more of them refine a model,
    # all are tested
    max_samples: int = 128
    # iterations of the robust estimators at most
    max_iterations: int = 10000
    # probability with which a robust estimator stops on an outlier-free sample
    confidence: float = 0.999
    # the same seed gives the same bytes
    seed: int = 0
    # threads; None: one per CPU. The result does not depend on it
    num_threads: int | None = None


@dataclass(frozen=True)
class CameraOptions:
    """The camera written for new images."""

    # name of one of COLMAP's camera models; None: RADIAL where the tracks tell the focal length,
    # else SIMPLE_RADIAL; OPENCV, which has two focal lengths, where pixels are not square
    camera_model: str | None = None
    # its parameters as COLMAP spells them, such as 'f,cx,cy,k'; None: the focal length that
    # the tracks tell, else 1.2 times the longer side, to be refined; principal point in the centre
    camera_params: str | None = None
    # one camera for all images instead of one for each
    single_camera: bool = True


@dataclass(frozen=True)
class ImageOptions:
    """Which frames of the video are images; all, unless one of the options chooses."""

    # file name of new images; the number is the frame's display index, from 0
    image_name: str = "frame_%06d.png"
    # as many frames, spread over the video
    num_images: int | None = None
    # every n-th frame
    every: int | None = None
    # so many frames a second, by the time stamps
    fps: float | None = None
    # file that lists the frames, a line each: index, and if wanted the image's name
    frame_list: str | None = None
    # 'time': num_images at equal distances in time; 'parallax': at equal steps of parallax
    # along the tracks
    select: Literal["time", "parallax"] = "time"
    # take a sharp frame nearby that serves as well in place of a blurred one; only where
    # num_images or fps choose and images are written
    skip_blurred: bool = True
    # number in an existing image's name of the video's first frame; None: only where the
    # names and their count leave no doubt which frame an image is
    first_number: int | None = None


@dataclass(frozen=True)
class MatchOptions:
    """Everything `match` can be told; seed and threads are those of `verify`."""

    images: ImageOptions = ImageOptions()
    encode: EncodeOptions = EncodeOptions()
    read: ReadOptions = ReadOptions()
    tracks: TrackOptions = TrackOptions()
    refine: RefineOptions = RefineOptions()
    density: DensityOptions = DensityOptions()
    pairs: PairOptions = PairOptions()
    verify: VerifyOptions = VerifyOptions()
    camera: CameraOptions = CameraOptions()
    # what becomes of keypoints and matches that listed images have already: 'error': refuse
    # the database; 'append': keep them, add the new ones after them; 'replace': remove them
    on_existing: OnExisting = "error"
    # file that keeps the AV1 stream of a video that is not AV1, for further runs; None: the
    # output folder of reconstruct and compare keeps it, other commands keep none
    keep_stream: str | None = None
    # convert an AV1 video, too, where its structure is poor for matching
    reencode: bool = False


@dataclass(frozen=True)
class TriangulateOptions:
    """What makes a track a point."""

    # largest reprojection error of an observation, in pixels
    max_reprojection_error: float = 2.0
    # smallest angle, in degrees, at which the widest two rays of a point meet
    min_angle: float = 1.5
    # largest expected error of a point's distance from the cameras, as a share of it, by the
    # angle and the reprojection error of its rays; None: any
    max_depth_error: float | None = 0.07
    # observations a point needs
    min_observations: int = 3


@dataclass(frozen=True)
class MapOptions:
    """How a database is mapped."""

    # which of COLMAP's mappers: 'incremental' or 'global'
    mapper: Mapper = "incremental"
    # the camera moves along its axis: let the incremental mapper start with such a pair
    forward_motion: bool = False
    # refine focal length and distortion; None: unless the camera moves along its axis, which leaves
    # them undetermined
    refine_intrinsics: bool | None = None
    # the mapper's random seed
    seed: int = 0
    # threads of the mapper; with several, the last digits of its results change from run to run;
    # None: one per CPU
    num_threads: int | None = None


@dataclass(frozen=True)
class MapperOptions:
    """How the poses are found."""

    # COLMAP's 'incremental' or 'global' mapper; 'auto': the global one where camera_params
    # are given or the tracks tell the focal length, else the incremental one
    mapper: Literal["auto", "incremental", "global"] = "auto"
    # refine focal length and distortion; None: unless camera_params are given
    refine_intrinsics: bool | None = None
    # tracks an image gives to the poses
    pose_tracks_per_image: int = 600
    # width in pixels of the cells of an image that one of these tracks each is wanted in
    pose_spacing: float = 16.0
    # threads of the mapper and the adjustment; with several, the last digits of their results
    # change from run to run
    mapper_threads: int = 1
    # adjust the poses once more on points of more tracks, and of all lengths
    adjust: bool = True


@dataclass(frozen=True)
class ReconstructOptions:
    """Everything `reconstruct` can be told; of `match`, all but the tracks' density applies."""

    match: MatchOptions = MatchOptions()
    mapping: MapperOptions = MapperOptions()
    triangulate: TriangulateOptions = TriangulateOptions()


@dataclass(frozen=True)
class DensifyOptions:
    """Everything `densify` can be told."""

    match: MatchOptions = MatchOptions()
    triangulate: TriangulateOptions = TriangulateOptions()


@dataclass(frozen=True)
class LearnedOptions:
    """How learned features are found and matched for a comparison."""

    # keypoints of an image at most
    max_keypoints: int = 2048
    # images are scaled down to this many pixels along the longer side
    max_image_size: int = 1024
    # only every n-th image is matched; the others stay without a pose
    learned_every: int = 1
    # distances between the images of a pair, in images that are matched; None: all pairs of
    # up to 30 images, else 1,2,4,8
    learned_offsets: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ExportOptions:
    """What is written of a database for other programs."""

    # whose layout the files have
    format: Literal["hloc"] = "hloc"
    # only matches that agree with their pair's two-view geometry
    verified: bool = True


@dataclass(frozen=True)
class CompareOptions:
    """Everything `compare` can be told; of `match`, all but the density and rows applies."""

    match: MatchOptions = MatchOptions()
    learned: LearnedOptions = LearnedOptions()
    triangulate: TriangulateOptions = TriangulateOptions()
    # what is compared, in this order: av1, av1-sparse, av1-dense, the same as av1-refined...,
    # sift-exhaustive, sift-sequential, disk-lightglue, aliked-lightglue, and what other programs
    # wrote in hloc's layout as NAME=FEATURES.h5:MATCHES.h5
    frontends: tuple[str, ...] = ("av1", "av1-refined", "sift-exhaustive", "sift-sequential")
    # beside each of this package's models one of all its tracks on the same poses
    all_tracks: bool = True
    # trains 3D Gaussians on half of each model's images: 'gsplat', which needs CUDA, or a shell
    # command with {data}, the folder of that half, and of {test}, the other half's, {output},
    # {renders}, which gets the renderings of the test images, {iterations} and {name}
    trainer: str | None = None
    # of the training
    iterations: int = 30_000
    # iterations after which gsplat's renderings are measured, too
    milestones: tuple[int, ...] = (1000, 3000, 7000, 15_000)
    # write the two halves even where nothing is trained
    split: bool = False


@dataclass(frozen=True)
class ViewOptions:
    """How motion and tracks are drawn over the frames of a video."""

    # 'motion': direction of motion as colour; 'tracks': tracks with tails; 'both': one
    # beside the other
    draw: Literal["motion", "tracks", "both"] = "both"
    # share of the motion's colour in the picture
    opacity: float = 0.6
    # frames a track's tail reaches back
    tail: int = 8
    # one track is drawn for each square of this many pixels
    spacing: int = 8
