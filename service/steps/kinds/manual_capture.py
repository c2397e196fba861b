"""Step kind `manual_capture`: a person holds the camera; after each image, the software says where to go next."""

from __future__ import annotations

from drivers.errors import DeviceTimeoutError
from service.steps.context import Announcement, StepContext, StepKind, StepOutcome
from service.steps.handheld import Guide, Measures, Params, Result, common_arguments
from service.steps.held_camera import HeldCamera

_KINDS = {"dataset": "image", "control": "control_image", "calibration": "board_image"}


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Take images until the step's gates pass or somebody ends the capture."""
    guide = Guide(context, params, common_arguments(context, params))
    held = HeldCamera(context, params.prefix, _KINDS[params.purpose])
    guide.begin()
    last_s = context.monotonic_s()
    while not (held.finished or guide.enough()):
        context.checkpoint()
        held.waiting(guide.images_used(), params.min_images)
        if held.new_views():
            last_s = context.monotonic_s()
        guide.look()
        if context.monotonic_s() - last_s > params.wait_s:
            raise DeviceTimeoutError(
                f"no image came within {params.wait_s:.0f} s",
                where=f"step {context.step.id}",
                remedy="Check camera and cable; the images so far are safe. Confirm to continue",
            )
    return guide.outcome()


KIND = StepKind(
    "manual_capture",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, _before: Announcement(
        "begin to take images by hand", "Nothing moves. The screen says where to hold the camera."
    ),
    drawing="camera",
)
