"""COLMAP models: a folder of cameras, images and points, and in newer ones of rigs and frames,
binary or text.

What COLMAP calls a camera is a lens here (`jaxba.problem.intrinsics`): its images share it. Files
are read and written without COLMAP. Source: COLMAP, doc/cameras.rst and doc/format.rst."""

from jaxba.io.colmap.files import is_colmap
from jaxba.io.colmap.read import read_colmap
from jaxba.io.colmap.write import check_model, write_colmap
