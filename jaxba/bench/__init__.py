"""The benchmark: runner, records, performance profiles, tables, figures and the report."""
