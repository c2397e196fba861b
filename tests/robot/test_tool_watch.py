"""What a sample's pose and joints say of the tool: which change holds the arm, and which is the arm's own error."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.arm.latch import Latch
from drivers.errors import ToolChangedError
from drivers.interfaces import Array, Payload, Transform
from drivers.ur.tool import JUMP_M, JUMP_RAD, ToolWatch, jumped
from service.core.arms import FITS_M, FITS_RAD, ArmModel, arm_model, fits, flange_pose, pose_gap
from service.core.geometry import transform
from tests.support.arms.ur_driver import PAYLOAD, T_FLANGE_TCP

UR10E = arm_model("UR10e")
#: An arm whose factory calibration is as far from the nominal lengths and twists as any that was published.
CALIBRATED = replace(
    UR10E,
    a_m=UR10E.a_m + 0.0005,
    d_m=UR10E.d_m + np.array([0.0005, 0.0, 0.0, 0.0005, 0.0, -0.001]),
    alpha_rad=UR10E.alpha_rad + np.radians([0.05, 0.02, 0.1, 0.3, 0.05, 0.0]),
)
MOVED = transform(np.eye(3), np.array([0.0, 0.0, 0.1]))
HOME_RAD = np.array([0.3, -1.5, 1.5, -1.6, -1.5, 0.2])


@dataclass
class Seen:
    """A watch on the tool of an arm, and what its controller does."""

    is_really: ArmModel = UR10E
    known: ArmModel | None = UR10E
    tool: Transform = field(default_factory=lambda: T_FLANGE_TCP)
    payload: Payload = PAYLOAD
    joints_rad: Array = field(default_factory=HOME_RAD.copy)

    def __post_init__(self) -> None:
        self.latch = Latch("arm")
        self.watch = ToolWatch(self.latch)
        self.watch.start(self.known)
        self.watch.state(self.tool)
        self.sample()

    def sample(self, turn_rad: float = 0.0) -> Transform:
        """The flange of the next sample, in which each joint has turned by so much; must be where it is."""
        self.joints_rad = self.joints_rad + turn_rad
        T_base_flange = flange_pose(self.is_really, self.joints_rad)
        seen = self.watch.flange(self.joints_rad, T_base_flange @ self.tool, self.payload)
        assert pose_gap(seen, T_base_flange)[0] < JUMP_M + 0.003
        return seen


@pytest.mark.parametrize("known", [UR10E, None])
@pytest.mark.parametrize(
    "change",
    [
        MOVED,
        transform(np.eye(3), np.array([0.0006, 0.0, 0.0])),
        transform(Rotation.from_euler("x", 0.0012), np.zeros(3)),
    ],
)
def test_a_tool_changed_at_rest_holds_the_arm_and_leaves_the_flange_where_it_is(
    known: ArmModel | None, change: Transform
) -> None:
    arm = Seen(known=known)
    assert arm.latch.changed is None
    arm.tool = T_FLANGE_TCP @ change
    arm.sample()
    for error in (arm.latch.changed, arm.latch.stop, arm.latch.hold):
        assert isinstance(error, ToolChangedError)
        assert "the tool centre point was changed by" in str(error)
    np.testing.assert_allclose(arm.watch.T_flange_tcp, arm.tool, atol=1e-9)
    arm.latch.let_move("Ada", 1e9)
    arm.sample()
    assert arm.latch.hold is None, "the new tool is the tool"


def test_a_tool_changed_in_motion_is_told_from_the_motion() -> None:
    arm = Seen(is_really=CALIBRATED)
    for _ in range(200):
        arm.sample(0.008)  # a radian a second, in all joints
        assert arm.latch.changed is None
    arm.tool = T_FLANGE_TCP @ MOVED
    arm.sample(0.008)
    assert "changed by 100." in str(arm.latch.changed)
    assert pose_gap(arm.watch.T_flange_tcp, arm.tool)[0] < 0.001


def test_an_unknown_arm_is_watched_where_it_stands() -> None:
    arm = Seen(known=None)
    arm.sample(0.008)
    assert arm.latch.changed is None
    arm.sample()
    arm.tool = T_FLANGE_TCP @ MOVED
    arm.sample()
    assert arm.latch.changed is not None


@pytest.mark.parametrize("payload", [Payload(1.7, PAYLOAD.centre_of_gravity_m), Payload(1.6, (0.0, 0.01, 0.08))])
def test_a_changed_payload_holds_the_arm(payload: Payload) -> None:
    arm = Seen()
    arm.payload = payload
    arm.sample()
    assert "the payload was changed from 1.6 kg" in str(arm.latch.changed)


def test_what_the_driver_changes_itself_is_not_told() -> None:
    arm = Seen()
    light = Payload(3.0, (0.0, 0.0, 0.0))
    with arm.watch.changing(light):
        arm.tool, arm.payload = np.eye(4), light
        arm.watch.flange(arm.joints_rad, flange_pose(UR10E, arm.joints_rad), arm.payload)
        arm.watch.state(arm.tool)
    arm.sample()
    assert arm.latch.changed is None
    with pytest.raises(ZeroDivisionError), arm.watch.changing(light):
        raise ZeroDivisionError
    arm.watch.state(T_FLANGE_TCP)
    assert arm.latch.changed is None, "how much of a refused change came about is not known"


@pytest.mark.parametrize(
    ("tool", "payload", "what"),
    [
        (T_FLANGE_TCP, Payload(4.0, (0.0, 0.0, 0.08)), "the payload was changed from 3 kg to 4 kg"),
        (MOVED, Payload(3.0, (0.0, 0.0, 0.08)), "the tool centre point was changed"),
    ],
)
def test_a_change_by_somebody_else_right_after_the_drivers_own_is_told(
    tool: Transform, payload: Payload, what: str
) -> None:
    """No sample came between the two."""
    arm = Seen()
    with arm.watch.changing(Payload(3.0, (0.0, 0.0, 0.08))):
        arm.payload = Payload(3.0, (0.0, 0.0, 0.08))
        arm.sample()
    arm.watch.flange(arm.joints_rad, flange_pose(UR10E, arm.joints_rad) @ tool, payload)
    assert what in str(arm.latch.changed)


def test_another_tool_stated_than_before_holds_the_arm() -> None:
    arm = Seen()
    arm.watch.state(T_FLANGE_TCP)
    assert arm.latch.changed is None
    arm.watch.state(np.eye(4))
    assert isinstance(arm.latch.changed, ToolChangedError)


def test_a_pose_that_its_joints_contradict_holds_the_arm() -> None:
    """The tool is stated as it never was, so that nothing changes from sample to sample."""
    arm = Seen()
    arm.watch.start(UR10E)
    arm.watch.state(T_FLANGE_TCP @ MOVED)
    arm.watch.flange(HOME_RAD, flange_pose(UR10E, HOME_RAD) @ T_FLANGE_TCP, PAYLOAD)
    assert "the flange is reported 100.0 mm and 0.0° from where its joints put it" in str(arm.latch.changed)


def test_a_person_who_confirmed_before_the_change_has_not_confirmed_it() -> None:
    arm = Seen()
    arm.latch.let_move("Ada", 0.0)
    arm.tool = np.eye(4)
    arm.sample()
    with pytest.raises(ToolChangedError):
        arm.latch.let_move("Ada", 0.0)
    arm.latch.close()
    assert arm.latch.changed is None, "an arm that is opened anew has its tool read anew"
    assert arm.latch.hold is not None


def test_the_limits_are_as_stated() -> None:
    assert not jumped((JUMP_M, JUMP_RAD), 0.0, known=True)
    assert jumped((JUMP_M + 1e-6, 0.0), 0.0, known=True)
    assert jumped((0.0, JUMP_RAD + 1e-6), 0.0, known=False)
    assert not jumped((JUMP_M + 0.0019, JUMP_RAD + 0.0029), 0.1, known=True)
    assert jumped((JUMP_M + 0.0021, 0.0), 0.1, known=True)
    assert not jumped((0.2, 0.1), 0.1, known=False)


def test_every_published_calibration_fits() -> None:
    worst = max(
        pose_gap(flange_pose(UR10E, q), flange_pose(CALIBRATED, q))
        for q in np.random.default_rng(1).uniform(-2, 2, (50, 6))
    )
    assert 0.003 < worst[0] < FITS_M
    away = flange_pose(UR10E, HOME_RAD)
    assert fits(pose_gap(away, away))
    for change, agrees in (
        (transform(np.eye(3), np.array([0.0, 0.99 * FITS_M, 0.0])), True),
        (transform(np.eye(3), np.array([0.0, 1.01 * FITS_M, 0.0])), False),
        (transform(Rotation.from_euler("y", 0.99 * FITS_RAD), np.zeros(3)), True),
        (transform(Rotation.from_euler("y", 1.01 * FITS_RAD), np.zeros(3)), False),
    ):
        assert fits(pose_gap(away, away @ change)) is agrees
