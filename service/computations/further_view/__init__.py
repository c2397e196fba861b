"""Job kind `further_view`: the sharpness and the spheres of an image that a further camera has just taken."""

from __future__ import annotations

from service.computations.kind import Demand, JobKind, JobRecord
from service.computations.records import Hash, ImageFile, Matrix, Point


class Arguments(JobRecord):
    """One image of a further camera.

    Attributes:
        device: name of the camera in rig.yaml.
        image: the viewpoint at which it was taken, and its file.
        calibration: file with the camera's intrinsics, as `calibrate intrinsics` writes it.
        spheres_m: the spheres' centres in the CT.
        radius_m: the spheres' radius.
    """

    device: str
    image: ImageFile
    calibration: Hash
    spheres_m: tuple[Point, ...]
    radius_m: float


class Answer(JobRecord):
    """The camera's pose by one image.

    Attributes:
        viewpoint: the viewpoint at which the image was taken.
        device: name of the camera in rig.yaml.
        T_ct_camera: the camera's pose by this image alone; None if it shows too few spheres, and `reason` says so.
        reason: the reason why there is no pose.
        black: true if the image is black.
    """

    viewpoint: str
    device: str
    T_ct_camera: Matrix | None = None
    reason: str = ""
    black: bool = False


KIND = JobKind(
    name="further_view",
    arguments=Arguments,
    answer=Answer,
    compute="service.computations.further_view.compute:further_view",
    words="images of further cameras as they arrive",
    order=32,
    replayed=False,
    aside=True,
    demand=lambda _: Demand(memory_mb=1200, limit_s=900),
)
