"""The profiles of cameras, against what libgphoto2 offers and what bodies were seen to offer."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

from drivers.errors import DeviceRefusedError
from drivers.gphoto.profile import Profile, battery_fraction, choose_number, choose_word, quality_of
from drivers.gphoto.profiles import profile_for, profiles


@dataclass(frozen=True)
class Listed:
    """What a body offered, by the listing of its settings in libgphoto2's sources (camlibs/ptp2/cameras)."""

    manufacturer: str
    model: str
    offered: dict[str, tuple[str, ...]]
    profile: str
    now: dict[str, str] = field(default_factory=dict[str, str])


_NIKON_WHITE = ("Automatic", "Daylight", "Fluorescent", "Tungsten", "Flash", "Cloudy", "Shade", "Color Temperature")
_NIKON_QUALITY = (
    "JPEG Basic",
    "JPEG Normal",
    "JPEG Fine",
    "Unknown value 0003",
    "NEF (Raw)",
    "NEF+Basic",
    "NEF+Fine",
)
_PLACES = ("Internal RAM", "Memory card")
_STOPS = ("f/5.6", "f/8", "f/11", "f/16")
LISTED = (
    Listed(
        "Nikon Corporation", "Z 6_2",
        {
            "f-number": _STOPS, "iso": ("50", "64", "80", "100", "200", "400"), "imagequality": _NIKON_QUALITY,
            "shutterspeed2": ("1/20", "1/15", "1/13", "1/3", "10/25", "Bulb", "Time"),
            "whitebalance": _NIKON_WHITE, "focusmode": ("Manual", "AF-S", "AF-C"), "autoiso": ("On", "Off"),
            "capturetarget": _PLACES, "capturemode": ("Single Shot", "Burst", "Timer"),
        },
        "nikon_z", {"expprogram": "M", "batterylevel": "100%"},
    ),
    Listed(
        "Nikon Corporation", "Z 9",
        {"whitebalance": _NIKON_WHITE, "capturetarget": _PLACES, "imagequality": _NIKON_QUALITY},
        "nikon_z", {"expprogram": "M", "batterylevel": "60%"},
    ),
    Listed(
        "Nikon Corporation", "Z f",
        {"focusmode": ("Manual", "AF-S", "AF-C", "AF-F"), "imagequality": _NIKON_QUALITY, "f-number": _STOPS},
        "nikon_z", {"expprogram": "M", "batterylevel": "60%"},
    ),
    Listed(
        "Canon.Inc", "Canon EOS R5",
        {
            "aperture": ("5.6", "8", "11", "16"), "shutterspeed": ("1/20", "1/15", "1/13"),
            "iso": ("Auto", "100", "200"),
            "imageformat": ("Large Fine JPEG", "Large Normal JPEG", "RAW + Large Fine JPEG", "RAW"),
            "whitebalance": ("Auto", "AWB White", "Daylight", "Shadow", "Color Temperature"),
            "capturetarget": _PLACES, "drivemode": ("Single", "Continuous low speed"),
        },
        "canon_eos", {"autoexposuremode": "Manual", "batterylevel": "50%"},
    ),
    Listed(
        "Canon.Inc", "Canon EOS R50",
        {
            "aperture": ("4.5", "5", "8", "22"), "shutterspeed": ("bulb", "10.3", "1/15", "1/13"),
            "iso": ("Auto", "100", "125"),
            "imageformat": ("Large Fine JPEG", "cRAW + Large Fine JPEG", "RAW + Large Fine JPEG", "cRAW", "RAW"),
            "whitebalance": ("Auto", "Daylight", "AWB White"), "capturetarget": _PLACES,
            "drivemode": ("Single", "Continuous timer"), "focusmode": ("One Shot", "AI Servo", "AI Focus", "Manual"),
        },
        "canon_eos", {"autoexposuremode": "Manual", "batterylevel": "100%"},
    ),
    Listed(
        "Canon.Inc", "Canon EOS R6 Mark III",
        {
            "aperture": ("2.8", "8"), "shutterspeed": ("30", "1/15"), "iso": ("Auto", "100", "64000"),
            "imageformat": ("Large Fine JPEG", "cRAW + Large Fine JPEG", "RAW + Large Fine JPEG", "RAW", "cRAW"),
            "whitebalance": ("Auto", "AWB White", "Daylight", "Unknown value 0018"), "capturetarget": _PLACES,
            "drivemode": ("Single", "Super high speed continuous shooting"),
        },
        "canon_eos", {"autoexposuremode": "Manual", "batterylevel": "50%"},
    ),
    Listed(
        "Canon.Inc", "Canon EOS 77D",
        {
            "aperture": ("1.8", "8"), "shutterspeed": ("bulb", "1/15"), "iso": ("Auto", "100", "Unknown value 0001"),
            "imageformat": ("Large Fine JPEG", "RAW + Large Fine JPEG", "RAW"),
            "whitebalance": ("Auto", "Unknown value 0017", "Daylight"), "capturetarget": _PLACES,
            "drivemode": ("Single", "Unknown value 0007"),
        },
        "canon_eos", {"autoexposuremode": "Manual", "batterylevel": "50%"},
    ),
)  # fmt: skip


