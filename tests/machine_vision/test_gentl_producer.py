"""harvesters with GenTL producers: one that we did not write (Viky, which comes with its binding), and none."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from drivers.errors import DeviceUnavailableError, DriverMissingError
from drivers.genicam import DRIVER, GenicamConfig
from drivers.genicam.link import LinkError
from drivers.genicam.pixels import picture
from drivers.genicam.producer import ProducerCamera


@pytest.fixture(scope="module")
def viky() -> Path:
    """A game that is a GenTL producer: three cameras without exposure time, and without some of the usual answers."""
    spec = importlib.util.find_spec("genicam")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "viky.cti"


def test_a_producer_that_others_wrote(viky: Path) -> None:
    camera = ProducerCamera("VikyTL_DEV_green", viky)
    try:
        assert camera.software.endswith("viky.cti")
        camera.set_pixel_format("Mono8")
        assert camera.pixel_format == "Mono8"
        frames = [camera.acquire(10.0) for _ in range(2)]
        for frame in frames:
            shown = picture(frame, "Mono8")
            assert shown is not None
            assert shown.shape == (400, 400)
            assert shown.std() > 1.0
        with pytest.raises(LinkError, match="the camera has no ExposureTime"):
            camera.set_exposure_s(0.01)
    finally:
        camera.close()
    with pytest.raises(LinkError, match="not connected"):
        camera.acquire(1.0)


def test_which_cameras_there_are(viky: Path) -> None:
    with pytest.raises(LinkError, match=r"lists 0 cameras with this name; there are: VikyTL_DEV_red \(0\), "):
        ProducerCamera("VikyTL_DEV_black", viky)


@pytest.mark.parametrize(
    ("file", "words"), [("absent.cti", "there is no GenTL producer"), ("words.cti", "be loaded")]
)
def test_what_is_no_producer(file: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "words.cti").write_text("no library")
    config = GenicamConfig(camera="1", producer=str(tmp_path / file), aperture_f=8.0)
    with pytest.raises(DeviceUnavailableError, match=words):
        DRIVER.build(config).open()


def test_without_harvesters_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch, viky: Path) -> None:
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    camera = DRIVER.build(GenicamConfig(camera="1", producer=str(viky), aperture_f=8.0))
    with pytest.raises(DriverMissingError, match=r"harvesters is not installed.*orthocapture\[genicam\]"):
        camera.open()
