"""Campaigns: a scenario times a grid times seeds, run, kept, counted and shown."""
