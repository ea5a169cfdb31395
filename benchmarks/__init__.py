"""What the pages measure: each script runs as ``python -m benchmarks.NAME`` from the root of the
repository.
"""
