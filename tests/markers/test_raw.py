"""Outlines measured in developed raw files, through the jobs that a run enqueues."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.computations import job_kinds
from service.computations.job import JobContext, RecordedContext, handler_of
from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.photography import PARAMETERS
from service.core.errors import DataError
from service.core.geometry import Array, apply, inverse
from service.store.store import Store
from simulators.rendering.render import REFERENCE, Renderer
from simulators.rendering.sensor import camera_picture, read_out
from simulators.scene.world import NOMINAL_LUX, Scene
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw
from tests.support.scenes.scene_photographs import pose_above

WIDTH = 900
SETTINGS = ExposureSettings(22.0, 1 / 15, (1, 15), 100)


def stored(store: Store, data: bytes, name: str) -> str:
    kind, media = ("raw", "image/x-sony-arw") if name.endswith(".ARW") else ("image", "image/jpeg")
    return store.put_bytes(data, kind=kind, media_type=media, original_name=name).sha256


def centre_errors_px(outlines: list[dict[str, Any]], T_camera_world: Array, scene: Scene, lens: CameraModel) -> Array:
    """Distance of each outline from the sphere that it belongs to."""
    axes = np.array([cone_of_sphere(c, scene.radius_m).axis for c in apply(T_camera_world, scene.registration_m)])
    seen, true = lens.project(np.array([outline["axis"] for outline in outlines])), lens.project(axes)
    return np.linalg.norm(seen[:, None] - true[None], axis=2).min(axis=1)


@pytest.mark.slow
@pytest.mark.usefixtures("one_processor")
def test_outlines_found_in_the_jpeg_are_measured_in_the_raw_file(tmp_path: Path) -> None:
    scene = Scene.generate(7)
    lens = scene.camera_intrinsics(WIDTH)
    camera = CameraModel.from_record(lens.to_json())
    renderer = Renderer(WIDTH)
    views: list[dict[str, Any]] = []
    developed: dict[str, str] = {}
    with Store.open(tmp_path / "data") as store:

        def run(kind: str, **arguments: Any) -> Any:
            context: RecordedContext = JobContext(arguments, store, tmp_path, lambda _what, _done, _total: None)
            return handler_of(job_kinds()[kind])(context)

        for number, azimuth in enumerate((0.4, 2.8)):
            T_world_camera = pose_above(azimuth, 0.4)
            view = {
                "T_world_camera": T_world_camera.tolist(),
                "intrinsics": lens.to_json(),
                "scene": {"seed": scene.seed, "spray": False, "control_spheres": False, "board": None},
                "light_lux": NOMINAL_LUX,
            }
            mosaic = read_out(renderer.light(view, REFERENCE), 100, number)
            shot = Shot(SETTINGS, number, datetime(2026, 11, 24, tzinfo=UTC), PLATE)
            jpeg = stored(store, encode_jpeg(camera_picture(mosaic), shot), f"{number}.JPG")
            raw = stored(store, encode_raw(mosaic, shot), f"{number}.ARW")
            name = f"view_{number}"
            views.append({"viewpoint": name, "sha256": jpeg, "T_scene_camera": T_world_camera.tolist()})
            done = run("develop", viewpoint=name, raw=raw, jpeg=jpeg, parameters=asdict(PARAMETERS))
            assert done.answer.raw == raw
            assert done.answer.crop.found == "file"
            assert done.answer.parameters.gamma == (1.0, 1.0)
            (tiff,) = done.artefacts
            assert (tiff.kind, tiff.media_type, tiff.original_name) == ("developed", "image/tiff", f"{name}.tif")
            developed[name] = tiff.sha256
            if number == 0:
                again = run("develop", viewpoint=name, raw=raw, jpeg=jpeg, parameters=asdict(done.answer.parameters))
                assert again.artefacts[0].sha256 == tiff.sha256, "a replay gives the same file"
        search = {
            "images": views, "camera": asdict(camera), "spheres_m": scene.registration_m.tolist(),
            "sphere_covariance_m2": [(1e-10 * np.eye(3)).tolist()] * 10, "radius_m": scene.radius_m,
        }  # fmt: skip
        found: dict[str, dict[str, list[dict[str, Any]]]] = {}
        for where, more in (("jpeg", {}), ("raw", {"developed": developed})):
            done = run("detect_spheres", **search, **more)
            assert ("outlines_not_in_raw" in done.measures) == (where == "raw")
            found[where] = JobContext({}, store, tmp_path, lambda *_: None).input_json(done.artefacts[0].sha256)
            assert done.measures["outlines"] == sum(map(len, found[where].values())) >= 16
        smaller = {"images": views[:1], "camera": asdict(camera.scaled(600, 400)), "reduced_to": [600, 400]}
        with pytest.raises(DataError, match=r"900×600 pixels.*JPEG's size"):
            run("detect_spheres", **search | smaller, developed=developed)
    errors = {
        where: np.concatenate([
            centre_errors_px(outlines[view["viewpoint"]], inverse(np.array(view["T_scene_camera"])), scene, camera)
            for view in views
        ])
        for where, outlines in found.items()
    }  # fmt: skip
    rms_px = {where: float(np.sqrt(np.mean(found**2))) for where, found in errors.items()}
    assert rms_px["raw"] < 0.9 * rms_px["jpeg"]
    assert rms_px["jpeg"] < 0.2
