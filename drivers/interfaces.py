"""What the service may ask of a device, and the records that come back. Interfaces and records, nothing else."""

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
    """Who answered when the device was opened; goes into the evidence of a run."""

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
    clock: Literal["utc", "uptime"] = "utc"  # uptime: it counts from power-on, and only its change means anything
    free_bytes: int | None = None
    battery_fraction: float | None = None
    details: Mapping[str, str] = field(default_factory=dict[str, str])
    problems: tuple[str, ...] = ()  # each: what is wrong and what to do


@runtime_checkable
class Device(Protocol):
    """What every driver offers. Methods raise drivers.errors.DeviceError and nothing else."""

    def open(self) -> DeviceIdentity:
        """Connect, check the version, read back who answers. Opening again reconnects."""
        ...

    def close(self) -> None:
        """Let go of the device; never raises for a link that is already dead."""
        ...

    def report(self) -> DeviceReport:
        """Versions, clock offset, free space and what is wrong."""
        ...


# --- robot arm ---------------------------------------------------------------------------------------


class SafetyState(Enum):
    """What the controller says of its safety system; only a person clears a stop."""

    NORMAL = "normal"
    REDUCED = "reduced"
    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    EMERGENCY_STOP = "emergency_stop"
    FAULT = "fault"
    UNKNOWN = "unknown"

    @property
    def may_move(self) -> bool:
        """Whether motion may be asked for."""
        return self in (SafetyState.NORMAL, SafetyState.REDUCED)


@dataclass(frozen=True, slots=True)
class Payload:
    """What hangs on the flange: camera, lens, mount."""

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
    T_base_flange: Transform  # as the controller says, tool offset removed
    tcp_speed_m_s: float
    safety: SafetyState


@dataclass(frozen=True, slots=True)
class RobotState:
    """The newest sample and the controller's modes."""

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
    """Whether the pose stream of the last window meets the criteria, and the figures."""

    settled: bool
    samples: int
    joint_speed_rad_s: float
    tcp_speed_m_s: float
    position_peak_to_peak_m: float
    rotation_peak_to_peak_rad: float
    T_base_flange: Transform  # mean over the window
    joints_rad: Array
    ringing_s: float = 0.0  # from the end of the commanded motion to the last sample beyond the speed limits


class RobotArm(Device, Protocol):
    """A six- or seven-axis arm. Motion is asynchronous so that `stop` always works, and needs a person's leave."""

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Let the arm move, because this person has looked and confirmed; stops that are over are forgotten.

        Without it nothing moves: since `open`, since a stop seen anywhere in the stream, since the controller's
        program ended unasked. Whoever calls this has the confirmation on record; no program gives it to itself.

        Args:
            confirmed_by: name of the person.
            not_before_monotonic_s: host time.monotonic() at which the confirmation was not given yet.

        Raises SafetyStopError or LeaveNeededError for what happened, or still went on, after that time.
        """
        ...

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Set payload and tool centre point and read them back."""
        ...

    def state(self) -> RobotState:
        """The newest state. Raises DeviceUnavailableError when the stream has gone stale."""
        ...

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Samples of the ring buffer (at least the last 10 s) between two host times, oldest first.

        Reading them is not looking after the arm: an arm that moves and is only watched in this way is stopped.
        """
        ...

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Joints for a flange pose, nearest to `near_rad`, asked of the controller; UnreachablePoseError if none."""
        ...

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint motion and return at once.

        Raises SafetyStopError when a stop is active or nobody has confirmed since one, LeaveNeededError when nobody
        has let the arm move.
        """
        ...

    def move_linear(self, T_base_flange: Transform, *, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Start a straight motion of the flange and return at once."""
        ...

    def stop(self) -> None:
        """Decelerate to a stand-still; a software stop, never an emergency stop."""
        ...

    def is_moving(self) -> bool:
        """Whether the last motion is still under way. Raises what has cut it short, for then it did not arrive."""
        ...

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the pose stream of the last window; returns at once, poll it."""
        ...

    def set_digital_output(self, index: int, on: bool) -> None:
        """Switch a standard digital output of the controller."""
        ...


# --- camera --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """The settings that a protocol fixes."""

    aperture_f: float
    exposure_s: float
    iso: int
    focus_mode: str = "Manual"
    image_quality: str = "JPEG"  # JPEG, RAW or RAW+JPEG


@dataclass(frozen=True, slots=True)
class CapturedFile:
    """One undecoded file of an exposure, as it left the camera."""

    path: Path
    camera_name: str  # DSC00004.JPG
    sha256: str
    size_bytes: int
    media_type: str  # image/jpeg, image/x-sony-arw


@dataclass(frozen=True, slots=True)
class CapturedImage:
    """One exposure: its files and when it happened on the host's monotonic clock."""

    files: tuple[CapturedFile, ...]  # JPEG first
    counter: int  # of the camera's file names; advances with each exposure
    exif_time: str  # DateTimeOriginal with sub-seconds, as in the file
    exif: CameraSettings
    lens: str
    focal_length_mm: float
    trigger_monotonic_s: float
    arrival_monotonic_s: float
    width: int = 0  # px; of these, 0 or "" where the file does not tell
    height: int = 0
    lens_serial: str = ""
    body_serial: str = ""
    focus_distance_m: float = 0.0
    focus_position: int | None = None  # of the focus motor, in its own steps; None where the file does not tell
    found_at: str = ""  # path of the file that it came as; "" where it came from the camera itself

    @property
    def jpeg(self) -> CapturedFile:
        """The JPEG of the exposure."""
        return self.files[0]


