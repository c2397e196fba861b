"""The words of libgphoto2 for a Canon EOS's settings, with the codes and numbers that they stand for.

Facts of ptp2/ptp.h and ptp2/config.c of gphoto/libgphoto2, typed in. Scales of exposure are computed: eight steps
make a stop, of which a third has 3, a half 4 and two thirds 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from drivers.interfaces.answers import PropertyType

Numbers = Mapping[str, tuple[int, ...]]  # of a word, the number of a scale of thirds before that of one of halves
HALF, STEPS_PER_STOP = 4, 8


def _no_words() -> Numbers:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting's property, and what its words stand for."""

    code: int
    type: PropertyType
    words: Numbers = field(default_factory=_no_words)  # none: the words are numbers, or the text itself
    base: int = 10


def _words(numbers: Mapping[str, int]) -> Numbers:
    return MappingProxyType({word: (number,) for word, number in numbers.items()})


def _listed(words: str, start: int = 0) -> Numbers:
    """Words that are numbered one after the other."""
    return _words({word: number for number, word in enumerate(words.split(","), start)})


def _scale(first: int, stops: str, others: Mapping[str, tuple[int, ...]]) -> Numbers:
    """Words of a scale from this number on: each line a stop, with its third, its half and its two thirds."""
    numbers: dict[str, list[int]] = {}
    for stop, line in enumerate(stops.split("|")):
        for step, word in zip((0, 3, 5, HALF), line.split(), strict=False):
            if word != "-":
                numbers.setdefault(word, []).append(first + STEPS_PER_STOP * stop + step)
    return MappingProxyType({**others, **{word: tuple(found) for word, found in numbers.items()}})