@pytest.mark.parametrize("body", LISTED, ids=lambda body: body.model)
def test_a_body_that_was_listed_is_driven_by_its_profile(body: Listed) -> None:
    name, profile = profile_for(body.manufacturer, body.model, "", "here")
    assert name == body.profile
    offered = body.offered
    numbers = ((profile.f_number, 8.0), (profile.shutter, 1 / 15), (profile.iso, 100.0))
    for widget, wanted in ((w, n) for w, n in numbers if w.name in offered):
        assert choose_number(widget, wanted, offered[widget.name], "here") in ("8", "f/8", "1/15", "100")
    if profile.quality.name in offered:
        for wanted in ("JPEG", "RAW", "RAW+JPEG"):
            assert quality_of(choose_word(profile.quality, wanted, offered[profile.quality.name], "here")) == wanted
    fixed = (
        (profile.white_balance.name, profile.fixed_white_balance),
        *((one.name, one.words[0]) for one in profile.fixed),
    )
    for name, word in (*fixed, (profile.target.name, next(iter(profile.targets.values())))):
        assert word in offered.get(name, (word,))
    assert body.now[profile.program.name] == profile.manual_program
    assert battery_fraction(body.now["batterylevel"]) in (0.5, 0.6, 1.0)
    if profile.focus.name in offered:
        assert {profile.focus.ours(word) for word in offered[profile.focus.name]} == {"Manual", "Automatic"}


def words_of(profile: Profile) -> set[str]:
    """Names and words of a profile that libgphoto2 has as texts; numbers and hexadecimal names it makes itself."""
    widgets = (
        profile.f_number, profile.shutter, profile.iso, profile.focus, profile.quality, profile.white_balance,
        profile.program, profile.target,
    )  # fmt: skip
    parts = {widget.name for widget in widgets} | {
        profile.serial,
        profile.manual_program,
        profile.fixed_white_balance,
    }
    parts |= {*profile.floating_white_balance, *profile.targets.values()}
    parts |= {text for one in profile.fixed for text in (one.name, *one.words, *one.not_in_question)}
    for best in (words[0] for widget in widgets for words in widget.words.values()):
        parts |= set(best.split(" + "))
    return {part for part in parts if not re.fullmatch(r"d[0-9a-f]{3}|\d+", part)}


@pytest.mark.parametrize("profile", profiles().values(), ids=profiles())
def test_the_names_and_words_are_those_of_the_installed_library(profile: Profile) -> None:
    spec = find_spec("gphoto2")
    assert spec is not None
    assert spec.origin is not None
    (library,) = Path(spec.origin).parent.rglob("ptp2.so")
    texts = library.read_bytes()
    assert len(words_of(profile)) > 10
    # A text may be the end of a longer one, which the linker joined with it.
    assert not [word for word in sorted(words_of(profile)) if word.encode() + b"\0" not in texts]


@pytest.mark.parametrize(
    ("manufacturer", "model", "profile"),
    [
        ("Sony Corporation", "ILCE-7RM5", "sony_ilce"),
        ("Canon.Inc", "Canon EOS R5", "canon_eos"),
        ("Canon Inc.", "Canon EOS 5D Mark IV", "canon_eos"),
        ("Nikon Corporation", "Z6_3", "nikon_z"),
        ("Nikon Corporation", "NIKON Z 8", "nikon_z"),
    ],
)
def test_the_profile_is_chosen_by_the_body_s_names(manufacturer: str, model: str, profile: str) -> None:
    assert profile_for(manufacturer, model, "", "here")[0] == profile


@pytest.mark.parametrize(
    ("manufacturer", "model"),
    [("Nikon Corporation", "D850"), ("Canon.Inc", "Canon PowerShot G7 X"), ("Sony Corporation", "DSC-RX100M7")],
)
def test_other_bodies_of_these_makers_have_no_profile(manufacturer: str, model: str) -> None:
    with pytest.raises(DeviceRefusedError, match=re.escape(model)):
        profile_for(manufacturer, model, "", "here")
