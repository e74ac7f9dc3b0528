"""The BAL data set by name: what there is, where a downloaded problem lies, and how to download
one."""
