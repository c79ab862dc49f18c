"""How runs are made: one run, and the executors that have many made."""
