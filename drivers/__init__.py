"""Drivers: one file a device, behind the interfaces in drivers.interfaces."""
