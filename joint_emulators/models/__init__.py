"""Builders of the MJCF text that describes the body in the machine; the text is data for whoever loads it."""
