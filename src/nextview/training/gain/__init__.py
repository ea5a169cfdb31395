"""From predictions to the gain policy."""
