"""The run's report for people, and the comparison with a known truth."""
