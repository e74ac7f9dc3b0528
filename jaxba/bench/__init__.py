"""Solvers side by side: records, tolerances, profiles, plots and reports."""
