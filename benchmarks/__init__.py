"""What a change of the recognition is measured by: ``python -m benchmarks.gate``."""
