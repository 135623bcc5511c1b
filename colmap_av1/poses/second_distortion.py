"""Decide whether a camera needs a second distortion parameter, from the model of a mapper."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from colmap_av1.geometry.cameras import as_radial
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.options.camera import DEFAULT_MODEL
from colmap_av1.poses.adjusting import LOSS_SCALES, adjust_posed, mean_cost, refines_intrinsics
from colmap_av1.poses.run import Run

# A camera gets a second distortion parameter if at least this many images share it and the
# parameter lowers the mean robust cost below this share. On clips of distorting lenses the share is
# 0.967 to 0.997; on rendered ones without distortion, and on drives, which determine neither the
# focal length nor the distortion, it is 0.999 to 1.
_FEWEST_IMAGES, _COST_SHARE = 8, 0.998
# The focal length changes by up to a fifth then, and converges slowly.
_STEPS, _TOLERANCE = 50, 1e-5


def with_second_distortion(run: Run, model: PosedModel) -> PosedModel:
    """Make cameras of the default model RADIAL if the images show that they need it.

    A mapper that does not know the focal length begins with one distortion parameter, because a
    pair of images rarely determines two. With many lenses, one parameter biases the focal length
    and bends the path.

    Args:
        run: the run.
        model: a model of the mapper, with points.

    Returns:
        The adjusted model; the given one if no camera needs a second parameter.
    """
    num_images = Counter(image.camera_id for image in model.images)
    numbers = {
        number
        for number, camera in model.cameras.items()
        if camera.model_name == DEFAULT_MODEL and num_images[number] >= _FEWEST_IMAGES
    }
    options = run.options
    is_given = run.cameras is not None or options.match.camera.camera_model is not None
    is_adjusted = options.poses.adjust and refines_intrinsics(options)
    if is_given or not is_adjusted or not numbers:
        return model

    def adjusted(own: PosedModel) -> PosedModel:
        return adjust_posed(
            run,
            own,
            loss_scales=LOSS_SCALES[-1:],
            max_steps=_STEPS,
            tolerance=_TOLERANCE,
        ).model

    simple = adjusted(model)
    cameras = {i: as_radial(own) if i in numbers else own for i, own in simple.cameras.items()}
    radial = adjusted(replace(simple, cameras=cameras))
    simple_cost, radial_cost = (mean_cost(reprojection_errors(own)) for own in (simple, radial))
    return radial if radial_cost < _COST_SHARE * simple_cost else model
