"""What GCRPPO costs, measured through the public API: ``python -m benchmarks --help``."""
