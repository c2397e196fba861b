"""Nikon Z bodies, over USB or the network."""

from __future__ import annotations

from types import MappingProxyType

from drivers.gphoto.profile import Fixed, Profile, Widget

_LENS = (
    "Turn the mode dial to M; without a lens, or with one without electrical contacts, there is no f-number to set"
)

PROFILE = Profile(
    bodies="Nikon Z",
    manufacturer="Nikon",
    model=r"(NIKON )?Z ?\w+",  # "Z 9", "Z 6_2", "Z f", "Z6_3"
    exif_make="NIKON",
    f_number=Widget("f-number", unknown=("f/0",), if_fixed=_LENS),
    # The widget `shutterspeed` of these bodies offers decimals that are cut after four places.
    shutter=Widget("shutterspeed2", if_fixed="Turn the mode dial to M"),
    iso=Widget("iso", if_fixed="Switch ISO sensitivity auto control off in the camera's menu"),
    focus=Widget(
        "focusmode",
        MappingProxyType({"Manual": ("Manual",), "Automatic": ("AF-S", "AF-C", "AF-F", "AF-A")}),
        by_hand="Set the focus mode to MF on the lens or in the camera's menu",
    ),
    quality=Widget(
        "imagequality",
        MappingProxyType(
            {
                "JPEG": ("JPEG Fine*", "JPEG Fine"),
                "RAW": ("NEF (Raw)",),
                "RAW+JPEG": ("NEF+Fine*", "NEF+Fine"),
            }
        ),
    ),
    white_balance=Widget("whitebalance"),
    floating_white_balance=("Automatic", "Natural light auto"),
    fixed_white_balance="Daylight",
    program=Widget("expprogram"),
    manual_program="M",
    # Only files on the card have the camera's own names and numbers.
    target=Widget("capturetarget"),
    targets=MappingProxyType({"card": "Memory card"}),
    fixed=(
        # Not `isoauto`: of the Z 5, 6 II and 7 it can only be On, whatever their ISO sensitivity auto control is.
        Fixed(
            "autoiso",
            ("Off",),
            "the camera chooses the ISO of each photograph: switch ISO sensitivity auto control off in its menu",
            needed=True,
        ),
        Fixed(
            "capturemode",
            ("Single Shot",),
            "one exposure may give several files: set the release mode to single frame",
            needed=True,
        ),
    ),
)
