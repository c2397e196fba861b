"""What GRBL, KUKA's application and the light box say for a recording, and a driver that says nothing more."""

from __future__ import annotations

import json
from pathlib import Path

from drivers.host.hosted_device import hosted
from drivers.interfaces import DeviceAnswers, Lightbox, RobotArm, answers_of
from drivers.kuka import KukaConfig
from drivers.lightbox import LightboxConfig, SerialLightbox
from tests.support.arms.grbl_simulator import LIFT, TURN, Tap, opened, table
from tests.support.arms.kuka_simulator import simulated_kuka
from tests.support.arms.ur_simulator import address
from tests.support.rig.host_fake_driver import Fake, FakeConfig
from tests.support.rig.patience import PATIENT_KUKA
from tests.support.rig.simulator_process import simulator


def test_grbl_tells_its_settings_and_build(tmp_path: Path) -> None:
    with table(tmp_path) as port, Tap(port, tmp_path) as tap, opened(tap.port, TURN, LIFT) as axes:
        said = answers_of(axes).exchanges
        assert not any(word in tap.sent for word in (b"$J", b"$H", b"$X"))
    answers = {one.answer for one in said}
    assert {one.question for one in said} == {"$$", "$I", "?"}
    assert "$22=1" in answers
    assert any(answer.startswith("[VER:1.1h") for answer in answers)


def test_the_application_of_a_kuka_tells_its_greeting_and_state() -> None:
    with simulated_kuka(address(64)) as ready:
        config = KukaConfig.model_validate({"host": ready["host"], **PATIENT_KUKA})
        arm = hosted(RobotArm, "drivers.kuka:DRIVER", config, call_timeout_s=60, name="robot")
        try:
            arm.open()
            said = answers_of(arm)
        finally:
            arm.close()
    greeting, state = said.exchanges
    assert json.loads(greeting.answer)["model"] == "LBR Med 14"
    assert state.answer.startswith("mode ")
    assert len(said.samples[0].fields["joints_rad"]) == 7


def test_a_light_box_tells_each_of_its_quantities(tmp_path: Path) -> None:
    with simulator("lightbox", "--link", str(tmp_path / "box"), "--firmware", "1.2"):
        box: Lightbox = SerialLightbox(LightboxConfig(port=str(tmp_path / "box"), timeout_s=10.0))
        box.open()
        said = {one.question: one.answer for one in answers_of(box).exchanges}
        box.close()
    assert said["*IDN?"].endswith(",LB-0001,1.2")
    assert (said["LIGHT?"], said["TEMP?"], said["SHUTTER?"]) == ("45000.0", "21.50", "0")


def test_a_driver_that_records_nothing_has_no_answers() -> None:
    """In this process, and in one of its own."""
    assert answers_of(object()) == DeviceAnswers()
    spec = "tests.support.rig.host_fake_driver:DRIVER"
    fake = hosted(Fake, spec, FakeConfig(), call_timeout_s=20.0, name="fake one")
    try:
        fake.open()
        assert answers_of(fake) == DeviceAnswers()
    finally:
        fake.close()
