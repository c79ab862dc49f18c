"""What a campaign shows: one page, its tables and figures, JUnit, Markdown."""
