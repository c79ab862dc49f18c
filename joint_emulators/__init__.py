"""What is inside a joint: motor and gear, sensors, drive firmware, and the plant they move (MuJoCo)."""
