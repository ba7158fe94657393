"""Speed of fixed kernels, as ratios to a reference kernel measured in the same run (docs/benchmarking.md)."""
