"""Data only: the EDS files, the source of the object dictionaries."""
