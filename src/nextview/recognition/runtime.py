"""ONNX Runtime, imported without its telemetry: import ``ort`` from here, never the package itself.

Since version 1.29 the import alone writes a device number and a queue of events into the home
folder, and a process that lives long enough sends them to the maker. The variable must be set
before the import. Who wants the telemetry sets ``ORT_DISABLE_TELEMETRY=0``: what is set is kept.
"""

import os

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as _state

_found = vars(_state).values()
RUNTIME_FAILURES: tuple[type[Exception], ...] = tuple(
    kind for kind in _found if isinstance(kind, type) and issubclass(kind, Exception)
)
"""The runtime has a class of exception for every reason, without a common one."""

__all__ = ["RUNTIME_FAILURES", "ort"]
