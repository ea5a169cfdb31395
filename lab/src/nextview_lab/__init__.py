"""nextview_lab: data sets, training, replayed episodes, benchmarks and studies for nextview."""

__version__ = "0.4.0"
