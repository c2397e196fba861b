"""Sony Alpha bodies with interchangeable lenses (ILCE) in PC Remote mode, over USB or the network."""

from __future__ import annotations

from types import MappingProxyType

from drivers.gphoto.profile import Profile, Widget

PROFILE = Profile(
    bodies="Sony ILCE",
    manufacturer="Sony",
    model=r"ILCE-.+",
    exif_make="SONY",
    f_number=Widget("f-number"),
    shutter=Widget("shutterspeed"),
    iso=Widget("iso"),
    focus=Widget("focusmode"),
    # A camera in mode 2 offers the finer words instead of the plain ones.
    quality=Widget(
        "imagequality",
        MappingProxyType(
            {
                "JPEG": ("JPEG", "Extra Fine", "X.Fine", "Fine"),
                "RAW": ("RAW",),
                "RAW+JPEG": ("RAW+JPEG", "RAW+JPEG (X.Fine)", "RAW+JPEG (Fine)"),
            }
        ),
    ),
    white_balance=Widget("whitebalance"),
    floating_white_balance=("Automatic",),
    fixed_white_balance="Daylight",
    program=Widget("expprogram"),
    manual_program="M",
    # By its name, libgphoto2 sends an empty value: this is the property itself, with numbers as values.
    target=Widget("d222"),
    targets=MappingProxyType({"computer": "1", "card": "16", "both": "17"}),
)
