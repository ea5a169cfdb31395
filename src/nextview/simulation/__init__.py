"""Simulated cameras, sensor models, cluttered scenes and rooms."""
