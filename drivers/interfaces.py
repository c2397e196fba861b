"""The device interfaces (robot arm, camera, scanner, CT, light box) and the records that they return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Transform = Array  # (4, 4), T_a_b: p_a = T_a_b @ p_b, metres

# --- every device -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """The device that answered when it was opened; recorded in the evidence of a run."""

    kind: str  # robot, camera, scanner, ct, lightbox
    model: str
    serial: str
    firmware: str
    driver: str
    driver_version: str  # our driver and the vendor library behind it
    address: str


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """The health of an open device, for `orthocapture doctor` and the run's start-up log."""

    identity: DeviceIdentity
    clock_offset_s: float | None = None  # device clock minus host UTC, or minus host monotonic for an uptime clock
    clock: Literal["utc", "uptime"] = "utc"  # uptime: counts from power-on, so only changes of the offset matter
    free_bytes: int | None = None
    battery_fraction: float | None = None
    details: Mapping[str, str] = field(default_factory=dict[str, str])
    problems: tuple[str, ...] = ()  # each says what is wrong and what to do


@runtime_checkable
class Device(Protocol):
    """What every driver provides. Methods raise only drivers.errors.DeviceError."""

    def open(self) -> DeviceIdentity:
        """Connect, check the version and return the device's identity. Calling it again reconnects."""
        ...

    def close(self) -> None:
        """Disconnect from the device; does not raise if the link is already dead."""
        ...

    def report(self) -> DeviceReport:
        """Return versions, clock offset, free space and current problems."""
        ...


# --- robot arm ---------------------------------------------------------------------------------------


class SafetyState(Enum):
    """State of the controller's safety system; only a person can clear a stop."""

    NORMAL = "normal"
    REDUCED = "reduced"
    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    EMERGENCY_STOP = "emergency_stop"
    FAULT = "fault"
    UNKNOWN = "unknown"

    @property
    def may_move(self) -> bool:
        """Whether motion may be commanded in this state."""
        return self in (SafetyState.NORMAL, SafetyState.REDUCED)


@dataclass(frozen=True, slots=True)
class Payload:
    """The load on the flange: camera, lens and mount."""

    mass_kg: float
    centre_of_gravity_m: tuple[float, float, float]  # in the flange frame


@dataclass(frozen=True, slots=True)
class RobotSample:
    """One sample of the controller's stream."""

    controller_time_s: float
    monotonic_s: float  # host time.monotonic() at arrival
    joints_rad: Array  # (6,) or (7,)
    joint_velocities_rad_s: Array
    target_velocities_rad_s: Array
    T_base_flange: Transform  # as reported by the controller, with the tool offset removed
    tcp_speed_m_s: float
    safety: SafetyState


@dataclass(frozen=True, slots=True)
class RobotState:
    """The newest sample with the controller's modes."""

    sample: RobotSample
    robot_mode: str
    program_running: bool
    speed_fraction: float


@dataclass(frozen=True, slots=True)
class SettleCriteria:
    """When an arm counts as standing still.

    The defaults suit a UR10e with a camera on its flange: for a 60-megapixel camera with a 50 mm lens at 0.6 m,
    20 µm are half a pixel and 5 millidegrees about one.
    """

    window_s: float = 0.5
    joint_speed_rad_s: float = 0.001
    tcp_speed_m_s: float = 0.0002
    position_peak_to_peak_m: float = 0.00002
    rotation_peak_to_peak_rad: float = 0.0000873


@dataclass(frozen=True, slots=True)
class SettleReport:
    """Whether the last window of the pose stream meets the settle criteria, with the measured values."""

    settled: bool
    samples: int
    joint_speed_rad_s: float
    tcp_speed_m_s: float
    position_peak_to_peak_m: float
    rotation_peak_to_peak_rad: float
    T_base_flange: Transform  # mean over the window
    joints_rad: Array
    ringing_s: float = 0.0  # from the end of the commanded motion to the last sample above a speed limit