APERTURES = _scale(
    0x08,
    "1 1.1 1.2 1.2|1.4 1.6 1.8 1.8|2 2.2 2.5 2.5|2.8 3.2 3.5 3.5|4 4.5 5 4.5|5.6 6.3 7.1 6.7|8 9 10 9.5|11 13 14 13"
    "|16 18 20 19|22 25 29 27|32 36 40 38|45 51 57 54|64 72 81 76|91",
    {"implicit auto": (0,), "auto": (0xFFFF,)},
)
SHUTTER_TIMES = _scale(
    0x10,
    "30 25 20 20.3|15 13 10.3 10|8 6.3 5 6|4 3.2 2.5 3|2 1.6 1.3 1.5|1 0.8 0.6 0.7|0.5 0.4 0.3 0.3|1/4 1/5 1/6 1/6"
    "|1/8 1/10 1/13 1/10|1/15 1/20 1/25 1/20|1/30 1/40 1/50 1/45|1/60 1/80 1/100 1/90|1/125 1/160 1/200 1/180"
    "|1/250 1/320 1/400 1/350|1/500 1/640 1/800 1/750|1/1000 1/1250 1/1600 1/1500|1/2000 1/2500 1/3200 1/3000"
    "|1/4000 1/5000 1/6400 1/6000|1/8000|1/16000",
    {"auto": (0,), "bulb": (0x0C,)},
)
ISO_SPEEDS = _scale(
    0x28,
    "6|12|25|50 64 80|100 125 160|200 250 320|400 500 640|800 1000 1250|1600 2000 2500|3200 4000 5000|6400 8000 10000"
    "|12800 16000 20000|25600 32000 40000|51200 64000 80000|102400|204800|409600",
    {"Auto": (0,), "Auto ISO": (1,)},
)
_ABOVE_ZERO = _scale(0, "0 0.3 0.6 0.5|1 1.3 1.6 1.5|2 2.3 2.6 2.5|3 3.3 3.6 3.5|4 4.3 4.6 4.5|5", {})
COMPENSATIONS: Numbers = MappingProxyType(
    {
        **{f"-{word}": tuple(-number & 0xFF for number in numbers) for word, numbers in _ABOVE_ZERO.items()},
        **_ABOVE_ZERO,
        "1.0": (0x08,),
        "-1.0": (0xF8,),
    }
)
EXPOSURE_MODES: Numbers = MappingProxyType(
    {
        **_listed(
            "P,TV,AV,Manual,Bulb,A_DEP,DEP,Custom,Lock,Green,Night Portrait,Sports,Portrait,Landscape,Closeup,"
            "Flash Off,C2,C3"
        ),
        **_listed("Creative Auto,Movie", 0x13),
        **_listed("Auto,Handheld Night Scene,HDR Backlight Control,SCN", 0x16),
        **_listed("Food", 0x1B),
        **_listed(
            "Grainy B/W,Soft focus,Toy camera effect,Fish-eye effect,Water painting effect,Miniature effect,"
            "HDR art standard,HDR art vivid,HDR art bold,HDR art embossed",
            0x1E,
        ),
        **_words({"Panning": 0x2D, "Fv": 0x37}),
        **_listed("HDR,Self Portrait,Hybrid Auto,Smooth skin", 0x31),
    }
)
DRIVE_MODES: Numbers = MappingProxyType(
    {
        **_listed("Single,Continuous,Video"),
        **_listed("Continuous high speed,Continuous low speed,Single: Silent shooting,Continuous timer", 4),
        **_listed(
            "Timer 10 sec,Timer 2 sec,Super high speed continuous shooting,Single silent,Continuous silent", 16
        ),
    }
)
WHITE_BALANCES: Numbers = MappingProxyType(
    {
        **_listed("Auto,Daylight,Cloudy,Tungsten,Fluorescent,Flash,Manual,Unknown 7,Shadow,Color Temperature"),
        **_words({"Manual 2": 15, "Manual 3": 16, "Manual 4": 18, "Manual 5": 19, "AWB White": 23}),
    }
)
PICTURE_STYLES: Numbers = MappingProxyType(
    {
        **_listed("Standard,Portrait,Landscape,Neutral,Faithful,Monochrome,Auto,Fine detail", 0x81),
        **_listed("User defined 1,User defined 2,User defined 3", 0x21),
    }
)
METERING_MODES = _words({"spot": 1, "evaluative": 3, "partial": 4, "center-weighted average": 5})
OUTPUTS: Numbers = MappingProxyType(
    {
        **_listed(
            "Off,TFT,PC,TFT + PC,MOBILE,TFT + MOBILE,PC + MOBILE,TFT + PC + MOBILE,MOBILE2,TFT + MOBILE2,"
            "PC + MOBILE2,TFT + PC + MOBILE2"
        ),
        **_listed("Setting 4,Setting 5,Setting 6,Setting 7", 4),
    }
)
BRACKETS = _scale(
    0, "off +/-_1/3 +/-_2/3 +/-_1/2|+/-_1 +/-_1_1/3 +/-_1_2/3 +/-_1_1/2|+/-_2 +/-_2_1/3 +/-_2_2/3 +/-_2_1/2|+/-_3", {}
)

# One byte of an image format: four bits of size, a bit for RAW, and the compression. Without a second file it is FF.
NO_FILE, RAW_BIT, LOSSLESS = 0xFF, 0x08, 0x04
FILES: Mapping[str, int] = MappingProxyType(
    {
        "RAW": 0x0C,
        "mRAW": 0x1C,
        "sRAW": 0x2C,
        "cRAW": 0x0B,
        "sRAW1": 0x1C,
        "sRAW2": 0x2C,
        "Large Fine JPEG": 0x03,
        "Large Normal JPEG": 0x02,
        "Medium Fine JPEG": 0x13,
        "Medium Normal JPEG": 0x12,
        "Small Fine JPEG": 0xD3,
        "Small Normal JPEG": 0xD2,
        "Smaller JPEG": 0xE3,
        "Tiny JPEG": 0xF3,
        "Small Fine JPEG (S1 Fine)": 0xD3,
        "Small Normal JPEG (S1 Normal)": 0xD2,
        "Smaller JPEG (S2)": 0xE3,
        "Tiny JPEG (S3)": 0xF3,
        "L": 0x03,
        "M": 0x13,
        "S": 0x23,
        "S1": 0xD3,
        "S2": 0xE3,
        "S3": 0xF3,
    }
)

