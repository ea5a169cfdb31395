"""What is fitted to predictions and views; training and export."""
