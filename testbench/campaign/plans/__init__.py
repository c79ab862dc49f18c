"""Which runs a campaign wants: grids, sequential rules, searches."""
