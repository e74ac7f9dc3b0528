"""Every table and figure of the seed paper (Belder, Vivanti, Tal, ICCV 2023) from one command, `jaxba-paper`.

Part of the package and not of `benchmarks/`, since the command must work where only the package is installed, and since
it brings data (presets) and code (the Zero-net) that are no measurements of this repository's speed.
"""
