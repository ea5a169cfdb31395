"""Compare next-view policies, with confidence intervals and significance tests."""
