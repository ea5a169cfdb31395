"""Rival systems, agents, measures and studies that plug into nextview from outside, as a user's
own code does.
"""
