"""What numbers of runs say: shares, samples, fits, rankings, gait phases."""
