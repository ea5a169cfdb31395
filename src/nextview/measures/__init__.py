"""What makes a view good: measures by name, one file a family."""
