"""What an ILCE-7RM5 states in protocol 3.00, as far as libgphoto2 asks for it.

No listing of this body in this protocol is public: forms, lists and access are those that an ILCE-1M2 and an ILCE-7M5
state in it (recordings/), with the shutter times of the Alpha 7R V.
"""

from __future__ import annotations

from simulators.sony_camera.properties import (
    CARD,
    DIRECT_MANUAL_FOCUS,
    FILE_JPEG,
    FILE_RAW,
    FILE_RAW_JPEG,
    I8,
    I16,
    MANUAL_FOCUS,
    NO_CARD,
    TARGET_BOTH,
    TARGET_CARD,
    TARGET_COMPUTER,
    TEXT,
    U8,
    U16,
    U32,
    BodyTable,
    CameraProperty,
    Code,
    Enabled,
    shutter_code,
)

F_NUMBERS = (280, 320, 350, 400, 450, 500, 560, 630, 710, 800, 900, 1000, 1100, 1300, 1400, 1600, 1800, 2000, 2200)
_TENTHS = (300, 250, 200, 150, 130, 100, 80, 60, 50, 40, 32, 25, 20, 16, 13, 10, 8, 6, 5, 4)
_FRACTIONS = (3, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30, 40, 50, 60, 80, 100, 125, 160, 200, 250, 320, 400, 500, 640, 800)
_FAST = (1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400, 8000)
SHUTTERS = tuple(shutter_code(tenths, 10) for tenths in _TENTHS) + tuple(
    shutter_code(1, denominator) for denominator in _FRACTIONS + _FAST
)
_BULB, _AUTO_ISO, _EXTENDED = 0, 0xFFFFFF, 0x10000000
ISO = (
    *(100, 125, 160, 200, 250, 320, 400, 500, 640, 800, 1000, 1250, 1600, 2000, 2500, 3200, 4000, 5000, 6400),
    *(8000, 10000, 12800, 16000, 20000, 25600, 32000),
)
_ALL_ISO = (_AUTO_ISO, *(_EXTENDED | iso for iso in (50, 64, 80)), *ISO, *(_EXTENDED | iso for iso in (40000, 51200)))
_WHITE_BALANCE = (
    *(2, 4, 0x8011, 0x8010, 6, 0x8001, 0x8002, 0x8003, 0x8004, 7, 0x8030, 0x8012, 0x8020, 0x8021, 0x8022),
)
# Thousandths of a stop, from +5 to -5 by thirds; with the dial on M they change no picture.
_ABOVE_ZERO = (5000, 4700, 4300, 4000, 3700, 3300, 3000, 2700, 2300, 2000, 1700, 1300, 1000, 700, 300)
_COMPENSATIONS = (*_ABOVE_ZERO, 0, *(-number for number in reversed(_ABOVE_ZERO)))
_PROGRAMS = (0x48000, 0x10002, 0x20003, 0x30004, 1, 0x78054, 0x78050, 0x98055, 0x98051, 0xC8087, 0xC8083)
# Single, continuous from Hi+ to Lo, self-timers, brackets; the 16-bit codes of protocol 2.00 below a group.
_DRIVES = (
    *(1, 0x18010, 0x10002, 0x18015, 0x18012, 0x38004, 0x38003, 0x38005, 0x88008, 0x88009, 0x8800C, 0x8800D, 0x8800E),
    *(0x48337, 0x48537, 0x48737, 0x48937, 0x58336, 0x58536),
)
_SHOWN = Enabled.DISPLAY_ONLY


def alpha_7r_v() -> BodyTable:
    """The table after power-on: dial on M, autofocus, JPEG Fine, files to the computer, a card in the first slot."""
    return BodyTable(
        "ILCE-7RM5",
        "3.00",
        300,
        (
            CameraProperty(Code.WHITE_BALANCE, U16, 4, _WHITE_BALANCE),
            CameraProperty(Code.F_NUMBER, U16, 800, F_NUMBERS),
            CameraProperty(Code.FOCUS_MODE, U16, 2, (2, 0x8005, 0x8004, DIRECT_MANUAL_FOCUS, MANUAL_FOCUS)),
            CameraProperty(Code.EXPOSURE_PROGRAM, U32, 1, _PROGRAMS, enabled=_SHOWN),
            CameraProperty(Code.EXPOSURE_COMPENSATION, I16, 0, _COMPENSATIONS),
            CameraProperty(Code.DRIVE_MODE, U32, 1, _DRIVES),
            CameraProperty(Code.SHUTTER_SPEED, U32, shutter_code(1, 60), (_BULB, *SHUTTERS)),
            CameraProperty(Code.ASPECT_RATIO, U8, 1, (1, 3, 2, 4)),
            CameraProperty(Code.FOCUS_STATUS, U8, 1, (1, 2, 3, 2, 5, 6, 7), enabled=_SHOWN),
            CameraProperty(Code.SENSOR_CROP, U8, 1, (2, 1)),
            CameraProperty(Code.BATTERY, I8, 87, limits=(-1, 100, 1), enabled=_SHOWN),
            CameraProperty(Code.ISO, U32, 400, _ALL_ISO),
            CameraProperty(Code.CAPTURE_TARGET, U16, TARGET_COMPUTER, (TARGET_COMPUTER, TARGET_BOTH, TARGET_CARD)),
            CameraProperty(Code.FOCUS_CAN_BE_DRIVEN, U8, 1, (), enabled=_SHOWN),
            CameraProperty(Code.PRIORITY_MODE, U8, 0, (0, 1)),
            CameraProperty(Code.COMPUTER_IMAGE_SIZE, U8, 1, (1, 2)),
            CameraProperty(Code.COMPUTER_FILES, U8, 1, (1, 2, 3)),
            CameraProperty(Code.SLOT_1_STATE, U8, CARD, (), enabled=_SHOWN),
            CameraProperty(Code.SLOT_1_SHOTS, U32, 0, limits=(0, 0xFFFFFFFF, 1), enabled=_SHOWN),
            CameraProperty(Code.SLOT_2_STATE, U8, NO_CARD, (), enabled=_SHOWN),
            CameraProperty(Code.SLOT_2_SHOTS, U32, 0, limits=(0, 0xFFFFFFFF, 1), enabled=_SHOWN),
            CameraProperty(Code.FOCAL_POSITION, U8, 50, limits=(0, 100, 1), enabled=_SHOWN),
            CameraProperty(Code.JPEG_QUALITY, U8, 2, (1, 2, 3, 4)),
            CameraProperty(Code.FILE_FORMAT, U8, FILE_JPEG, (FILE_RAW, FILE_RAW_JPEG, FILE_JPEG)),
            CameraProperty(Code.IMAGE_SIZE, U8, 1, (1, 2, 3)),
            CameraProperty(Code.STABILIZATION, U8, 1, (2, 1)),
            CameraProperty(Code.SILENT_MODE, U8, 1, (2, 1)),
            CameraProperty(Code.SHUTTER_TYPE, U8, 2, (1, 2, 3)),
            CameraProperty(Code.NAME_PREFIX, TEXT, "DSC"),
            CameraProperty(Code.LENS_NAME, TEXT, "FE 24-70mm F2.8 GM", enabled=_SHOWN),
            CameraProperty(Code.OBJECTS_IN_MEMORY, U16, 0, limits=(0, 65535, 1), enabled=_SHOWN),
        ),
    )
