"""Readers of other programs' models: OpenSfM, OpenMVG, AliceVision. A solve of another file imports none."""

RECONSTRUCTION = "reconstruction.json"  # file by which a folder of OpenSfM is known
TRACKS = tuple(f"tracks.csv{ending}" for ending in ("", ".gz", ".bz2", ".xz"))  # OpenSfM's observations
