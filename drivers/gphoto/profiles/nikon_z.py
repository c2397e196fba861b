"""Nikon Z bodies, over USB or the network."""

from __future__ import annotations

from types import MappingProxyType

from drivers.gphoto.profile import Fixed, Profile, Widget

PROFILE = Profile(
    bodies="Nikon Z",
    manufacturer="Nikon",
    model=r"(NIKON )?Z ?\w+",  # "Z 9", "Z 6_2", "Z f", "Z6_3"
    exif_make="NIKON",
    f_number=Widget("f-number"),
    # The widget `shutterspeed` of these bodies offers decimals that are cut after four places.
    shutter=Widget("shutterspeed2"),
    iso=Widget("iso"),
    focus=Widget(
        "focusmode",
        MappingProxyType({"Manual": ("Manual",), "Automatic": ("AF-S", "AF-C", "AF-F")}),
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
        Fixed("isoauto", ("Off",), "the camera chooses the ISO value of each photograph", needed=True),
        Fixed("capturemode", ("Single Shot",), "one exposure may give several files", needed=True),
    ),
)
