"""The pytest plug-in: `hooks` is its entry point and imports nothing heavy; a test's rig is an `exo.Exo`."""
