"""nextview_lab: data sets, training, replayed episodes and benchmarks for nextview."""

__version__ = "0.4.0"
