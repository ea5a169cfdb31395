"""Policies that choose the next view, one module for each family."""