SETTINGS: Mapping[str, Setting] = MappingProxyType(
    {
        "aperture": Setting(0xD101, "u16", APERTURES),
        "shutterspeed": Setting(0xD102, "u16", SHUTTER_TIMES),
        "iso": Setting(0xD103, "u16", ISO_SPEEDS),
        "exposurecompensation": Setting(0xD104, "u8", COMPENSATIONS),
        "autoexposuremode": Setting(0xD105, "u16", EXPOSURE_MODES),
        "drivemode": Setting(0xD106, "u16", DRIVE_MODES),
        "meteringmode": Setting(0xD107, "u8", METERING_MODES),
        "focusmode": Setting(0xD108, "u32", _listed("One Shot,AI Servo,AI Focus,Manual")),
        "whitebalance": Setting(0xD109, "u8", WHITE_BALANCES),
        "colortemperature": Setting(0xD10A, "u32"),
        "whitebalanceadjusta": Setting(0xD10B, "i32"),
        "whitebalanceadjustb": Setting(0xD10C, "i32"),
        "whitebalancexa": Setting(0xD10D, "u32"),
        "whitebalancexb": Setting(0xD10E, "u32"),
        "colorspace": Setting(0xD10F, "u16", _listed("sRGB,AdobeRGB", 1)),
        "picturestyle": Setting(0xD110, "u8", PICTURE_STYLES),
        "batterylevel": Setting(0xD111, "u16", _words({"Low": 0, "50%": 1, "100%": 2, "75%": 4, "25%": 5})),
        "autopoweroff": Setting(0xD114, "u32"),
        "model": Setting(0xD116, "u32"),
        "availableshots": Setting(0xD11B, "u32"),
        "capturetarget": Setting(0xD11C, "u32", _words({"Memory card": 2, "Internal RAM": 4})),
        "storageid": Setting(0xD11E, "u32", base=16),
        "imageformat": Setting(0xD120, "u16"),
        "imageformatcf": Setting(0xD121, "u16"),
        "imageformatsd": Setting(0xD122, "u16"),
        "imageformatexthd": Setting(0xD123, "u16"),
        "autoexposuremodedial": Setting(0xD138, "u16", EXPOSURE_MODES),
        "focusarea": Setting(0xD13C, "u32"),
        "highisonr": Setting(0xD178, "u16", _listed("Off,Low,Normal,High,Multi-Shot")),
        "movieservoaf": Setting(0xD179, "u32", _listed("Off,On")),
        "aspectratio": Setting(0xD194, "u32", _words({"3:2": 0, "1:1": 1, "4:3": 2, "16:9": 7, "1.6x": 13})),
        "shuttercounter": Setting(0xD1AC, "u32"),
        "eosserialnumber": Setting(0xD1AF, "str"),
        "output": Setting(0xD1B0, "u32", OUTPUTS),
        "evfmode": Setting(0xD1B1, "u16"),
        "depthoffield": Setting(0xD1B2, "u32"),
        "continuousaf": Setting(0xD1C9, "u32", _listed("Off,On")),
        "lensname": Setting(0xD1D8, "str"),
        "aeb": Setting(0xD1D9, "u16", MappingProxyType({k.replace("_", " "): v for k, v in BRACKETS.items()})),
        "strobofiring": Setting(0xD1DC, "u32"),
    }
)
CODES: Mapping[int, Setting] = MappingProxyType({setting.code: setting for setting in SETTINGS.values()})
IMAGE_FORMATS = range(0xD120, 0xD124)
TEXTS = (0xD115, 0xD125, 0xD1A0, 0xD1AF, 0xD1D0, 0xD1D1, 0xD1D3, 0xD1D8)
DATES = {0xD113, 0xD17C}  # when an owner made the log
EVERY_BODY = {0xD1AF}  # a body tells its serial number, whatever it has
# Of the computer, of libgphoto2 or of the body's acts: no property of an EOS in remote mode.
NO_PROPERTY = frozenset(
    {
        *(
            "syncdatetime",
            "syncdatetimeutc",
            "datetime",
            "datetimeutc",
            "capture",
            "remotemode",
            "eventmode",
            "opcode",
        ),
        *("uilock", "popupflash", "viewfinder", "eosviewfinder", "eosmoviemode", "bulb", "testolc", "movierecord"),
        *("autofocusdrive", "manualfocusdrive", "cancelautofocus", "eoszoom", "eoszoomposition", "eosremoterelease"),
        *("serialnumber", "manufacturer", "cameramodel", "deviceversion", "vendorextension", "ptpversion"),
    }
)
