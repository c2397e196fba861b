"""Records that a computation shares with its job are read and written with the keys of every recorded job."""

from __future__ import annotations

from service.computations import evaluate
from service.computations.further_cameras import DevelopAnswer, DevelopArguments
from service.compute.photography import PARAMETERS, Crop
from service.compute.scene import ControlSphere

DEVELOPED = {
    "viewpoint": "v001", "raw": "a" * 64, "jpeg": "b" * 64,
    "parameters": {
        "demosaic": "VNG", "white_balance": "camera", "primaries": "sRGB", "gamma": [1.0, 1.0], "highlights": "Clip",
        "auto_brightness": False, "noise_reduction": False, "orientation": 0, "bits": 16,
    },
}  # fmt: skip
ANSWER = {
    "raw": "a" * 64, "parameters": DEVELOPED["parameters"], "white_balance": [2.0, 1.0, 1.5, 0.0],
    "black_level": [512, 512, 512, 512], "white_level": 16383, "area": [1300, 870],
    "crop": {"left": 10, "top": 8, "width": 1280, "height": 853, "found": "file"},
    "shift_px": [0.0, 0.1], "largest_shift_px": 0.1, "rawpy": "0.25", "libraw": "0.21",
}  # fmt: skip
ROW = {
    "poses": "robot", "mean_radial_error_mm": 0.1,
    "control_spheres": [
        {"index": 0, "expected": 3, "measured": 2, "radial_error_mm": 0.1, "reprojection_error_px": None,
         "displacement_mm": None, "displacement_sigma_mm": None, "finding": ""},
    ],
}  # fmt: skip


def test_a_development_is_written_with_the_keys_that_were_read() -> None:
    arguments, answer = DevelopArguments.model_validate(DEVELOPED), DevelopAnswer.model_validate(ANSWER)
    assert arguments.parameters == PARAMETERS
    assert answer.crop == Crop(10, 8, 1280, 853, "file")
    assert arguments.plain() == DEVELOPED
    assert answer.plain() == ANSWER


def test_a_control_sphere_is_written_with_the_keys_that_were_read() -> None:
    row = evaluate.Row.model_validate(ROW)
    assert row.control_spheres == (ControlSphere(0, 3, 2, 0.1),)
    assert row.plain() == ROW
