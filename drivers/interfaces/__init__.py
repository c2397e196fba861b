"""The device interfaces (robot arm, camera, scanner, CT, light box) and the records that they exchange."""

from __future__ import annotations

from drivers.interfaces.answers import (
    Answering,
    DeviceAnswers,
    Exchange,
    FileHeader,
    Listing,
    PtpProperty,
    Sample,
    answers_of,
)
from drivers.interfaces.camera import Camera, CameraSettings, CapturedFile, CapturedImage
from drivers.interfaces.device import Array, Device, DeviceIdentity, DeviceReport, Transform
from drivers.interfaces.lightbox import EnvironmentReading, Lightbox, PedalReading, TowerLight
from drivers.interfaces.robot import (
    Abandoned,
    Payload,
    RobotArm,
    RobotSample,
    RobotState,
    SafetyState,
    SettleCriteria,
    SettleReport,
)
from drivers.interfaces.surfaces import (
    CleanFile,
    CtLabels,
    CtSeries,
    CtSource,
    CtVolume,
    Mesh,
    ScanExport,
    ScannedMesh,
    Scanner,
)

__all__ = [
    "Abandoned",
    "Answering",
    "Array",
    "Camera",
    "CameraSettings",
    "CapturedFile",
    "CapturedImage",
    "CleanFile",
    "CtLabels",
    "CtSeries",
    "CtSource",
    "CtVolume",
    "Device",
    "DeviceAnswers",
    "DeviceIdentity",
    "DeviceReport",
    "EnvironmentReading",
    "Exchange",
    "FileHeader",
    "Lightbox",
    "Listing",
    "Mesh",
    "Payload",
    "PedalReading",
    "PtpProperty",
    "RobotArm",
    "RobotSample",
    "RobotState",
    "SafetyState",
    "Sample",
    "ScanExport",
    "ScannedMesh",
    "Scanner",
    "SettleCriteria",
    "SettleReport",
    "TowerLight",
    "Transform",
    "answers_of",
]
