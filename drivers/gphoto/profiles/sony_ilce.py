"""Sony Alpha bodies with interchangeable lenses (ILCE) in PC Remote mode, over USB or the network."""

from __future__ import annotations

from types import MappingProxyType

from drivers.gphoto.profile import Fixed, Profile, Widget

_LENS = "No lens, or one without electrical contacts: lock the lens in place, and turn its aperture ring to A"

PROFILE = Profile(
    bodies="Sony ILCE",
    manufacturer="Sony",
    model=r"ILCE-.+",
    exif_make="SONY",
    f_number=Widget("f-number", unknown=("f/655.34", "f/655.35", "f/0"), if_fixed=_LENS),
    shutter=Widget(
        "shutterspeed",
        unknown=("65535/65535",),
        if_fixed="Turn the mode dial to M, and the shutter's own dial off Bulb",
    ),
    iso=Widget("iso", if_fixed="Set ISO on the body; in the older protocol (2.00) it lists no values to choose from"),
    focus=Widget(
        "focusmode",
        if_fixed="The lens or a dial of the body fixes it: set their focus switch to MF, or to AF for autofocus",
    ),
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
    targets=MappingProxyType({"computer": "1", "both": "17", "card": "16"}),
    fixed=(
        # What goes to the computer is set apart from the quality; JPEGs of 0.3 MB arrived where RAW was set.
        Fixed(
            "pcsaveimgsize",
            ("Original",),
            "the computer receives small JPEGs: set PC Save Image Size (PC Remote) to Original",
        ),
        Fixed(
            "pcsaveimgformat",
            ("RAW & JPEG",),
            "the computer receives only one of the files: set RAW+J PC Save Image (PC Remote) to RAW & JPEG",
            not_in_question=("Disabled",),
        ),
        Fixed("capturemode", ("Single Shot",), "one exposure may give several files: turn the drive dial to single"),
        Fixed(
            "imagestabilization",
            ("Off",),
            "the sensor moves, and poses are wrong by pixels: switch SteadyShot off, also on the lens",
        ),
        Fixed(
            "shuttertype",
            ("Mechanical",),
            "an electronic shutter smears what still swings: set the shutter type to mechanical",
        ),
        Fixed("silentmode", ("Off",), "it makes the shutter electronic: switch silent mode off"),
        Fixed("sensorcrop", ("Off",), "the photographs have another size: switch APS-C / Super 35 off"),
        Fixed("imagesize", ("Large",), "the JPEGs have another size: set the JPEG image size to L"),
        Fixed("aspectratio", ("3:2",), "the JPEGs have another size: set the aspect ratio to 3:2"),
    ),
    may_miss_first=True,
    files_missing="PC Save Image Size must be Original and RAW+J PC Save Image must be RAW & JPEG (menu PC Remote)",
    slots=(("d248", "d249"), ("d256", "d257")),
    no_card="2",
)
