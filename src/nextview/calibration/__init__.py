"""What is fitted to predictions instead of images, in seconds and without torch: calibration, tables of policies."""
