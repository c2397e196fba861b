"""The families of bodies: one small file for each, found by its entry point and chosen by the camera's own names."""

from __future__ import annotations

from functools import cache

from drivers.errors import DeviceRefusedError
from drivers.gphoto.profile import Profile
from service.core.loading import plug_ins

GROUP = "orthocapture.camera_profiles"


@cache
def profiles() -> dict[str, Profile]:
    """The installed profiles, by name."""
    found = {point.name: point.load() for point in plug_ins(GROUP)}
    return {name: profile for name, profile in found.items() if isinstance(profile, Profile)}


def profile_for(manufacturer: str, model: str, named: str, where: str) -> tuple[str, Profile]:
    """Return name and content of the profile that rig.yaml names, or of the one for this body.

    Raises DeviceRefusedError, which lists the profiles, if there is none.
    """
    for name, profile in profiles().items():
        if name == named or (not named and profile.fits(manufacturer, model)):
            return name, profile
    known = ", ".join(f"{name} ({profile.bodies})" for name, profile in profiles().items())
    what = f"There is no profile {named}" if named else f"There is no profile for the body {manufacturer} {model}"
    raise DeviceRefusedError(
        what,
        where=where,
        remedy=f"Installed: {known}. If the body has the settings of one of them, name it as profile in rig.yaml",
    )
