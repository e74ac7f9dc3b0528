"""Reproduction of all tables and figures of Belder, Vivanti, Tal, "A Game of Bundle Adjustment -
Learning Efficient Convergence", ICCV 2023, with the command `jaxba-paper`."""
