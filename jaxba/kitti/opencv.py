"""OpenCV, or an error that says how to install it. Needs the extra `kitti`."""

from __future__ import annotations

try:
    import cv2
except ModuleNotFoundError:
    raise ImportError("this needs OpenCV: pip install jaxba[kitti]") from None

__all__ = ["cv2"]
