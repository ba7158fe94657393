"""Measuring SimRecon: benchmark captures, runs over many of them, tables of the results (docs/benchmarking.md)."""
