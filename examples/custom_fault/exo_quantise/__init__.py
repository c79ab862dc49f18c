"""A fault type of one's own: a value known only in coarse steps."""