class Camera(Device, Protocol):
    """A stills camera under remote control."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set one by one, wait, read back; DeviceRefusedError when the read-back differs.

        Without a cable it only takes note of what a person has to dial.
        """
        ...

    def settings(self) -> CameraSettings:
        """Read the current settings from the camera, not from a cache."""
        ...

    def capture(self, folder: Path) -> CapturedImage:
        """Take one exposure and download its undecoded files into `folder`; StaleImageError if not new.

        Raises ReleasedElsewhereError where the camera's own button is the only one.
        """
        ...

    def released_images(self, folder: Path, timeout_s: float, since_utc_s: float = 0.0) -> tuple[CapturedImage, ...]:
        """Images that the camera's own button has released, oldest first, downloaded into `folder`.

        Waits up to `timeout_s` for the first one; empty when the button was not pressed. The trigger's time is that
        of the camera's announcement, or of the file's arrival. Where images are found as files, those taken earlier
        than `since_utc_s` (seconds since 1970) are left alone; what a camera announces is new in any case.
        """
        ...

    def preview(self) -> bytes:
        """One live-view frame, JPEG."""
        ...


# --- scanner, CT -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in metres."""

    vertices_m: Array  # (V, 3)
    faces: NDArray[np.int32]  # (F, 3)
    normals: Array  # (V, 3), computed when the file had none


@dataclass(frozen=True, slots=True)
class ScanExport:
    """A complete export found in the scanner's folder: the mesh file first, then its companions."""

    name: str
    files: tuple[Path, ...]
    modified_utc: str


@dataclass(frozen=True, slots=True)
class ScannedMesh:
    """A scan as read, with what was found wrong or worth knowing about it."""

    mesh: Mesh
    unit: str  # of the file: mm, m, …
    unit_evidence: str  # why that unit is believed
    findings: Mapping[str, float]  # holes, non_manifold_edges, components, degenerate_faces, normals_computed
    source: ScanExport


class Scanner(Device, Protocol):
    """A hand scanner, seen through the folder into which its software exports."""

    def exports(self) -> tuple[ScanExport, ...]:
        """Complete, stable exports, oldest first; half-written ones are not in it."""
        ...

    def pending(self) -> tuple[str, ...]:
        """What is in the folder and not complete: one sentence each, with the reason."""
        ...

    def read(self, export: ScanExport) -> ScannedMesh:
        """Parse one export; UnreadableFileError or IncompleteExportError with the reason."""
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
    """A CT suite, seen through the DICOM folder it delivers."""

    def series(self) -> tuple[CtSeries, ...]:
        """All series found, those with problems too."""
        ...

    def read(self, series: CtSeries) -> CtVolume:
        """Read one series; UnreadableFileError names gap, slice and file."""
        ...

    def segmented_meshes(self) -> tuple[ScanExport, ...]:
        """Meshes segmented elsewhere (Mimics STL) lying in the folder."""
        ...

    def read_mesh(self, export: ScanExport) -> ScannedMesh:
        """Import such a mesh."""
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
    """One light of a signal tower, which is seen across the room."""

    OFF = "OFF"
    WORKING = "GREEN"
    WAITING = "YELLOW"  # for a person
    STOPPED = "RED"


class Lightbox(Device, Protocol):
    """Light level, temperature, shutter relay, foot pedal and signal tower."""

    def read(self) -> EnvironmentReading:
        """Current light level and temperature."""
        ...

    def set_shutter_relay(self, closed: bool) -> None:
        """Close or open the shutter relay."""
        ...

    def pedal_presses(self) -> int:
        """Number of pedal presses since the box started; a rise is a new press."""
        ...

    def show_tower(self, light: TowerLight) -> bool:
        """Switch the signal tower; False where the box has none, which is no error."""
        ...
