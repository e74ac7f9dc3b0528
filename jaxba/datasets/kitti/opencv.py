"""OpenCV, or one line on how to get it. Needs the extra `kitti`."""

from __future__ import annotations

try:
    import cv2
except ModuleNotFoundError:
    raise ImportError("this needs OpenCV: pip install jaxba[kitti]") from None

__all__ = ["cv2"]