class RobotArm(Device, Protocol):
    """A six- or seven-axis arm.

    Motion is asynchronous, so that `stop` always works, and needs a person's permission (`let_move`).
    """

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion after a person has checked the arm and confirmed; clears stops that are over.

        The permission is needed after `open`, after any safety stop in the stream, and after the controller's program
        ended unexpectedly. The caller must have the person's confirmation on record.

        Args:
            confirmed_by: name of the person.
            not_before_monotonic_s: host time.monotonic() shortly before the person confirmed.

        Raises:
            SafetyStopError, LeaveNeededError: a stop, or an unexpected end of the program, after that time.
        """
        ...

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Set the payload and the tool centre point, and verify both by reading them back."""
        ...

    def state(self) -> RobotState:
        """Return the newest state. Raises DeviceUnavailableError if the stream is stale."""
        ...

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return the buffered samples (at least the last 10 s) between two host times, oldest first.

        Reading samples does not count as supervising the arm: a moving arm that is only observed this way is stopped.
        """
        ...

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Return the controller's joint solution for a flange pose that is closest to `near_rad`, in radians.

        Raises UnreachablePoseError if there is none.
        """
        ...

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint motion and return at once.

        Raises:
            SafetyStopError: a stop is active, or nobody has confirmed since the last one.
            LeaveNeededError: nobody has permitted motion yet.
        """
        ...

    def stop(self) -> None:
        """Decelerate to a standstill. This is a software stop, not an emergency stop."""
        ...

    def is_moving(self) -> bool:
        """Return whether the last motion is still under way. Raises the error that interrupted it, if any."""
        ...

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the last window of the pose stream against the criteria. Returns at once; meant to be polled."""
        ...

    def set_digital_output(self, index: int, on: bool) -> None:
        """Switch a standard digital output of the controller."""
        ...


# --- camera --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """The camera settings that a protocol prescribes."""

    aperture_f: float
    exposure_s: float
    iso: int
    focus_mode: str = "Manual"
    image_quality: str = "JPEG"  # JPEG, RAW or RAW+JPEG


@dataclass(frozen=True, slots=True)
class CapturedFile:
    """One file of an exposure, byte for byte as the camera wrote it."""

    path: Path
    camera_name: str  # DSC00004.JPG
    sha256: str
    size_bytes: int
    media_type: str  # image/jpeg, image/x-sony-arw


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """One exposure: its files, its EXIF data and its time on the host's monotonic clock."""

    files: tuple[CapturedFile, ...]  # JPEG first
    counter: int  # of the camera's file names; advances with each exposure
    exif_time: str  # DateTimeOriginal with sub-seconds, as in the file
    exif: CameraSettings
    lens: str
    focal_length_mm: float
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    width: int = 0  # px; this and the following are 0 or "" if the file does not state them
    height: int = 0
    lens_serial: str = ""
    body_serial: str = ""
    focus_distance_m: float = 0.0
    focus_position: int | None = None  # of the focus motor, in its own steps; None if the file does not state it
    found_at: str = ""  # path at which the file was found; "" if it was downloaded from the camera

    @property
    def jpeg(self) -> CapturedFile:
        """The JPEG of the exposure."""
        return self.files[0]


class Camera(Device, Protocol):
    """A stills camera under remote control."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set each value, wait, and return what reads back; DeviceRefusedError if it differs.

        A camera without a cable only remembers the settings, which a person then dials in.
        """
        ...

    def settings(self) -> CameraSettings:
        """Return the current settings, read from the camera itself and not from a cache."""
        ...

    def capture(self, folder: Path) -> CapturedImage:
        """Take one exposure and download its undecoded files into `folder`.

        Raises:
            StaleImageError: the file that arrived is not new.
            ReleasedElsewhereError: only the camera's own button releases its shutter.
        """
        ...

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Download into `folder` the images released with the camera's own button, oldest first.

        Waits up to `timeout_s` for the first one; returns an empty tuple if the button was not pressed. The trigger
        time is when the camera announced the image, or when its file arrived. Images found as files are ignored if
        they were taken before `since_utc_s` (seconds since 1970); images announced by the camera are always new.
        """
        ...

    def preview(self) -> bytes:
        """Return one live-view frame as JPEG bytes."""
        ...


# --- scanner, CT -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in metres."""

    vertices_m: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    normals: Array  # (V, 3), computed if the file had none


