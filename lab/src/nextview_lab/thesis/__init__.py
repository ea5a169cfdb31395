"""What reproduces the thesis, run as ``python -m nextview_lab.thesis.NAME``; see docs/thesis.md."""
