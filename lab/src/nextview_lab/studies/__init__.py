"""What the pages measure: each module runs as ``python -m nextview_lab.studies.NAME``."""
