"""Driver for still cameras through libgphoto2, over USB or PTP/IP, by profiles of Sony, Canon and Nikon bodies."""

from __future__ import annotations

from drivers.gphoto.camera import GphotoCamera, GphotoConfig
from drivers.plugin import DriverSpec

__all__ = ["DRIVER", "GphotoCamera", "GphotoConfig"]

DRIVER = DriverSpec(kind="camera", config=GphotoConfig, build=GphotoCamera, hosted=True, call_timeout_s=120.0)