@dataclass(frozen=True, slots=True)
class ScanExport:
    """A complete export found in the scanner's folder: the mesh file first, then its companions."""

    name: str
    files: tuple[Path, ...]
    modified_utc: str


@dataclass(frozen=True, slots=True)
class ScannedMesh:
    """A mesh read from a scan export, with its unit and its findings."""

    mesh: Mesh
    unit: str  # of the file: mm, m, …
    unit_evidence: str  # how that unit was determined
    findings: Mapping[str, float]  # holes, non_manifold_edges, components, degenerate_faces, normals_computed
    source: ScanExport


class Scanner(Device, Protocol):
    """A hand scanner, accessed through the folder into which its software exports."""

    def exports(self) -> tuple[ScanExport, ...]:
        """Return the complete, stable exports, oldest first, without those that are still being written."""
        ...

    def read(self, export: ScanExport) -> ScannedMesh:
        """Read one export. Raises UnreadableFileError or IncompleteExportError with the reason."""
        ...


@dataclass(frozen=True, slots=True)
class CtSeries:
    """One series of a DICOM folder."""

    uid: str
    description: str
    modality: str
    slices: int
    files: tuple[Path, ...]
    problems: tuple[str, ...]  # localiser, gap, mixed orientation, …; a series with problems is not read


@dataclass(frozen=True, slots=True)
class CtVolume:
    """A volume in Hounsfield units; p_ct = T_ct_voxel @ (i, j, k) with i along columns, k along slices, metres."""

    hounsfield: NDArray[np.int16]  # (K, J, I)
    T_ct_voxel: Transform  # (4, 4), affine: spacing and direction included
    spacing_m: tuple[float, float, float]  # i, j, k
    series: CtSeries


class CtSource(Device, Protocol):
    """A CT suite, accessed through the DICOM folder that it delivers."""

    def series(self) -> tuple[CtSeries, ...]:
        """Return all series found, including those with problems."""
        ...

    def read(self, series: CtSeries) -> CtVolume:
        """Read one series. Raises UnreadableFileError, which names the gap, the slice and the file."""
        ...

    def segmented_meshes(self) -> tuple[ScanExport, ...]:
        """Return the meshes in the folder that were segmented elsewhere (e.g. Mimics STL), oldest first."""
        ...

    def read_mesh(self, export: ScanExport) -> ScannedMesh:
        """Read one segmented mesh. Raises UnreadableFileError or IncompleteExportError with the reason."""
        ...


# --- light and environment box -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EnvironmentReading:
    """Light and temperature at one moment."""

    light_lux: float
    temperature_c: float
    shutter_relay_closed: bool
    monotonic_s: float


class TowerLight(Enum):
    """One light of a signal tower that can be seen across the room."""

    OFF = "OFF"
    WORKING = "GREEN"
    WAITING = "YELLOW"  # for a person
    STOPPED = "RED"


class Lightbox(Device, Protocol):
    """The light and environment box: light level, temperature, shutter relay, foot pedal and signal tower."""

    def read(self) -> EnvironmentReading:
        """Return the current light level, temperature and relay state."""
        ...

    def pedal_presses(self) -> int:
        """Return the number of pedal presses since the box started; an increase means a new press."""
        ...

    def show_tower(self, light: TowerLight) -> bool:
        """Switch the signal tower. Returns False if the box has none, which is not an error."""
        ...
