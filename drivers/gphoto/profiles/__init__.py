"""The known families of bodies, one file each, and the choice of one by the names that the camera reports."""

from __future__ import annotations

from drivers.errors import DeviceRefusedError
from drivers.gphoto.profile import Profile
from drivers.gphoto.profiles.canon_eos import CANON_EOS
from drivers.gphoto.profiles.nikon_z import NIKON_Z
from drivers.gphoto.profiles.sony_ilce import SONY_ILCE

PROFILES = (SONY_ILCE, CANON_EOS, NIKON_Z)


def profile_for(manufacturer: str, model: str, named: str, where: str) -> Profile:
    """Return the profile that rig.yaml names, or the one for this body.

    Raises DeviceRefusedError, which lists the profiles, if there is none.
    """
    known = ", ".join(f"{one.name} ({one.bodies})" for one in PROFILES)
    for one in PROFILES:
        if one.name == named or (not named and one.fits(manufacturer, model)):
            return one
    what = f"There is no profile {named}" if named else f"There is no profile for the body {manufacturer} {model}"
    raise DeviceRefusedError(
        what,
        where=where,
        remedy=f"Known: {known}. If the body has the settings of one of them, name it as profile in rig.yaml",
    )
