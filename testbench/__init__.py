"""What assembles, runs, judges and shows: scenarios in, verdicts and result folders out."""
