"""Simulated cameras and sensor models."""
