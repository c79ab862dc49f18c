"""Frames, nodes, the emulated medium and the loops that carry frames between nodes."""
