"""Errors of the laboratory; see ``nextview.errors`` for the others."""

from nextview.errors import NextviewError


class MeasureError(NextviewError):
    """A view measure is not known, cannot be computed for these views, or failed.

    Example:
        >>> nextview_lab.data.measures.find_measure("missing")
        Traceback (most recent call last):
        nextview_lab.errors.MeasureError: no measure is called 'missing'; there are ...
    """


class PredictionsError(NextviewError):
    """Predictions cannot be used.

    Example:
        >>> nextview_lab.data.predictions.Predictions.load("missing.npz")
        Traceback (most recent call last):
        nextview_lab.errors.PredictionsError: missing.npz: there is no such file; ...
    """


class EntryError(NextviewError):
    """An entry of the benchmark cannot be run to its end.

    Example:
        >>> issubclass(nextview.EntryError, nextview.NextviewError)
        True
    """
