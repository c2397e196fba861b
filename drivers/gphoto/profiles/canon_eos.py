"""Canon EOS bodies in remote mode, over USB or the network."""

from __future__ import annotations

from types import MappingProxyType

from drivers.gphoto.profile import Fixed, Profile, Widget

PROFILE = Profile(
    bodies="Canon EOS",
    manufacturer="Canon",
    model=r"Canon EOS[ -].+",  # "Canon EOS R5", "Canon EOS-1D X"
    exif_make="Canon",
    f_number=Widget("aperture"),
    shutter=Widget("shutterspeed"),
    iso=Widget("iso"),
    focus=Widget(
        "focusmode",
        MappingProxyType({"Manual": ("Manual",), "Automatic": ("One Shot", "AI Focus", "AI Servo")}),
        by_hand="Set the switch on the lens to MF; a lens without one is set in the camera's menu",
    ),
    # The full size only. libgphoto2 used the longer words before version 2.5.32.
    quality=Widget(
        "imageformat",
        MappingProxyType(
            {
                "JPEG": ("L", "Large Fine JPEG"),
                "RAW": ("RAW", "cRAW"),
                "RAW+JPEG": ("RAW + L", "RAW + Large Fine JPEG", "cRAW + L", "cRAW + Large Fine JPEG"),
            }
        ),
    ),
    white_balance=Widget("whitebalance"),
    floating_white_balance=("Auto", "AWB White"),
    fixed_white_balance="Daylight",
    program=Widget("autoexposuremode"),
    manual_program="Manual",
    # Only files on the card have the camera's own names and numbers. libgphoto2 numbers those of the memory itself,
    # so that two files of one exposure could not be told from two exposures.
    target=Widget("capturetarget"),
    targets=MappingProxyType({"card": "Memory card"}),
    serial="eosserialnumber",
    fixed=(
        Fixed("drivemode", ("Single",), "one exposure may give several files: set the drive to single", needed=True),
    ),
    echoes=True,
)
