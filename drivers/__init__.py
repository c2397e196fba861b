"""Device drivers, one file per device, behind the interfaces in drivers.interfaces."""
