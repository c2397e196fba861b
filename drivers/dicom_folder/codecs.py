"""Says which package decodes a compressed transfer syntax, where no decoder for it is installed."""

from __future__ import annotations

import re

from pydicom.pixels.decoders.base import get_decoder
from pydicom.uid import UID

_GDCM = "pip install python-gdcm"
# What to install for each family of transfer syntaxes; RLE needs nothing.
_REMEDIES = {
    "1.2.840.10008.1.2.4.50": _GDCM,  # JPEG, 8 bits
    "1.2.840.10008.1.2.4.51": _GDCM,  # JPEG, 12 bits
    "1.2.840.10008.1.2.4.57": _GDCM,  # JPEG Lossless
    "1.2.840.10008.1.2.4.70": _GDCM,  # JPEG Lossless, first-order prediction
    "1.2.840.10008.1.2.4.80": f"{_GDCM}, or pyjpegls",  # JPEG-LS
    "1.2.840.10008.1.2.4.81": f"{_GDCM}, or pyjpegls",
    "1.2.840.10008.1.2.4.90": f"{_GDCM}, or pillow",  # JPEG 2000
    "1.2.840.10008.1.2.4.91": f"{_GDCM}, or pillow",
    "1.2.840.10008.1.2.4.201": "pip install pylibjpeg pylibjpeg-openjpeg",  # High-Throughput JPEG 2000
    "1.2.840.10008.1.2.4.202": "pip install pylibjpeg pylibjpeg-openjpeg",
    "1.2.840.10008.1.2.4.203": "pip install pylibjpeg pylibjpeg-openjpeg",
}


def lacking_decoder(syntax: str) -> str | None:
    """Return what to do about a known transfer syntax without a decoder here; None if it can be read, or is unknown.

    An unknown syntax is tried when its pixels are read.
    """
    uid = UID(syntax) if re.fullmatch(r"[0-9.]+", syntax) else None
    if uid is None or not uid.is_transfer_syntax or not uid.is_compressed or uid.is_deflated:
        return None
    try:
        if get_decoder(uid).is_available:
            return None
    except NotImplementedError:
        pass
    return _REMEDIES.get(syntax, "no package decodes it: export the series again, uncompressed")
