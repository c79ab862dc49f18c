"""Campaign files: axes, filters, rules and the scenario under them, read into points and runs."""
